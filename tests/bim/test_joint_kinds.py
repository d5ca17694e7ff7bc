"""Every kind of joint as drawn, then turned, moved, finely or sparsely meshed, and left open at its ends."""

import json
import re

import ifcopenshell
import ifcopenshell.guid
import manifold3d
import numpy as np
import pytest
import shapely
from scipy.spatial.transform import Rotation
from solids import box, model, of

from bimfit.bim.joints import find_joints
from bimfit.bim.model import load_model
from bimfit.cli.main import main
from bimfit.config import JointConfig
from bimfit.geometry.mesh import TriangleMesh

SOLID, SECTION = manifold3d.Manifold, manifold3d.CrossSection


def bar(x0, z0, x1, z1):
    return [(x0, z0), (x1, z0), (x1, z1), (x0, z1)]


def mirrored(corners):
    return [(-x, z) for x, z in corners][::-1]


V = [(-0.2, 0), (-0.002, 0), (-0.002, 0.003), (-0.0147, 0.025), (-0.2, 0.025)]
SHARP_V = [(-0.2, 0), (-0.002, 0), (-0.0147, 0.025), (-0.2, 0.025)]
X = [(-0.2, 0), (-0.0117, 0), (-0.002, 0.011), (-0.002, 0.014), (-0.0117, 0.025), (-0.2, 0.025)]
SOUTH = [(0.014, 0), (0.8, 0), (0.8, 0.12), (0.134, 0.12)]
SCARF = [(-0.3, 0), (-0.01, 0), (0.04, 0.05), (-0.3, 0.05)], [(0.01, 0), (0.3, 0), (0.3, 0.05), (0.06, 0.05)]
# section of A, section of B, kind, state, width and depth in mm
DRAWN = {
    "butt": (bar(-0.2, 0, -0.01, 0.025), bar(0.01, 0, 0.2, 0.025), "square-butt", "open", 20.0, 25.0),
    "touching": (bar(-0.2, 0, 0, 0.025), bar(0, 0, 0.2, 0.025), "square-butt", "touch", 0.0, 25.0),
    "clash": (bar(-0.2, 0, 0.005, 0.025), bar(-0.005, 0, 0.2, 0.025), "square-butt", "clash", -10.0, 25.0),
    "lap": (bar(-0.2, 0, 0.03, 0.02), bar(-0.03, 0.025, 0.2, 0.045), "lap", "open", 5.0, 60.0),
    "t": (bar(-0.2, 0, 0.2, 0.02), bar(-0.02, 0.03, 0.02, 0.3), "t-joint", "open", 10.0, 40.0),
    "fillet": (bar(-0.2, 0, 0.2, 0.02), bar(0.16, 0.02, 0.2, 0.3), "corner", "touch", 0.0, 40.0),
    "mitre": (SOUTH, [(z, x) for x, z in SOUTH][::-1], "mitre", "open", 19.8, 169.7),
    "scarf": (*SCARF, "scarf", "open", 14.1, 56.6),
    "v": (V, mirrored(V), "v-groove", "open", 4.0, 25.0),
    "v without a land": (SHARP_V, mirrored(SHARP_V), "v-groove", "open", 16.7, 25.0),
    "double v": (X, mirrored(X), "v-groove", "open", 4.0, 25.0),
    "bevel": (V, bar(0.002, 0, 0.2, 0.025), "bevel", "open", 4.0, 25.0),
    "tapered": (
        bar(-0.3, 0, -0.005, 0.1),
        [(0.005, 0), (0.3, 0), (0.3, 0.1), (0.0137, 0.1)],
        "tapered",
        "open",
        14.3,
        99.5,
    ),
}


def drawn_out(corners, rng, refine):
    section = SECTION([np.asarray(corners, float)], manifold3d.FillRule.NonZero)
    return of(SOLID.extrude(section, 1.0).refine(refine))


@pytest.mark.parametrize("name", DRAWN)
def test_kinds_survive_what_exporters_do(name):
    a, b, kind, state, width, depth = DRAWN[name]
    rng = np.random.default_rng(list(DRAWN).index(name))
    for trial in range(4):
        meshes = [drawn_out(corners, rng, 1 + (trial * k) % 3) for k, corners in ((1, a), (2, b))]
        if trial == 3:  # no caps
            meshes = [
                TriangleMesh.of(m.vertices, m.faces[np.ptp(m.triangles[:, :, 2], axis=1) > 1e-9])
                for m in meshes
            ]
        turn = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
        shift = rng.uniform(-1.0, 1.0, 3) * (0.0, 1e3, 1e6, 1e3)[trial]
        meshes = [
            TriangleMesh.of(m.vertices @ turn.T + shift, m.faces[rng.permutation(len(m.faces))])
            for m in meshes
        ]
        (joint,) = find_joints(model(*meshes), JointConfig(everything=True))
        assert (joint.kind, joint.state) == (kind, state)
        assert joint.width * 1e3 == pytest.approx(width, abs=0.06)
        assert joint.depth * 1e3 == pytest.approx(depth, abs=0.06)
        assert joint.length == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("angle", [20, 45, 90, 120])
def test_an_edge_that_turns_is_one_joint_with_corners(angle):
    a = np.radians(angle)
    line = shapely.LineString([(0, 0), (1, 0), (1 + 0.8 * np.cos(a), 0.8 * np.sin(a))])

    def beside(near, far):
        sides = [np.asarray(line.offset_curve(d, join_style="mitre").coords) for d in (near, far)]
        section = SECTION([np.vstack([sides[0], sides[1][::-1]])], manifold3d.FillRule.EvenOdd)
        return of(SOLID.extrude(section, 0.03))

    (joint,) = find_joints(model(beside(-0.0075, -0.3), beside(0.0075, 0.2)))
    assert (joint.kind, joint.state, joint.path.closed) == ("square-butt", "open", False)
    assert joint.width == pytest.approx(0.015, abs=1e-6)
    assert joint.path.length == pytest.approx(1.8, abs=1e-4)
    assert sorted(joint.legs) == pytest.approx([0.8, 1.0], abs=0.03)
    assert abs(joint.path.leg_directions[0] @ joint.path.leg_directions[1]) == pytest.approx(
        abs(np.cos(a)), abs=1e-6
    )


def frame_and_panel(grow=0.0):
    """A panel 1.0 x 1.5 in a wall's opening 20 mm wider all round, whose reveal opens by ``grow``."""
    hole = SOLID.extrude(
        SECTION.square((1.04, 1.54), True), 0.1, 0, 0, (1 + 2 * grow / 1.04, 1 + 2 * grow / 1.54)
    )
    wall = SOLID.cube((3, 3, 0.1)).translate((-1.5, -1.5, 0)) - hole.scale((1, 1, 1.0001))
    return wall, SOLID.cube((1, 1.5, 0.1)).translate((-0.5, -0.75, 0))


@pytest.mark.parametrize("degrees", [0.0, 5.0, 9.0])
def test_a_perimeter_is_one_ring_square_or_tapered(degrees):
    grow = 0.1 * np.tan(np.radians(degrees))
    (joint,) = find_joints(model(*map(of, frame_and_panel(grow))))
    assert joint.path.closed
    assert joint.kind == ("tapered" if degrees else "square-butt")
    assert joint.length == pytest.approx(5.0, abs=0.01)
    assert joint.widths == pytest.approx((0.02, 0.02 + grow), abs=4e-4)
    assert joint.two_sided
    if degrees:  # it opens towards the mouth
        assert np.all(joint.path.v[:, 2] > 0.99)


def test_a_disc_in_a_conic_hole_is_a_tapered_ring():
    hole = SOLID.cylinder(0.1002, 0.615, 0.622, 72).translate((0, 0, -1e-4))
    plate = SOLID.cube((3, 3, 0.1)).translate((-1.5, -1.5, 0)) - hole
    (joint,) = find_joints(model(of(plate), of(SOLID.cylinder(0.1, 0.6, 0.6, 72))))
    assert joint.kind == "tapered"
    assert joint.path.closed
    assert joint.path.curved
    assert joint.width == pytest.approx(0.0185, abs=2e-4)
    assert joint.length == pytest.approx(2 * np.pi * 0.6, rel=0.01)


def test_fillers_of_every_shape_are_named():
    wall, panel = frame_and_panel()
    outer = SOLID.cube((1.04, 1.54, 0.02)).translate((-0.52, -0.77, 0.08))
    seal = outer - SOLID.cube((1, 1.5, 1)).translate((-0.5, -0.75, -0.5))
    found = find_joints(model(of(wall), of(panel), of(seal)))
    (ring,) = [joint for joint in found if joint.elements == ("GUID0", "GUID1")]
    assert (ring.state, ring.filler, ring.path.closed) == ("filled", "GUID2", True)
    boards = box((-0.2, 0, 0), (-0.01, 1, 0.025)), box((0.01, 0, 0), (0.2, 1, 0.025))
    rod = of(SOLID.cylinder(1, 0.006, 0.006, 24).rotate((-90, 0, 0)).translate((0, 0, 0.0125)))
    thin = box((-0.0095, 0, 0.015), (0.0095, 1, 0.025))  # half a millimetre of air on either side
    for filler in (rod, thin):
        (joint,) = [j for j in find_joints(model(*boards, filler)) if j.elements == ("GUID0", "GUID1")]
        assert (joint.state, joint.filler) == ("filled", "GUID2")
        assert joint.width == pytest.approx(0.02, abs=1e-9)


def test_a_mortar_bed_is_the_filler_of_both_blocks_above_it():
    bed = box((-0.5, 0, 0.1), (0.5, 0.2, 0.11))
    below, left, right = (
        box((-0.5, 0, 0), (0.5, 0.2, 0.1)),
        box((-0.5, 0, 0.11), (-0.005, 0.2, 0.2)),
        box((0.005, 0, 0.11), (0.5, 0.2, 0.2)),
    )
    found = {j.elements: j for j in find_joints(model(below, left, right, bed))}
    for pair in (("GUID0", "GUID1"), ("GUID0", "GUID2")):
        assert (found[pair].state, found[pair].filler) == ("filled", "GUID3")
        assert found[pair].width == pytest.approx(0.01, abs=1e-9)
    assert (found["GUID1", "GUID2"].state, found["GUID1", "GUID2"].filler) == ("open", None)
    assert found["GUID0", "GUID3"].state == "touch"


ROOT_SAMPLE = "facade.ifc"


def renumbered(text, rng):
    """The same STEP file with its entities under other numbers and in another order."""
    head, data, tail = re.split(r"(?<=DATA;\n)|(?=ENDSEC;\nEND-ISO)", text)
    lines = data.strip().split("\n")
    old = [int(line[1 : line.index("=")]) for line in lines]
    new = dict(zip(old, (rng.permutation(len(old)) * 7 + 1000).tolist(), strict=True))
    lines = [re.sub(r"#(\d+)", lambda m: f"#{new[int(m.group(1))]}", line) for line in lines]
    return head + "\n".join(lines[k] for k in rng.permutation(len(lines))) + "\n" + tail


def test_ids_stay_when_the_file_is_saved_again_under_other_numbers(samples, tmp_path):
    text = (samples / ROOT_SAMPLE).read_text()
    again = tmp_path / "again.ifc"
    again.write_text(renumbered(text, np.random.default_rng(2)))
    assert again.read_text() != text
    one, two = (find_joints(load_model(path, cache=False)) for path in (samples / ROOT_SAMPLE, again))
    assert len(one) == 17
    assert [(j.id, j.elements, j.kind) for j in one] == [(j.id, j.elements, j.kind) for j in two]
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a.path.points, b.path.points, atol=1e-9)
        np.testing.assert_allclose(a.path.v, b.path.v, atol=1e-9)


def test_decomposed_walls_meet_part_by_part_and_the_filler_is_told_to_the_user(samples, tmp_path, capsys):
    file = ifcopenshell.open(samples / "square-butt-ifc4.ifc")
    a, b = sorted(file.by_type("IfcPlate"), key=lambda plate: plate.Name)
    body = a.Representation.Representations[0]
    wholes = []
    for plate in (a, b):  # each plate becomes a part of a wall without a body of its own
        whole = file.create_entity("IfcWall", ifcopenshell.guid.new(), Name=f"Wall of {plate.Name}")
        file.create_entity(
            "IfcRelAggregates", ifcopenshell.guid.new(), RelatingObject=whole, RelatedObjects=[plate]
        )
        wholes.append(whole)
    point = file.create_entity("IfcCartesianPoint", (0.0, 0.0375))
    axes = file.create_entity("IfcAxis2Placement2D", point)
    profile = file.create_entity("IfcRectangleProfileDef", "AREA", None, axes, 0.025, 0.01)
    old = body.Items[0]
    solid = file.create_entity(
        "IfcExtrudedAreaSolid", profile, old.Position, old.ExtrudedDirection, old.Depth
    )
    shape = file.create_entity("IfcShapeRepresentation", body.ContextOfItems, "Body", "SweptSolid", [solid])
    seal = file.create_entity("IfcBuildingElementProxy", ifcopenshell.guid.new(), Name="Sealant")
    seal.Representation = file.create_entity("IfcProductDefinitionShape", None, None, [shape])
    seal.ObjectPlacement = a.ObjectPlacement
    file.write(str(tmp_path / "filled.ifc"))
    assert main(["joints", str(tmp_path / "filled.ifc"), "--json"]) == 0
    joints = json.loads(capsys.readouterr().out)
    pair = sorted((a.GlobalId, b.GlobalId))
    (joint,) = [one for one in joints if one["elements"] == pair]
    assert joint["state"] == "filled"
    assert (joint["filler"], joint["filler_name"]) == (seal.GlobalId, "Sealant")
    assert joint["names"] == [file.by_guid(guid).Name for guid in pair]
    assert not {whole.GlobalId for whole in wholes} & {guid for one in joints for guid in one["elements"]}
    assert main(["joints", str(tmp_path / "filled.ifc")]) == 0
    assert f"filled with {seal.GlobalId} Sealant" in capsys.readouterr().out
