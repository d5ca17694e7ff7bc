"""Sections with steps, arms and plates in between: what the finder lists of them, against drawn truth."""

import manifold3d
import numpy as np
import pytest
import shapely
from solids import box, model, of, prism

from bimfit.bim.bands import middle_line, straight_arms
from bimfit.bim.joints import find_joints
from bimfit.config import JointConfig

GAP = 0.006
TONGUE = [(-1, 0), (0, 0), (0, 0.04), (0.04, 0.04), (0.04, 0.08), (0, 0.08), (0, 0.12), (-1, 0.12)]
GROOVE = [
    (GAP, 0),
    (1, 0),
    (1, 0.12),
    (GAP, 0.12),
    (GAP, 0.08 + GAP),
    (0.04 + GAP, 0.08 + GAP),
    (0.04 + GAP, 0.04 - GAP),
    (GAP, 0.04 - GAP),
]
HALVED = [(-1, 0), (0, 0), (0, 0.1), (-0.1, 0.1), (-0.1, 0.2), (-1, 0.2)]
OTHER_HALF = [(0.01, 0), (1, 0), (1, 0.2), (-0.09, 0.2), (-0.09, 0.11), (0.01, 0.11)]
BED = [(-1, 0), (0.042, 0), (0.042, 0.017), (0, 0.017), (0, 0.04), (-1, 0.04)]
OTHER_BED = [(0.062, 0), (1, 0), (1, 0.04), (0.02, 0.04), (0.02, 0.023), (0.062, 0.023)]
KEY = [(-1, 0), (-0.002, 0), (-0.002, 0.06), (-0.012, 0.07), (-0.012, 0.14), (-0.002, 0.15), (-0.002, 0.2)]
KEYED = [*KEY, (-1, 0.2)]
# A, B, width and depth in mm
STEPPED = {
    "tongue and groove": (TONGUE, GROOVE, 6.0, 120.0),
    "halved": (HALVED, OTHER_HALF, 10.0, 200.0),
    "halved, its bed larger than its cheeks": (BED, OTHER_BED, 20.0, 40.0),
    "keyed": (KEYED, [(-x, z) for x, z in KEYED][::-1], 4.0, 200.0),
}


@pytest.mark.parametrize("name", STEPPED)
@pytest.mark.parametrize("swapped", [False, True])
def test_a_stepped_section_is_one_rebate_open_on_both_sides(name, swapped):
    a, b, width, depth = STEPPED[name]
    meshes = [prism(corners, 3.0) for corners in (a, b)]
    (joint,) = find_joints(model(*(meshes[::-1] if swapped else meshes)))
    assert (joint.kind, joint.state, joint.two_sided) == ("rebate", "open", True)
    assert joint.width * 1e3 == pytest.approx(width, abs=1e-4)
    assert joint.depth * 1e3 == pytest.approx(depth, abs=1e-4)
    assert joint.length == pytest.approx(3.0)
    # the spine runs midway in the whole depth
    np.testing.assert_allclose(joint.path.points[:, 2], 0.5e-3 * depth, atol=1e-7)


def i_profile(low, high):
    """An I 200 x 190 along x, with flanges of 10 and a web of 6.5 mm, and fillets of 18 mm radius."""
    half, web = shapely.box(-0.1, 0.085, 0.1, 0.095), shapely.box(-0.00325, -0.095, 0.00325, 0.095)
    plain = shapely.union_all([half, shapely.affinity.scale(half, 1, -1, origin=(0, 0)), web])
    round_ = plain.buffer(0.018, quad_segs=6, join_style="mitre").buffer(-0.018, quad_segs=6)
    section = manifold3d.CrossSection([np.asarray(round_.exterior.coords)[:-1]], manifold3d.FillRule.NonZero)
    solid = manifold3d.Manifold.extrude(section, high - low)
    return of(solid.rotate((90, 0, 90)).translate((low, 0, 0)))


def plate(low, high):
    return box((low, -0.11, -0.11), (high, 0.11, 0.11))


def test_profiles_on_end_plates_meet_along_flanges_and_web():
    meshes = i_profile(0, 3), plate(3.0, 3.015), plate(3.017, 3.032), i_profile(3.032, 6)
    found = find_joints(model(*meshes))
    pairs = {(int(a[-1]), int(b[-1])) for a, b in (joint.elements for joint in found)}
    # nothing is listed across the plates, which stand out of where the profiles face each other
    assert pairs == {(0, 1), (1, 2), (2, 3)}
    (slot,) = [joint for joint in found if joint.state == "open"]
    assert slot.width == pytest.approx(0.002, abs=1e-7)
    for pair in (("GUID0", "GUID1"), ("GUID2", "GUID3")):
        welds = sorted((j for j in found if j.elements == pair), key=lambda j: -j.length)
        assert [joint.state for joint in welds] == ["touch"] * 3
        assert [joint.depth * 1e3 for joint in welds] == pytest.approx([10.0, 10.0, 6.5], abs=0.01)
        # along the inside of a flange up to the fillets on either side of the web
        assert [joint.length * 1e3 for joint in welds] == pytest.approx([157.5, 157.5, 134.0], abs=1.0)
        assert abs(welds[0].path.leg_directions[0][1]) == pytest.approx(1.0)
        assert abs(welds[2].path.leg_directions[0][2]) == pytest.approx(1.0)


def test_across_the_plates_there_is_a_filled_gap_that_nobody_can_see():
    meshes = i_profile(0, 3), plate(3.0, 3.015), plate(3.017, 3.032), i_profile(3.032, 6)
    every = find_joints(model(*meshes), JointConfig(everything=True))
    across = [joint for joint in every if joint.elements == ("GUID0", "GUID3")]
    assert across
    assert all(joint.state == "filled" and not joint.accessible for joint in across)


def pieces(region):
    return [np.asarray(t.exterior.coords)[:-1] for t in shapely.constrained_delaunay_triangles(region).geoms]


def test_a_branched_region_has_arms_and_no_middle_line():
    tee = shapely.union_all([shapely.box(-0.2, 0, 0.2, 0.02), shapely.box(-0.01, -0.3, 0.01, 0.0)])
    assert middle_line(pieces(tee), max_depth=0.5) is None
    arms = sorted(straight_arms(pieces(tee)), key=lambda arm: arm.length)
    # the flange on either side of the web, and the web
    assert [arm.length for arm in arms] == pytest.approx([0.19, 0.19, 0.3])
    assert [arm.depth for arm in arms] == pytest.approx([0.02] * 3)


@pytest.mark.parametrize("bend", [0.0, 0.3, 1.2])
def test_bands_keep_their_middle_line(bend):
    t = np.linspace(0.0, 1.0, 40)
    line = np.column_stack([np.sin(bend * t) / bend, (1.0 - np.cos(bend * t)) / bend]) if bend else None
    line = np.column_stack([t, 0.0 * t]) if line is None else line
    region = shapely.LineString(line).buffer(0.03, cap_style="flat", join_style="mitre")
    found, closed = middle_line(pieces(region), max_depth=0.5)
    assert not closed
    assert np.linalg.norm(np.diff(found, axis=0), axis=1).sum() == pytest.approx(1.0, rel=2e-3)
