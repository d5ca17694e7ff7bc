"""Gaps to measure, and joints made of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bimfit.gap.section import GapSection, gap_section
from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.joint_section import GapOutline
from bimfit.geometry.pose import Pose2D

MAP = np.array([458657.0, 5438232.0, 12.0])


def outline(a: ArrayLike, b: ArrayLike) -> GapOutline:
    return GapOutline(np.array(a, float), np.array(b, float))


BUTT = outline([(-0.0125, 0), (-0.0125, -0.025)], [(0.0125, 0), (0.0125, -0.025)])
V_GROOVE = outline(
    [(-0.015, 0), (-0.002, -0.02), (-0.002, -0.025)], [(0.015, 0), (0.002, -0.02), (0.002, -0.025)]
)
ONE_BEVEL = outline([(-0.015, 0), (-0.002, -0.02), (-0.002, -0.025)], [(0.002, 0), (0.002, -0.025)])
STEPPED = outline(
    [(-0.005, 0), (-0.005, -0.02), (0.02, -0.02), (0.02, -0.05)],
    [(0.005, 0), (0.005, -0.01), (0.03, -0.01), (0.03, -0.05)],
)
FILLET = outline(
    [
        *((-0.024 + 0.02 * np.sin(t), -0.02 * (1 - np.cos(t))) for t in np.linspace(0, np.pi / 2, 25)),
        (-0.004, -0.04),
    ],
    [(0.004, 0), (0.004, -0.04)],
)
SHAPES = {"butt": BUTT, "v": V_GROOVE, "bevel": ONE_BEVEL, "stepped": STEPPED}


def frame_at(s: float, origin: ArrayLike = (0, 0, 0)) -> SectionFrame:
    """A straight joint along +y."""
    return SectionFrame.from_axes(np.add(origin, (0.0, s, 0.0)), (-1, 0, 0), (0, 0, 1))


def section(
    shape: GapOutline = BUTT, a: ArrayLike = (0, 0, 0), b: ArrayLike = (0, 0, 0), s: float = 0.0, **more
) -> GapSection:
    frame = more.pop("frame", None) or frame_at(s, more.pop("origin", (0, 0, 0)))
    return gap_section(s, frame, shape, Pose2D.from_array(a), Pose2D.from_array(b), **more)


def row(
    poses: ArrayLike, shape: GapOutline = BUTT, spacing: float = 0.01, origin: ArrayLike = (0, 0, 0)
) -> list[GapSection]:
    """A straight joint of sections whose A and B poses are given, shape (n, 6)."""
    return [
        section(shape, p[:3], p[3:], k * spacing, origin=origin)
        for k, p in enumerate(np.asarray(poses, float))
    ]
