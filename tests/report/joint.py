"""A small as-built joint to draw: two boards that wander along the joint, seen by a rangefinder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.profile import Profile
from bimfit.geometry.slice import Beams, Slice

BOARDS = (
    Profile.polygon([(-0.2125, 0.0), (-0.2125, -0.025), (-0.0125, -0.025), (-0.0125, 0.0)]),
    Profile.polygon([(0.0125, 0.0), (0.0125, -0.025), (0.2125, -0.025), (0.2125, 0.0)]),
)
INNER = np.array([[-0.0125, 0.0], [-0.0125, -0.025]])


@dataclass(frozen=True)
class Station:
    s: float
    frame: SectionFrame
    poses: tuple[Pose2D, Pose2D]
    slice: Slice

    @property
    def gap(self) -> Array:
        a = self.poses[0].apply(INNER)
        b = self.poses[1].apply(INNER * (-1.0, 1.0))
        return np.concatenate([a, b[::-1]])

    @property
    def fitted(self) -> tuple[Profile, Profile]:
        return BOARDS[0].moved(self.poses[0]), BOARDS[1].moved(self.poses[1])


def make_joint(stations: int = 83, spacing: float = 0.01, seed: int = 4) -> list[Station]:
    rng = np.random.default_rng(seed)
    knots = np.linspace(0, stations - 1, 12)

    def wander(half: float) -> Array:
        return np.interp(np.arange(stations), knots, rng.uniform(-half, half, len(knots)))

    common = [wander(0.02), wander(0.02), np.radians(wander(5.0))]
    own = [[wander(0.006), wander(0.006), np.radians(wander(3.0))] for _ in range(2)]
    out = []
    for k in range(stations):
        frame = SectionFrame.from_axes((458657.0, 5438232.0 - spacing * k, 12.0), (1, 0, 0), (0, 0, 1))
        whole = Pose2D(*(float(c[k]) for c in common))
        poses = tuple(
            whole @ Pose2D.about((side * 0.0125, 0.0), *(float(c[k]) for c in part))
            for side, part in zip((-1, 1), own, strict=True)
        )
        out.append(Station(k * spacing, frame, poses, _scan(k * spacing, poses, rng)))  # type: ignore[arg-type]
    return out


def _scan(s: float, poses: tuple[Pose2D, ...], rng: np.random.Generator) -> Slice:
    bearing = np.radians(0.352) * np.arange(-85, 86)
    origin = np.array([0.0, 0.25])
    along = np.stack([np.sin(bearing), -np.cos(bearing)], axis=1)
    reach = np.full(len(along), np.inf)
    for pose, board in zip(poses, BOARDS, strict=True):
        edges = board.moved(pose).edges
        for p, q in edges:
            e = q - p
            det = along[:, 0] * -e[1] + along[:, 1] * e[0]
            w = p - origin
            t = (w[0] * -e[1] + w[1] * e[0]) / det
            m = (along[:, 0] * w[1] - along[:, 1] * w[0]) / det
            reach = np.where((t > 0) & (m >= 0) & (m <= 1), np.minimum(reach, t), reach)
    ranges = np.where(np.isfinite(reach), reach + rng.normal(0, 0.003, len(reach)), np.nan)
    beams = Beams(np.tile(origin, (len(along), 1)), along, ranges)
    return Slice(s, beams.points, beams, origin)


def board_mesh(side: int, stations: list[Station]) -> TriangleMesh:
    """A designed board in world coordinates."""
    ring = BOARDS[side].loops[0]
    ends = [stations[0].frame.to_world(ring), stations[-1].frame.to_world(ring)]
    n = len(ring)
    faces = [(i, (i + 1) % n, n + i) for i in range(n)] + [
        ((i + 1) % n, n + (i + 1) % n, n + i) for i in range(n)
    ]
    faces += [(0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7)]
    return TriangleMesh.of(np.concatenate(ends), faces)
