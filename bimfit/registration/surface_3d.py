"""Samples of the part of a component's surface that a sensor can see, in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bimfit.errors import ModelError
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array

_VIEWS = 48
_GRAZING = 0.25
_OPEN = 0.15


@dataclass(frozen=True)
class Surface:
    """Evenly spaced samples of a surface.

    Attributes
    ----------
    points, normals : ndarray, shape (n, 3)
        m, and unit outward normals.
    spacing : float
        About the distance between neighbours, m.
    unsigned : bool
        Whether a point's own normal may be turned either way (the viewpoint is not known).
    """

    points: Array
    normals: Array
    spacing: float
    unsigned: bool = False

    def __len__(self) -> int:
        """Count of samples."""
        return len(self.points)

    def subset(self, keep: np.ndarray[tuple[int], np.dtype[np.bool_]], *, unsigned: bool) -> Surface:
        """Only the samples marked True in ``keep`` (n,)."""
        return Surface(self.points[keep], self.normals[keep], self.spacing, unsigned)


def sample_surface(mesh: TriangleMesh, spacing: float) -> Surface:
    """Sample every triangle in rows along its longest edge; the same mesh gives the same samples.

    Raises
    ------
    ModelError
        When the mesh has no area.
    """
    t = mesh.triangles
    area = np.linalg.norm(mesh.face_vectors, axis=1) if len(t) else np.zeros(0)
    keep = area > 1e-12
    if not keep.any():
        raise ModelError("the component has no surface", remedy="check its geometry")
    t, area = t[keep], area[keep]
    normals = mesh.face_vectors[keep] / area[:, None]
    edges = np.stack([t[:, 1] - t[:, 0], t[:, 2] - t[:, 1], t[:, 0] - t[:, 2]], axis=1)
    longest = np.argmax(np.linalg.norm(edges, axis=2), axis=1)
    rows_of = np.arange(len(t))
    a = t[rows_of, longest]
    base = edges[rows_of, longest]
    apex = t[rows_of, (longest + 2) % 3] - a
    length = np.linalg.norm(base, axis=1)
    rows = np.maximum(np.ceil(2.0 * area / length / spacing), 1).astype(np.int64)
    owner = np.repeat(np.arange(len(t)), rows)
    v = (_ramp(rows) + 0.5) / rows[owner]
    columns = np.maximum(np.ceil((1.0 - v) * length[owner] / spacing), 1).astype(np.int64)
    row = np.repeat(np.arange(len(owner)), columns)
    u = (_ramp(columns) + 0.5) / columns[row] * (1.0 - v[row])
    triangle = owner[row]
    points = a[triangle] + u[:, None] * base[triangle] + v[row, None] * apex[triangle]
    return Surface(points, normals[triangle], spacing)


def visible_surface(mesh: TriangleMesh, spacing: float, viewpoint: ArrayLike | None = None) -> Surface:
    """The samples that a sensor sees: facing it, and not hidden by the component itself (METHOD 2b).

    Without a viewpoint: those that some sensor outside could see well, which leaves out the inside of
    hollow sections.

    Parameters
    ----------
    mesh : TriangleMesh
    spacing : float
        Between samples, m.
    viewpoint : array_like, shape (3,), optional
        The sensor in the mesh's frame, m.

    Raises
    ------
    ModelError
        When nothing of the component can be seen.
    """
    surface = sample_surface(mesh, spacing)
    caster = Caster(mesh)
    if viewpoint is not None:
        seen = _sight(caster, surface, np.asarray(viewpoint, float)) > 0.0
    else:
        low, high = mesh.bounds
        centre, radius = 0.5 * (low + high), 2.0 * float(np.linalg.norm(high - low))
        views = centre + radius * _sphere(_VIEWS)
        facing = (views @ surface.normals.T - np.einsum("ij,ij->i", surface.points, surface.normals)) > 0.0
        sights = np.stack([_sight(caster, surface, eye) for eye in views]) > _GRAZING
        seen = sights.sum(axis=0) > _OPEN * facing.sum(axis=0)
    if not seen.any():
        raise ModelError(
            "no part of the component can be seen from the viewpoint", remedy="check the viewpoint"
        )
    return surface.subset(seen, unsigned=viewpoint is None)


def clipped(mesh: TriangleMesh, boxes: ArrayLike, size: float) -> TriangleMesh:
    """The part of a mesh near boxes: triangles whose own box meets one, none much longer than ``size``.

    Long triangles are halved again and again across their longest edge, and what lies far is dropped, so
    that of a large element only the surroundings of the boxes are left.

    Parameters
    ----------
    mesh : TriangleMesh
    boxes : array_like, shape (k, 2, 3)
    size : float
        m.
    """
    low, high = np.moveaxis(np.asarray(boxes, float), 1, 0)
    todo, done = np.asarray(mesh.triangles, float), []
    while len(todo):
        near = np.zeros(len(todo), bool)
        least, most = todo.min(axis=1), todo.max(axis=1)
        for a, b in zip(low, high, strict=True):
            near |= ((least <= b) & (most >= a)).all(axis=1)
        todo = todo[near]
        sides = np.linalg.norm(todo - np.roll(todo, -1, axis=1), axis=2)
        long = sides.max(axis=1, initial=0.0) > size
        done.append(todo[~long])
        todo, longest = todo[long], np.argmax(sides[long], axis=1)
        rows = np.arange(len(todo))
        a, b, c = (todo[rows, (longest + k) % 3] for k in range(3))
        middle = 0.5 * (a + b)
        todo = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    kept = np.concatenate(done) if done else np.zeros((0, 3, 3))
    return TriangleMesh.of(kept.reshape(-1, 3), np.arange(3 * len(kept)).reshape(-1, 3))


class Caster:
    """Casts rays at a mesh (Open3D, Embree), in double precision coordinates however large.

    Parameters
    ----------
    mesh : TriangleMesh
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        import open3d as o3d

        tensor: Any = o3d.core.Tensor
        low, high = mesh.bounds
        # Embree counts in single precision: rays are cast about the mesh's own centre.
        self.centre = 0.5 * (low + high)
        self.size = float(np.linalg.norm(high - low))
        self._tensor = tensor
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            tensor((mesh.vertices - self.centre).astype(np.float32)), tensor(mesh.faces.astype(np.uint32))
        )

    def hit_distance(self, origins: Array, directions: Array) -> Array:
        """Distance (n,) to the first hit along unit directions (n, 3); infinite where there is none."""
        rays = np.concatenate([origins - self.centre, directions], axis=1).astype(np.float32)
        return np.asarray(self._scene.cast_rays(self._tensor(rays))["t_hit"].numpy(), float)


def _sight(caster: Caster, surface: Surface, eye: Array) -> Array:
    """Cosine of incidence of every sample seen from ``eye``; 0 where hidden or turned away."""
    ray = eye - surface.points
    distance = np.maximum(np.linalg.norm(ray, axis=1), 1e-12)
    cosine = np.einsum("ij,ij->i", ray, surface.normals) / distance
    facing = np.flatnonzero(cosine > 1e-6)
    out = np.zeros(len(surface))
    if not len(facing):
        return out
    # Rays start a hair above the surface: single precision would let them hit their own triangle.
    start = surface.points[facing] + surface.normals[facing] * (1e-5 * caster.size)
    clear = caster.hit_distance(start, ray[facing] / distance[facing, None]) >= distance[facing]
    out[facing[clear]] = cosine[facing[clear]]
    return out


def _ramp(counts: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Array:
    """0 .. c - 1 for every count c, joined."""
    ends = np.cumsum(counts)
    return np.asarray(np.arange(ends[-1]) - np.repeat(ends - counts, counts), float)


def _sphere(count: int) -> Array:
    """Evenly spread unit vectors (Fibonacci's lattice), shape (count, 3)."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
