"""Where a model might be in a cloud: rotations from face directions, translations by correlation."""

from __future__ import annotations

import numpy as np
from scipy import fft
from scipy.spatial.transform import Rotation

from bimfit.geometry.pose import Array
from bimfit.registration.surface_3d import Surface

_CONE = np.cos(np.radians(14.0))
_APART = np.radians(9.0)
_MAX_GRID = 144


def thin(
    points: Array, size: float, max_points: int, eye: Array | None, seed: int
) -> tuple[Array, Array, Array]:
    """Thin a cloud evenly and estimate its normals.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
    size : float
        The model's diagonal, m: sets the scale of the neighbourhoods.
    max_points : int
    eye : ndarray, shape (3,), or None
        Normals are turned towards it.
    seed : int

    Returns
    -------
    points, normals : ndarray, shape (m, 3)
    flatness : ndarray, shape (m,)
        1 where the neighbourhood is a plane, 0 where it is a line or a ball.
    """
    rng = np.random.default_rng(seed)
    cells = np.floor((points - points.min(axis=0)) / (size / 150.0)).astype(np.int64)
    order = rng.permutation(len(points))
    _, first = np.unique(cells[order], axis=0, return_index=True)
    kept = np.sort(order[first])
    if len(kept) > max_points:
        kept = np.sort(rng.choice(kept, max_points, replace=False))
    data = points[kept]
    normals, flatness = plane_normals(points, data, size / 25.0)
    if eye is not None:
        normals = normals * np.where(np.einsum("ij,ij->i", normals, eye - data) < 0.0, -1.0, 1.0)[:, None]
    return data, normals, flatness


def plane_normals(points: Array, at: Array, radius: float) -> tuple[Array, Array]:
    """Normals of the planes through the neighbours of ``at`` (m, 3) in a cloud (n, 3).

    Neighbours are at most 24, and within ``radius`` where eight are.

    Returns
    -------
    normals : ndarray, shape (m, 3)
        Either way round.
    flatness : ndarray, shape (m,)
        1 where the neighbourhood is a plane, 0 where it is a line or a ball.
    """
    from scipy.spatial import cKDTree

    k = min(24, len(points))
    found = cKDTree(points).query(at, k=[*range(1, k + 1)])
    distance, index = np.asarray(found[0]), np.asarray(found[1])
    near = distance <= np.maximum(radius, distance[:, min(8, k - 1)][:, None])
    weight = near / near.sum(axis=1, keepdims=True)
    group = points[index]
    offset = group - np.einsum("ik,ikj->ij", weight, group)[:, None]
    covariance = np.einsum("ik,ikj,ikl->ijl", weight, offset, offset)
    values, vectors = np.linalg.eigh(covariance)
    middle = np.maximum(values[:, 1], 1e-300)
    return np.asarray(vectors[:, :, 0]), np.asarray(np.clip(1.0 - 4.0 * values[:, 0] / middle, 0.0, 1.0))


def main_directions(normals: Array, weights: Array, *, signed: bool, most: int = 10) -> Array:
    """The directions that many normals share, most frequent first, shape (k, 3).

    Unsigned normals give each direction both ways.
    """
    if not signed:
        normals = np.concatenate([normals, -normals])
        weights = np.concatenate([weights, weights])
    total = float(weights.sum())
    left = weights.copy()
    found: list[Array] = []
    while len(found) < most and total > 0.0:
        live = np.flatnonzero(left > 0.0)
        if not len(live):
            break
        seeds = live[:: max(1, len(live) // 400)]
        votes = (normals[seeds] @ normals[live].T > _CONE) @ left[live]
        axis = normals[seeds[int(np.argmax(votes))]]
        for _ in range(3):
            cone = normals @ axis > _CONE
            mean = (left * cone) @ normals
            axis = mean / max(float(np.linalg.norm(mean)), 1e-300)
        if float(votes.max()) < 0.03 * total or not np.linalg.norm(axis) > 0.5:
            break
        found.append(axis)
        left = np.where(normals @ axis > np.cos(np.radians(20.0)), 0.0, left)
    return np.array(found).reshape(-1, 3)


def rotation_candidates(seen: Array, faces: Array, most: int) -> list[Array]:
    """Rotations (3 x 3) that turn directions seen in the cloud (k, 3) to faces of the model (m, 3).

    Two pairs of directions fix a rotation. Where all directions of one side are parallel the turn about
    them is tried in steps, and where there are none every rotation is, on an even lattice.
    """
    out: list[Array] = []

    def add(R: Array) -> None:
        if len(out) < most and all(np.trace(R @ other.T) < 1.0 + 2.0 * np.cos(_APART) for other in out):
            out.append(R)

    pairs = [(i, j) for j in range(len(seen)) for i in range(j) if abs(seen[i] @ seen[j]) < 0.9]
    targets = [(i, j) for i in range(len(faces)) for j in range(len(faces)) if abs(faces[i] @ faces[j]) < 0.9]
    for i, j in pairs:
        angle = np.arccos(np.clip(seen[i] @ seen[j], -1.0, 1.0))
        for k, m in targets:
            if abs(angle - np.arccos(np.clip(faces[k] @ faces[m], -1.0, 1.0))) < np.radians(10.0):
                add(Rotation.align_vectors(faces[[k, m]], seen[[i, j]])[0].as_matrix())
    if out:
        return out
    for a in seen[:2]:
        for f in faces:
            for angle in np.arange(0.0, 2.0 * np.pi, np.radians(10.0)):
                add(Rotation.from_rotvec(angle * f).as_matrix() @ _turn_to(a, f))
    if not out:
        for R in Rotation.random(4 * most, random_state=0):
            add(R.as_matrix())
    return out


def _turn_to(a: Array, b: Array) -> Array:
    """A rotation that turns the unit vector ``a`` to ``b``."""
    other = np.eye(3)[int(np.argmin(np.abs(a)))]
    side_a = np.cross(a, other)
    side_a /= np.linalg.norm(side_a)
    other = np.eye(3)[int(np.argmin(np.abs(b)))]
    side_b = np.cross(b, other)
    side_b /= np.linalg.norm(side_b)
    A = np.column_stack([a, side_a, np.cross(a, side_a)])
    B = np.column_stack([b, side_b, np.cross(b, side_b)])
    return np.asarray(B @ A.T)


def coarse_translations(
    data: Array, surface: Surface, rotations: list[Array], size: float, peaks: int
) -> list[Array]:
    """For every rotation the shifts that lay most of the cloud on the surface, as 4 x 4 matrices.

    Counts, over all shifts of a voxel grid at once (by FFT), the cloud's voxels that meet the blurred
    surface.
    """
    middle = data.mean(axis=0)
    spread = float(np.linalg.norm(data - middle, axis=1).max())
    extent = size + 2.0 * spread
    cell = max(size / 32.0, extent / _MAX_GRID)
    n = int(fft.next_fast_len(int(np.ceil(extent / cell)) + 4, real=True))
    low, high = surface.points.min(axis=0), surface.points.max(axis=0)
    centre = 0.5 * (low + high)
    field = _transformed_field(surface.points - centre, cell, n)
    out: list[Array] = []
    for R in rotations:
        turned = (data - middle) @ R.T
        grid = np.zeros((n, n, n), np.float32)
        index = np.mod(np.rint(turned / cell).astype(np.int64), n)
        grid[index[:, 0], index[:, 1], index[:, 2]] = 1.0
        score = fft.irfftn(field * np.conj(fft.rfftn(grid)), s=(n, n, n))
        for shift in _peaks(score, peaks):
            T = np.eye(4)
            T[:3, :3] = R
            T[:3, 3] = centre + np.where(shift > n // 2, shift - n, shift) * cell - R @ middle
            out.append(T)
    return out


def _transformed_field(points: Array, cell: float, n: int) -> Array:
    """Fourier transform of the surface's occupancy blurred by 0.8 cells."""
    grid = np.zeros((n, n, n), np.float32)
    index = np.mod(np.rint(points / cell).astype(np.int64), n)
    grid[index[:, 0], index[:, 1], index[:, 2]] = 1.0
    f = fft.fftfreq(n)
    g = np.exp(-2.0 * (np.pi * 0.8 * f) ** 2).astype(np.float32)
    half = g[: n // 2 + 1]
    return np.asarray(fft.rfftn(grid) * g[:, None, None] * g[None, :, None] * half[None, None, :])


def _peaks(score: Array, count: int) -> list[Array]:
    """The highest cells, each at least three cells from the ones before."""
    n = score.shape[0]
    out: list[Array] = []  # whole cells, as floats
    flat = score.reshape(-1)
    best = np.argpartition(-flat, min(400, len(flat) - 1))[:400]
    best = best[np.lexsort((best, -flat[best]))]
    for k in best:
        cell = np.array(np.unravel_index(int(k), score.shape), float)
        away = [np.abs((cell - other + n // 2) % n - n // 2).max() for other in out]
        if all(a >= 3 for a in away):
            out.append(cell)
        if len(out) == count:
            break
    return out
