"""The paper's joint, built from nothing but its numbers."""

from __future__ import annotations

import numpy as np
import pytest

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.joint_section import GapOutline, JointSection
from bimfit.geometry.profile import Profile


def build_joint(stations, gap=0.025, depth=0.025, width=0.2, origin=(0.0, 0.0, 0.0)):
    h = gap / 2
    a = Profile.polygon([(-h, 0.0), (-h - width, 0.0), (-h - width, -depth), (-h, -depth)])
    b = Profile.polygon([(h, 0.0), (h, -depth), (h + width, -depth), (h + width, 0.0)])
    sides = GapOutline(np.array([(-h, 0.0), (-h, -depth)]), np.array([(h, 0.0), (h, -depth)]))
    frames = [
        SectionFrame.from_axes(np.add(origin, (0.0, -s, 0.0)), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        for s in stations
    ]
    return [JointSection(float(s), frame, (a, b), sides) for s, frame in zip(stations, frames, strict=True)]


@pytest.fixture
def joint():
    """Makes sections at given stations; n = u x v = -y, so the joint runs along -y."""
    return build_joint
