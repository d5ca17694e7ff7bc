"""The joint finder: synthetic solids of every kind, the samples, and the verified pairs of real models."""

import math
from pathlib import Path

import manifold3d
import numpy as np
import pytest
from solids import box, model, of, prism

from bimfit.bim.joint import KINDS
from bimfit.bim.joints import find_joints, joint_between, no_joint_reason, select_joints
from bimfit.bim.model import load_model, model_from_elements
from bimfit.config import JointConfig
from bimfit.errors import JointError
from bimfit.geometry.mesh import TriangleMesh

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "ifc_samples"
REAL = ROOT.parent / "shared" / "data" / "ifc"
ALL = JointConfig(everything=True)

needs_data = pytest.mark.skipif(not REAL.is_dir(), reason="../shared/data/ifc is not here")


def only(found):
    assert len(found) == 1, [(j.kind, j.width, j.length) for j in found]
    return found[0]


def butt(gap=0.02, length=1.0):
    return box((-0.2, 0, 0), (-gap / 2, length, 0.025)), box((gap / 2, 0, 0), (0.2, length, 0.025))


def test_square_butt():
    joint = only(find_joints(model(*butt())))
    assert joint.kind == "square-butt"
    assert joint.state == "open"
    assert joint.width == pytest.approx(0.02, abs=1e-9)
    assert joint.length == pytest.approx(1.0, abs=1e-9)
    assert joint.depth == pytest.approx(0.025, abs=1e-9)
    assert joint.two_sided
    assert joint.accessible
    assert joint.elements == ("GUID0", "GUID1")
    frame = joint.path.rough_frame(0.3)
    np.testing.assert_allclose(frame.u, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(frame.v, [0, 0, 1], atol=1e-12)  # both sides are free: up
    np.testing.assert_allclose(frame.origin[[0, 2]], [0, 0.0125], atol=1e-9)


def test_map_coordinates_lose_nothing():
    shift = np.array([458657.21, 5438232.57, 112.4])
    moved = [TriangleMesh.of(m.vertices + shift, m.faces) for m in butt(0.0123)]
    joint = only(find_joints(model(*moved)))
    assert joint.width == pytest.approx(0.0123, abs=1e-8)
    np.testing.assert_allclose(joint.path.points.mean(axis=0), shift + np.array([0, 0.5, 0.0125]), atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.1, 2.0])
def test_found_at_any_orientation(angle):
    axis = np.array([0.3, -0.5, 0.8])
    axis /= np.linalg.norm(axis)
    k = np.cross(np.eye(3), axis)
    rotation = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k
    moved = [TriangleMesh.of(m.vertices @ rotation.T, m.faces) for m in butt()]
    joint = only(find_joints(model(*moved)))
    assert (joint.kind, joint.width, joint.length) == (
        "square-butt",
        pytest.approx(0.02, abs=1e-9),
        pytest.approx(1.0, abs=1e-9),
    )


def test_a_gap_as_wide_as_the_limit_is_found_whole():
    """Placements are rounded where they are written: half of it must not fall outside."""
    tilted = (
        box((0.0, 0.0, 0.0), (0.2, 1.0, 0.1)),
        prism([(0.26 + 1e-7, 0.0), (0.46, 0.0), (0.46, 0.1), (0.26 - 1e-7, 0.1)], 1.0),
    )
    (found,) = find_joints(model(*tilted))
    assert found.length == pytest.approx(1.0)
    assert found.depth == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize("gap", [0.0, 0.0005, -0.0008])
def test_faces_that_touch(gap):
    joint = only(find_joints(model(*butt(gap))))
    assert joint.state == "touch"
    assert joint.width == pytest.approx(gap, abs=1e-9)
    assert joint.accessible


def test_overlap_is_named_a_clash():
    joint = only(find_joints(model(*butt(-0.01))))
    assert joint.state == "clash"
    assert joint.width == pytest.approx(-0.01, abs=1e-9)


def test_layers_thinner_than_the_overlap_looked_for_are_no_clash():
    sheets = [box((0, 0, 0.01 * k), (1, 1, 0.01 * (k + 1))) for k in range(4)]
    found = find_joints(model(*sheets), ALL)
    assert {(j.elements, j.state) for j in found if j.state != "filled"} == {
        (("GUID0", "GUID1"), "touch"),
        (("GUID1", "GUID2"), "touch"),
        (("GUID2", "GUID3"), "touch"),
    }
    assert not [j for j in found if j.state == "clash"]


@pytest.mark.parametrize(
    ("depth", "state"), [((0.0, 0.025), "filled"), ((0.015, 0.025), "filled"), ((0.1, 0.2), "open")]
)
def test_a_filler_is_named(depth, state):
    seal = box((-0.01, 0, depth[0]), (0.01, 1.0, depth[1]))
    found = find_joints(model(*butt(), seal))
    joint = only([j for j in found if j.elements == ("GUID0", "GUID1")])
    assert joint.state == state
    assert joint.filler == ("GUID2" if state == "filled" else None)


def test_an_element_between_ends_the_joint():
    # a wall as wide as the gap region crosses it: only what lies beside it stays
    wall = box((-0.3, 0.4, -0.5), (0.3, 0.6, 0.5))
    a, b = (
        of(manifold3d.Manifold.cube((0.19, 0.4, 0.025)).translate(at)) for at in ((-0.2, 0, 0), (0.01, 0, 0))
    )
    found = [j for j in find_joints(model(a, b, wall)) if j.elements == ("GUID0", "GUID1")]
    assert only(found).length == pytest.approx(0.4, abs=1e-9)


@pytest.mark.parametrize("land", [0.003, 0.0005, 0.0])
@pytest.mark.parametrize("root", [0.0, 0.004])
def test_v_groove_with_and_without_a_land(land, root):
    half, rise = root / 2, 0.025 - land
    wide = half + rise * math.tan(math.radians(30))
    a = [(-0.2, 0), (-half, 0), (-half, land), (-wide, 0.025), (-0.2, 0.025)]
    if land == 0.0:
        a.pop(2)
    b = [(-x, z) for x, z in a]
    joint = only(find_joints(model(prism(a, 0.8), prism(b, 0.8))))
    assert joint.kind == "v-groove"
    assert joint.length == pytest.approx(0.8, abs=1e-6)
    np.testing.assert_allclose(joint.path.v[0], [0, 0, 1], atol=1e-9)


def test_single_bevel():
    a = [(-0.2, 0), (-0.002, 0), (-0.002, 0.003), (-0.015, 0.025), (-0.2, 0.025)]
    b = [(0.002, 0), (0.2, 0), (0.2, 0.025), (0.002, 0.025)]
    joint = only(find_joints(model(prism(a, 0.8), prism(b, 0.8))))
    assert joint.kind == "bevel"
    assert joint.width == pytest.approx(0.004, abs=1e-7)  # the outline library rounds


@pytest.mark.parametrize("degrees", [2.0, 5.0, 9.5])
def test_tapered_up_to_ten_degrees(degrees):
    run = 0.1 * math.tan(math.radians(degrees))
    a = [(-0.3, 0), (-0.005, 0), (-0.005, 0.1), (-0.3, 0.1)]
    b = [(0.005, 0), (0.3, 0), (0.3, 0.1), (0.005 + run, 0.1)]
    joint = only(find_joints(model(prism(a, 1.0), prism(b, 1.0))))
    assert joint.kind == "tapered"
    assert joint.widths[0] == pytest.approx(0.01, rel=0.02)
    # measured square to the plane midway, not along x
    assert joint.widths[1] == pytest.approx(0.01 + run, rel=0.03)
    np.testing.assert_allclose(joint.path.v[0] @ [0, 0, 1], 1.0, atol=0.01)


def test_lap_t_corner_mitre_scarf():
    def kind(a, b):
        return only(find_joints(model(prism(a, 1.0), prism(b, 1.0)))).kind

    def rectangle(x0, z0, x1, z1):
        return [(x0, z0), (x1, z0), (x1, z1), (x0, z1)]

    assert kind(rectangle(-0.2, 0, 0.03, 0.02), rectangle(-0.03, 0.025, 0.2, 0.045)) == "lap"
    assert kind(rectangle(-0.2, 0, 0.2, 0.02), rectangle(-0.02, 0.03, 0.02, 0.3)) == "t-joint"
    assert kind(rectangle(-0.2, 0, 0.2, 0.02), rectangle(0.16, 0.03, 0.2, 0.3)) == "corner"
    south = [(0.014, 0.0), (0.8, 0.0), (0.8, 0.12), (0.134, 0.12)]
    assert kind(south, [(z, x) for x, z in south]) == "mitre"
    left = [(-0.3, 0.0), (-0.01, 0.0), (0.04, 0.05), (-0.3, 0.05)]
    right = [(0.01, 0.0), (0.3, 0.0), (0.3, 0.05), (0.06, 0.05)]
    assert kind(left, right) == "scarf"


def test_cylinders_end_to_end_make_a_ring():
    rod = [of(manifold3d.Manifold.cylinder(0.5, 0.1, 0.1, 48).translate((0, 0, z))) for z in (0.0, 0.51)]
    tubes = [
        of(
            manifold3d.Manifold.cylinder(0.5, 0.1, 0.1, 48).translate((0, 0, z))
            - manifold3d.Manifold.cylinder(2.0, 0.08, 0.08, 48).translate((0, 0, -0.5))
        )
        for z in (0.0, 0.51)
    ]
    joint = only(find_joints(model(*tubes)))
    assert joint.path.closed
    assert joint.width == pytest.approx(0.01, abs=1e-9)
    assert joint.length == pytest.approx(2 * math.pi * 0.09, rel=0.01)
    assert joint.depth == pytest.approx(0.02, rel=0.02)
    radii = np.linalg.norm(joint.path.points[:, :2], axis=1)
    np.testing.assert_allclose(radii, 0.09, rtol=0.01)
    assert find_joints(model(*rod), ALL)[0].width == pytest.approx(0.01, abs=1e-9)


def test_a_sleeve_round_a_pipe_is_one_closed_curve():
    cylinder = manifold3d.Manifold.cylinder
    pipe = of(cylinder(0.06, 0.2, 0.2, 64) - cylinder(1.0, 0.19, 0.19, 64).translate((0, 0, -0.1)))
    sleeve = of(cylinder(0.06, 0.25, 0.25, 64) - cylinder(1.0, 0.21, 0.21, 64).translate((0, 0, -0.1)))
    joint = only(find_joints(model(pipe, sleeve)))
    assert joint.path.closed
    assert joint.path.curved
    assert joint.length == pytest.approx(2 * math.pi * 0.205, rel=0.03)
    assert joint.width == pytest.approx(0.01, abs=2e-4)
    for s in np.linspace(0, joint.path.length, 23):
        frame = joint.path.rough_frame(s)
        assert abs(frame.u @ (frame.origin * [1, 1, 0])) / np.linalg.norm(frame.origin[:2]) > 0.999
        assert abs(frame.v[2]) > 0.999


def test_the_perimeter_of_a_panel_is_one_joint_with_corners():
    cube = manifold3d.Manifold.cube
    wall = of(cube((3.0, 0.2, 3.0)) - cube((1.04, 1.0, 1.54)).translate((0.98, -0.5, 0.98)))
    panel = box((1.0, 0.05, 1.0), (2.0, 0.15, 2.5))
    joint = only(find_joints(model(wall, panel)))
    assert joint.path.closed
    assert len(joint.path.u) == 4
    assert joint.length == pytest.approx(5.0, abs=1e-6)
    assert joint.path.length == pytest.approx(2 * (1.02 + 1.52), abs=1e-6)
    assert sorted(joint.legs) == pytest.approx([1.0, 1.0, 1.5, 1.5])
    assert joint.width == pytest.approx(0.02, abs=1e-9)
    assert np.allclose(joint.path.v, joint.path.v[0])


def test_separate_contacts_do_not_invent_length():
    top = box((0, 0, 0.4), (2.0, 0.5, 0.44))
    solids = manifold3d.Manifold.cube((0.15, 0.5, 0.495))
    trestle = of(
        solids.translate((0.0, 0, -0.1))
        + solids.translate((1.85, 0, -0.1))
        + manifold3d.Manifold.cube((2, 0.5, 0.1)).translate((0, 0, -0.1))
    )
    found = find_joints(model(top, trestle))
    assert [round(j.length, 6) for j in found] == [0.5, 0.5]


def test_classes_storeys_and_widths_choose():
    a, b = butt()
    walls = model(a, b, classes=("IfcWallStandardCase", "IfcDoor"))
    assert find_joints(walls) == ()
    assert "1 of its 2 elements" in no_joint_reason(walls)
    assert len(find_joints(walls, JointConfig(classes=("IfcWall", "ifcdoor")))) == 1
    assert find_joints(model(a, b), JointConfig(storeys=("Attic",))) == ()
    assert find_joints(model(a, b), JointConfig(max_gap=0.015)) == ()
    assert find_joints(model(a, b), JointConfig(min_gap=0.025)) == ()
    assert find_joints(model(a, b), JointConfig(min_length=1.2)) == ()
    assert "face each other" in no_joint_reason(model(a, b), JointConfig(max_gap=0.015))


def test_a_cavity_shut_on_both_sides_is_set_apart():
    a, b = butt()
    lids = [box((-0.2, 0, z), (0.2, 1.0, z + 0.01)) for z in (-0.01, 0.025)]
    pair = ("GUID0", "GUID1")
    assert pair not in {j.elements for j in find_joints(model(a, b, *lids))}
    hidden = only([j for j in find_joints(model(a, b, *lids), ALL) if j.elements == pair])
    assert not hidden.accessible
    # with one lid gone the mouth is on the free side
    joint = only([j for j in find_joints(model(a, b, lids[1])) if j.elements == pair])
    np.testing.assert_allclose(joint.path.v[0], [0, 0, -1], atol=1e-12)
    assert not joint.two_sided


def test_facing_turns_the_mouth_and_keeps_the_rest():
    joint = only(find_joints(model(*butt())))
    below = joint.facing((0.1, 0.2, -3.0))
    np.testing.assert_allclose(below.path.v[0], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(below.path.u[0], joint.path.u[0])
    assert below.id == joint.id
    assert joint.facing((0, 0, 5.0)) is joint


def test_joint_between_goes_further_than_the_finder():
    far = model(*butt(0.2))
    assert find_joints(far) == ()
    joint = joint_between(far, "GUID1", "GUID0")
    assert joint.width == pytest.approx(0.2, abs=1e-9)
    assert joint.elements == ("GUID0", "GUID1")
    short = model(*butt(0.02, length=0.05))
    assert find_joints(short) == ()
    assert joint_between(short, "GUID0", "GUID1").length == pytest.approx(0.05, abs=1e-9)


def test_joint_between_says_why_there_is_none():
    apart = model(*butt(), box((0, 6, 0), (1, 7, 1)))
    with pytest.raises(JointError, match=r"5\.00 m apart"):
        joint_between(apart, "GUID0", "GUID2")
    with pytest.raises(JointError, match="nearest are GUID"):
        joint_between(apart, "GUID0", "GUID9")
    with pytest.raises(JointError, match="named twice"):
        joint_between(apart, "GUID0", "GUID0")


def test_selection_by_id_and_by_pair():
    building = load_model(SAMPLES / "facade.ifc", cache=False)
    found = find_joints(building)
    some = found[3]
    assert [j.id for j in select_joints(building, [some.id])] == [some.id]
    pair = ",".join(reversed(some.elements))
    assert [j.id for j in select_joints(building, [pair, some.id])] == [some.id]
    assert len(select_joints(building, [])) == 17
    with pytest.raises(JointError) as caught:
        select_joints(building, [some.id[:-1] + "~"])
    assert some.id in str(caught.value)
    with pytest.raises(JointError, match="write GUID,GUID"):
        select_joints(building, ["a,b,c"])


def test_ids_are_unique_short_and_do_not_depend_on_order():
    building = load_model(SAMPLES / "facade.ifc", cache=False)
    first = find_joints(building)
    again = find_joints(model_from_elements(building.elements[::-1]))
    assert [j.id for j in first] == [j.id for j in again]
    assert len({j.id for j in first}) == 17
    assert all(len(j.id) == 5 for j in first)
    # a narrower choice keeps the ids of those that remain
    longer = find_joints(building, JointConfig(min_length=2.99))
    assert {j.id for j in longer} < {j.id for j in first}


@pytest.mark.parametrize(
    ("name", "kind", "width", "length", "depth"),
    [
        ("square-butt-ifc2x3", "square-butt", 25, 820, 25),
        ("square-butt-ifc4", "square-butt", 25, 820, 25),
        ("square-butt-ifc4x3", "square-butt", 25, 820, 25),
        ("v-groove", "v-groove", 5, 820, 25),
        ("lap", "lap", 6, 820, 50),
        ("t-joint", "t-joint", 12, 820, 40),
        ("mitre", "mitre", 20, 1000, 169.7),
        ("curved", "square-butt", 20, 2950 * math.pi / 3, 100),
    ],
)
def test_samples(name, kind, width, length, depth):
    joint = only(find_joints(load_model(SAMPLES / f"{name}.ifc")))
    assert joint.kind == kind
    assert joint.kind in KINDS
    assert joint.width * 1e3 == pytest.approx(width, abs=1e-3)
    assert joint.length * 1e3 == pytest.approx(length, rel=1e-3)
    assert joint.depth * 1e3 == pytest.approx(depth, rel=1e-3)


def test_facade_has_seventeen_joints():
    found = find_joints(load_model(SAMPLES / "facade.ifc"))
    assert sorted(round(j.length, 6) for j in found) == [2.98] * 9 + [3.0] * 8
    assert {round(j.width, 6) for j in found} == {0.02}
    assert {round(j.depth, 6) for j in found} == {0.14}


def test_the_curved_samples_sections_are_radial():
    joint = only(find_joints(load_model(SAMPLES / "curved.ifc")))
    for s in np.linspace(0.0, joint.path.length, 41):
        frame = joint.path.rough_frame(s)
        radial = frame.origin * [1, 1, 0] / np.linalg.norm(frame.origin[:2])
        assert abs(frame.v @ radial) > math.cos(math.radians(0.05))
        assert frame.origin[2] == pytest.approx(0.61, abs=1e-9)


def test_what_a_script_reads():
    plain = only(find_joints(load_model(SAMPLES / "lap.ifc"))).to_dict()
    assert plain["designed"]["width"] == pytest.approx(0.006)
    assert plain["designed"]["length"] == pytest.approx(0.82)
    assert set(plain) >= {"id", "elements", "kind", "designed"}


def test_every_joint_of_a_large_facade():
    panels = [
        box((3.0 * c, 0, 3.0 * r), (3.0 * c + 2.98, 0.14, 3.0 * r + 2.98))
        for c in range(20)
        for r in range(15)
    ]
    found = find_joints(model(*panels))
    assert len(found) == 19 * 15 + 20 * 14
    assert len({j.id for j in found}) == len(found)
    assert all(j.width == pytest.approx(0.02, abs=1e-9) for j in found)


PAIRS = [
    ("XELLA-3e_verdieping", "0IjRD_pxn9aRaRUWq6Ebnq,2geNRwqjn30uvGChtbfnYT", 3.0, 643),
    ("XELLA-3e_verdieping", "2Xvgd3_obAS9WBKxab2dfp,18Su4zPSrECA7LPdeiBdes", 30.0, 2711),
    ("MULTICOM-banden", "1L6a$l0008y34qCZStEJCr,1L6a$l00091J4qCZStEJCr", 10.0, 383),
    ("ROOT-kalkzandsteen", "3HGDkJWG95UBZE0EMTLl3$,2qiB0g_bbDCwZnOTvTZQ6o", 30.0, 2884),
]


@needs_data
@pytest.mark.parametrize(("name", "pair", "gap", "length"), PAIRS)
def test_verified_pairs_of_real_models(name, pair, gap, length):
    building = load_model(REAL / f"{name}.ifc")
    guids = tuple(sorted(pair.split(",")))
    listed = [j for j in find_joints(building, ALL) if j.elements == guids and j.state == "open"]
    joint = max(listed, key=lambda j: j.length)
    assert joint.width * 1e3 == pytest.approx(gap, abs=0.2)
    assert joint.length * 1e3 == pytest.approx(length, rel=0.05)
    assert select_joints(building, [pair])[0].width == pytest.approx(joint.width, abs=1e-9)


@needs_data
def test_multicom_has_its_84_joints_of_10_mm():
    found = find_joints(load_model(REAL / "MULTICOM-banden.ifc"))
    assert len(found) == 84
    assert {j.state for j in found} == {"open"}
    assert all(abs(j.width - 0.01) < 1e-3 for j in found)
