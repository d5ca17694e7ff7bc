"""Where elements meet, by brute force: what the joint finder is measured against.

Points all over every surface, and what their normals meet first, in one scene of all elements. It knows
nothing of planes, strips or pieces, and shares no code with the finder.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from bimfit.bim.joints import find_joints
from bimfit.bim.model import Model
from bimfit.config import JointConfig
from bimfit.geometry.pose import Array

AREA = 4e-4
"""Area that a point stands for, m^2."""
LEAST_GAP, MAX_GAP = 1.5e-3, 0.06
_OFF = 2e-4
_FACING = float(np.cos(np.radians(10.0)))

Pair = tuple[str, str]


@dataclass(frozen=True)
class Agreement:
    """How the finder and brute force agree on a model.

    Attributes
    ----------
    listed, right : int
        Pairs that the finder lists as open joints; those of them where points do face each other.
    clear, found : int
        Pairs that clearly face each other; those of them that the finder has.
    missed : tuple of pairs of str
    """

    listed: int
    right: int
    clear: int
    found: int
    missed: tuple[Pair, ...]

    @property
    def precision(self) -> float:
        """Share of the listed pairs that are right."""
        return self.right / max(self.listed, 1)

    @property
    def recall(self) -> float:
        """Share of the clear pairs that were found."""
        return self.found / max(self.clear, 1)


def agreement(model: Model, seed: int = 11) -> Agreement:
    """Compare the finder's open joints with what points on the surfaces meet."""
    truth = meetings(model, seed)
    joints = find_joints(model, JointConfig(everything=True))
    open_ = {
        joint.elements
        for joint in joints
        if joint.state == "open" and joint.width > 2e-3 and joint.length * joint.depth > 8.0 * AREA
    }
    gaps = {joint.elements for joint in joints if joint.state in ("open", "filled")}
    clear = {pair for pair, points in truth.items() if _is_clear(points)}
    right = sum(len(truth.get(pair, ())) >= 2 for pair in open_)
    return Agreement(len(open_), right, len(clear), len(clear & gaps), tuple(sorted(clear - gaps)))


def _is_clear(points: Array) -> bool:
    """Whether so much faces each other that neither sampling nor the finder's limits decide."""
    if len(points) * AREA / 2.0 <= 0.004:  # both faces were sampled
        return False
    sizes = extents(points)
    return bool(sizes[0] > 0.15 and sizes[1] > 0.015)


def meetings(model: Model, seed: int = 11) -> dict[Pair, Array]:
    """Pair of GlobalIds -> points (n, 3) where one faces the other, 1.5 to 60 mm apart, within 10 degrees."""
    import open3d as o3d

    rng = np.random.default_rng(seed)
    meshes = [element.mesh for element in model.elements]
    triangles = np.concatenate([mesh.triangles for mesh in meshes])
    owner = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    triangles = triangles - triangles.mean(axis=(0, 1))
    vector = 0.5 * np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(vector, axis=1)
    normal = vector / np.maximum(area, 1e-300)[:, None]
    tensor: Any = o3d.core.Tensor
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    corners = tensor(triangles.reshape(-1, 3).astype(np.float32))
    numbers = np.arange(3 * len(triangles)).reshape(-1, 3).astype(np.uint32)
    scene.add_triangles(corners, tensor(numbers))
    which = np.repeat(np.arange(len(area)), rng.poisson(area / AREA))
    a, b = np.sqrt(rng.random(len(which))), rng.random(len(which))
    weights = np.stack([1.0 - a, a * (1.0 - b), a * b], axis=1)
    points = np.einsum("ni,nij->nj", weights, triangles[which])
    start = points + _OFF * normal[which]
    hits = scene.cast_rays(tensor(np.hstack([start, normal[which]]).astype(np.float32)))
    distance = hits["t_hit"].numpy() + _OFF
    met = np.where(np.isfinite(distance), hits["primitive_ids"].numpy(), 0)
    facing = np.einsum("ij,ij->i", normal[which], normal[met]) < -_FACING
    good = facing & (distance > LEAST_GAP) & (distance < MAX_GAP) & (owner[which] != owner[met])
    out: dict[Pair, list[Array]] = defaultdict(list)
    for i in np.flatnonzero(good):
        low, high = sorted((int(owner[which[i]]), int(owner[met[i]])))
        out[model.elements[low].guid, model.elements[high].guid].append(points[i])
    return {pair: np.array(found) for pair, found in out.items()}


def extents(points: Array) -> Array:
    """Sizes of points (n, 3) along their own axes, greatest first, m."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    return np.sort(np.ptp(centred @ axes.T, axis=0))[::-1]
