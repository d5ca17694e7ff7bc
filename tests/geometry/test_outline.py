"""The gap's outline: designed shapes with known corners, and the laws it obeys."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bimfit.geometry.outline import FACING, trace_gap
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile

MM = 1e-3


def polygon(*corners, holes=()):
    return Profile.polygon(np.array(corners) * MM, holes=[np.array(h) * MM for h in holes])


def box(u0, v0, u1, v1):
    return polygon((u0, v0), (u1, v0), (u1, v1), (u0, v1))


def mirrored(profile):
    return Profile(tuple(loop[::-1] * (-1.0, 1.0) for loop in profile.loops))


def upside_down(profile):
    return Profile(tuple(loop[::-1] * (1.0, -1.0) for loop in profile.loops))


V_TOP = 2.5 + 22 * math.tan(math.radians(30))
V_PLATE = polygon((-212.5, -25), (-2.5, -25), (-2.5, -22), (-V_TOP, 0), (-212.5, 0))
SHARP = polygon((-200, -25), (-1, -25), (-26, 0), (-200, 0))
BEVEL = polygon((3, -25), (200, -25), (200, 0), (3 + 20 * math.sqrt(3), 0), (3, -20))
POCKET = polygon((-200, -100), (-5, -100), (-5, -30), (-25, -30), (-25, 0), (-200, 0))
HOLLOW = polygon(
    (-200, -100), (-5, -100), (-5, 0), (-200, 0), holes=[[(-150, -70), (-50, -70), (-50, -30), (-150, -30)]]
)
TONGUE = polygon((200, -100), (5, -100), (5, -65), (-15, -65), (-15, -35), (5, -35), (5, 0), (200, 0))
GROOVE = polygon((-200, -100), (-5, -100), (-5, -70), (-25, -70), (-25, -30), (-5, -30), (-5, 0), (-200, 0))
LIP_A = polygon((-200, -100), (50, -100), (50, -60), (0, -60), (0, 0), (-200, 0))
LIP_B = polygon((70, -100), (300, -100), (300, 0), (20, 0), (20, -40), (70, -40))
BED_A = polygon((-200, -40), (42, -40), (42, -23), (0, -23), (0, 0), (-200, 0))
BED_B = polygon((62, -40), (300, -40), (300, 0), (20, 0), (20, -17), (62, -17))
HALF = 10 * math.sqrt(2)


def mitre_wall():
    """The wall on the -u side of a mitred corner of 120 mm walls 20 mm apart, mouth at the outer corner."""
    plan = np.array([(HALF, 0), (800, 0), (800, 120), (120 + HALF, 120)])
    turn = np.array([[-1, 1], [-1, -1]]).T / math.sqrt(2)
    return Profile.polygon((plan @ turn + (0, 80)) * MM)


MITRE_TOP, MITRE_ROOT = 80 - 10, 80 - (120 * math.sqrt(2) + 10)

# name: A, B, side A, side B (mm), from the mouth to the root
CASES = {
    "square butt": (
        box(-212.5, -25, -12.5, 0), box(12.5, -25, 212.5, 0),
        [(-12.5, 0), (-12.5, -25)], [(12.5, 0), (12.5, -25)],
    ),
    "V with a root face": (
        V_PLATE, mirrored(V_PLATE),
        [(-V_TOP, 0), (-2.5, -22), (-2.5, -25)], [(V_TOP, 0), (2.5, -22), (2.5, -25)],
    ),
    "sharp V": (SHARP, mirrored(SHARP), [(-26, 0), (-1, -25)], [(26, 0), (1, -25)]),
    "single bevel": (
        box(-200, -25, 0, 0), BEVEL,
        [(0, 0), (0, -25)], [(3 + 20 * math.sqrt(3), 0), (3, -20), (3, -25)],
    ),
    "T, stem is A": (
        box(-250, -20, -6, 20), box(6, -200, 31, 200), [(-6, 20), (-6, -20)], [(6, 20), (6, -20)],
    ),
    "lap": (
        box(-30, -175, -3, 25), box(3, -25, 30, 175), [(-3, 25), (-3, -25)], [(3, 25), (3, -25)],
    ),
    "corner": (
        box(-200, -25, -5, 0), box(5, -200, 30, 0), [(-5, 0), (-5, -25)], [(5, 0), (5, -25)],
    ),
    "much thicker board": (
        box(-200, -25, -5, 0), box(5, -60, 200, 0), [(-5, 0), (-5, -25)], [(5, 0), (5, -25)],
    ),
    "slightly thicker board": (
        box(-200, -25, -5, 0), box(5, -31, 200, 0), [(-5, 0), (-5, -25)], [(5, 0), (5, -31)],
    ),
    "touching": (box(-200, -100, 0, 0), box(0, -100, 200, 0), [(0, 0), (0, -100)], [(0, 0), (0, -100)]),
    "clash of 4": (
        box(-200, -100, 2, 0), box(-2, -100, 200, 0), [(2, 0), (2, -100)], [(-2, 0), (-2, -100)],
    ),
    "3 mm between deep blocks": (
        box(-400, -300, -1.5, 0), box(1.5, -300, 400, 0), [(-1.5, 0), (-1.5, -300)], [(1.5, 0), (1.5, -300)],
    ),
    "half a metre": (
        box(-1000, -100, -250, 0), box(250, -100, 1000, 0),
        [(-250, 0), (-250, -100)], [(250, 0), (250, -100)],
    ),
    "taper": (
        polygon((-200, -100), (-5, -100), (-12, 0), (-200, 0)), box(5, -100, 200, 0),
        [(-12, 0), (-5, -100)], [(5, 0), (5, -100)],
    ),
    "rebate on both sides": (
        POCKET, mirrored(POCKET),
        [(-25, 0), (-25, -30), (-5, -30), (-5, -100)], [(25, 0), (25, -30), (5, -30), (5, -100)],
    ),
    "tongue and groove": (
        GROOVE, TONGUE,
        [(-5, 0), (-5, -30), (-25, -30), (-25, -70), (-5, -70), (-5, -100)],
        [(5, 0), (5, -35), (-15, -35), (-15, -65), (5, -65), (5, -100)],
    ),
    "shiplap": (
        LIP_A, LIP_B,
        [(0, 0), (0, -60), (50, -60), (50, -100)], [(20, 0), (20, -40), (70, -40), (70, -100)],
    ),
    "halved, with a bed longer than its cheeks": (
        BED_A, BED_B,
        [(0, 0), (0, -23), (42, -23), (42, -40)], [(20, 0), (20, -17), (62, -17), (62, -40)],
    ),
    "hollow block": (HOLLOW, box(5, -100, 200, 0), [(-5, 0), (-5, -100)], [(5, 0), (5, -100)]),
    "mitre": (
        mitre_wall(), mirrored(mitre_wall()),
        [(-10, MITRE_TOP), (-10, MITRE_ROOT)], [(10, MITRE_TOP), (10, MITRE_ROOT)],
    ),
}  # fmt: skip

cases = pytest.mark.parametrize("name", CASES)


def check(found, side_a, side_b, atol=1e-9):
    assert found is not None
    for got, wanted in ((found.side_a, side_a), (found.side_b, side_b)):
        assert len(got) == len(wanted), (got / MM).round(2)
        np.testing.assert_allclose(got, wanted, atol=atol)


def wanted(name):
    a, b, side_a, side_b = CASES[name]
    return a, b, np.array(side_a) * MM, np.array(side_b) * MM


@cases
def test_known_outline(name):
    a, b, side_a, side_b = wanted(name)
    check(trace_gap(a, b), side_a, side_b)


@cases
@settings(max_examples=15, deadline=None)
@given(u=st.floats(-1, 1), v=st.floats(-15, 2), degrees=st.floats(-6, 6), extra=st.floats(0, 1))
def test_rough_frame_does_not_matter(name, u, v, degrees, extra):
    a, b, side_a, side_b = wanted(name)
    pose = Pose2D(u * MM, v * MM * extra, math.radians(degrees))
    back = pose.inverse()
    found = trace_gap(a.moved(pose), b.moved(pose))
    assert found is not None
    check(type(found)(back.apply(found.side_a), back.apply(found.side_b)), side_a, side_b)


@cases
def test_swapping_the_sides_mirrors_the_outline(name):
    a, b, side_a, side_b = wanted(name)
    check(trace_gap(mirrored(b), mirrored(a)), side_b * (-1, 1), side_a * (-1, 1))


@cases
def test_turned_over_the_root_is_the_mouth(name):
    a, b, side_a, side_b = wanted(name)
    found = trace_gap(upside_down(a), upside_down(b))
    check(found, side_a[::-1] * (1, -1), side_b[::-1] * (1, -1))


@cases
def test_where_a_loop_starts_does_not_matter(name):
    a, b, side_a, side_b = wanted(name)
    for shift in range(1, 5):
        turned = [Profile(tuple(np.roll(loop, shift, axis=0) for loop in p.loops)) for p in (a, b)]
        check(trace_gap(*turned), side_a, side_b)


@cases
def test_points_on_the_boundary_change_no_corner(name):
    a, b, side_a, side_b = wanted(name)

    def halved(profile):
        return Profile(
            tuple(
                np.stack([loop, 0.5 * (loop + np.roll(loop, -1, axis=0))], axis=1).reshape(-1, 2)
                for loop in profile.loops
            )
        )

    found = trace_gap(halved(a), halved(b))
    assert found is not None
    for got, expected in ((found.side_a, side_a), (found.side_b, side_b)):
        np.testing.assert_allclose(got[[0, -1]], expected[[0, -1]], atol=1e-9)
        length = np.linalg.norm(np.diff(got, axis=0), axis=1).sum()
        assert length == pytest.approx(np.linalg.norm(np.diff(expected, axis=0), axis=1).sum(), abs=1e-9)


def test_fillet_ends_where_it_no_longer_faces_the_other():
    bearing = np.linspace(0, math.pi / 2, 40)
    arc = np.column_stack([-15 + 10 * np.cos(bearing), -10 + 10 * np.sin(bearing)])
    rounded = polygon((-200, -25), (-5, -25), *arc, (-200, 0))
    found = trace_gap(rounded, mirrored(rounded))
    assert found is not None
    np.testing.assert_allclose(found.side_a * (-1, 1), found.side_b, atol=1e-12)
    # the tangent there is within a facet of 12 degrees off the top
    end = 10 * np.array([math.cos(math.radians(78)), math.sin(math.radians(78))]) + (-15, -10)
    assert np.linalg.norm(found.side_a[0] / MM - end) < 10 * math.pi / 2 / 39 * 1.01
    assert len(found.side_a) > 30


@pytest.mark.parametrize(("slope", "belongs"), [(70, True), (77, True), (79, False), (85, False)])
def test_bevels_belong_while_they_face(slope, belongs):
    back = 10 * math.tan(math.radians(slope))
    plate = polygon((-500, -25), (-5, -25), (-5, -10), (-5 - back, 0), (-500, 0))
    found = trace_gap(plate, mirrored(plate))
    assert found is not None
    assert found.side_a[0, 0] == pytest.approx((-5 - back if belongs else -5) * MM, abs=1e-9)
    assert belongs == (math.cos(math.radians(slope)) > FACING)


def test_the_gap_nearest_the_origin_counts():
    a = polygon(
        (-200, -300), (-5, -300), (-5, -200), (-100, -200), (-100, -100), (-5, -100), (-5, 0), (-200, 0)
    )
    b = box(5, -300, 200, 0)
    low = trace_gap(a.moved(Pose2D(0, 0.25)), b.moved(Pose2D(0, 0.25)))
    assert low is not None
    assert low.side_a[:, 1].min() == pytest.approx(-0.3 + 0.25)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (box(-200, -100, 0, 0), box(10, 100, 200, 200)),  # nothing across
        (box(10, -100, 200, 0), box(-200, -100, -10, 0)),  # the wrong way round
        (box(-200, -100, 0, 0), Profile(())),
        (Profile(()), Profile(())),
    ],
)
def test_nothing_faces_anything(a, b):
    assert trace_gap(a, b) is None


def test_a_thin_sheet_beside_the_gap_is_no_clash():
    # B is 10 thick: its near face is across the gap, and its far face is not taken for an overlap with A
    a = box(-200, -100, 0, 0)
    b = box(5, -100, 15, 0)
    found = trace_gap(a.moved(Pose2D(-0.001, 0.05)), b.moved(Pose2D(-0.001, 0.05)))
    check(found, np.array([(-1, 50), (-1, -50)]) * MM, np.array([(4, 50), (4, -50)]) * MM)
    found = trace_gap(a, box(-15, -100, 200, 0))
    check(found, np.array([(0, 0), (0, -100)]) * MM, np.array([(-15, 0), (-15, -100)]) * MM)
    assert trace_gap(a, box(-25, -100, 200, 0)) is None


def test_corners_are_named_from_mouth_to_root():
    a, b, _, _ = wanted("square butt")
    found = trace_gap(a, b)
    assert found is not None
    np.testing.assert_allclose(found.mouth, [(-0.0125, 0), (0.0125, 0)], atol=1e-12)
    np.testing.assert_allclose(found.root, [(-0.0125, -0.025), (0.0125, -0.025)], atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(gap=st.floats(0.5, 100), depth=st.floats(5, 300), offset=st.floats(-20, 20), wide=st.floats(80, 1000))
def test_two_boxes_with_a_step(gap, depth, offset, wide):
    """Each end has both boxes' own corners, unless the step is more than the gap is wide."""
    if abs(abs(offset) - max(gap, 1)) < 1e-3 or abs(offset) > 0.8 * depth:
        return
    a, b = box(-gap / 2 - wide, -depth, -gap / 2, 0), box(gap / 2, -depth + offset, gap / 2 + wide, offset)
    shift = Pose2D(0, depth / 2 * MM)
    found = trace_gap(a.moved(shift), b.moved(shift))
    assert found is not None
    tops = np.array([found.side_a[0, 1], found.side_b[0, 1]]) / MM - depth / 2
    cut = abs(offset) > max(gap, 1)
    np.testing.assert_allclose(tops, [min(0, offset)] * 2 if cut else [0, offset], atol=1e-6)
