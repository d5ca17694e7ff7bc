"""Deformed profiles against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.joint_section import GapOutline, JointSection
from bimfit.geometry.profile import Profile
from bimfit.geometry.shape import FREEDOMS, deformed, has_freedom

FRAME = SectionFrame.from_axes((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def _butt(extra=False) -> JointSection:
    """Boards 200 x 25 mm, 25 mm apart; ``extra``: with vertices in the middle of straight faces."""
    b = [(0.0125, 0.0), (0.0125, -0.025), (0.2125, -0.025), (0.2125, 0.0)]
    if extra:
        b = [b[0], (0.0125, -0.010), b[1], (0.1, -0.025), b[2], b[3], (0.05, 0.0)]
    a = [(-x, y) for x, y in b]
    return JointSection(
        0.0,
        FRAME,
        (Profile.polygon(a), Profile.polygon(b)),
        GapOutline(np.array([a[0], (-0.0125, -0.025)]), np.array([b[0], (0.0125, -0.025)])),
    )


@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("which", [0, 1])
def test_a_bevel_turns_about_the_mouth_corner_and_its_root_stays_on_the_back(which, extra):
    angle = math.radians(10.0)
    new = deformed(_butt(extra), which, {"bevel-angle": angle})
    sign = (-1.0, 1.0)[which]
    mouth, root = (new.gap.side_a, new.gap.side_b)[which]
    assert np.allclose(mouth, (sign * 0.0125, 0.0), atol=1e-12)
    assert np.allclose(root, (sign * (0.0125 - 0.025 * math.tan(angle)), -0.025), atol=1e-12)
    assert new.components[which].area == pytest.approx(0.005 + 0.5 * 0.025**2 * math.tan(angle))
    assert new.components[1 - which] is not None
    assert np.array_equal(new.components[1 - which].loops[0], _butt(extra).components[1 - which].loops[0])


@pytest.mark.parametrize("which", [0, 1])
def test_a_face_rises_away_from_the_mouth_and_a_back_shifts_outwards(which):
    angle = math.radians(3.0)
    new = deformed(_butt(), which, {"face-angle": angle})
    assert new.components[which].bounds[1, 1] == pytest.approx(0.2 * math.tan(angle))
    assert new.components[which].area == pytest.approx(0.005 + 0.5 * 0.2**2 * math.tan(angle))
    thick = deformed(_butt(), which, {"thickness": 0.002})
    assert thick.components[which].area == pytest.approx(0.2 * 0.027)
    assert (thick.gap.side_a, thick.gap.side_b)[which][1, 1] == pytest.approx(-0.027)


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.005, 0.005), st.integers(0, 1))
def test_both_sides_are_mirror_images_and_the_mouth_stays(bevel, face, thickness, which):
    values = dict(zip(FREEDOMS, (bevel, face, thickness), strict=True))
    new = deformed(deformed(_butt(), 0, values), 1, values)
    a, b = new.gap.side_a, new.gap.side_b
    assert np.allclose(a * (-1.0, 1.0), b, atol=1e-12)
    assert np.allclose(b[0], (0.0125, 0.0), atol=1e-12)
    assert new.components[0].area == pytest.approx(new.components[1].area, abs=1e-12)
    assert len(new.components[which].loops[0]) == 4


def test_nothing_asked_for_changes_nothing_and_what_is_not_there_is_said():
    section = _butt()
    assert deformed(section, 0, {"thickness": 0.0}) is section
    assert all(has_freedom(section, 0, name) for name in FREEDOMS)
    moved = JointSection(
        0.0, FRAME, section.components, GapOutline(section.gap.side_a - (0.0, 0.01), section.gap.side_b)
    )
    assert not has_freedom(moved, 0, "bevel-angle")
    with pytest.raises(ValueError, match="begin at a corner"):
        deformed(moved, 0, {"bevel-angle": 0.1})
