"""As-built models: valid, complete, in the project's units, and the input untouched."""

import math
from pathlib import Path

import ifcopenshell
import ifcopenshell.geom
import ifcopenshell.util.element
import ifcopenshell.validate
import numpy as np
import pytest
import trimesh

from bimfit.bim.as_built import DEVIATION_SET, GAP_QUANTITIES, GAP_SET, AsBuiltGap, write_as_built
from bimfit.errors import ExportError, JointError, ModelError
from bimfit.geometry.mesh import TriangleMesh

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "ifc_samples"
REAL = ROOT.parent / "shared" / "data" / "ifc"
SCHEMAS = {"square-butt-ifc2x3.ifc": 1e3, "square-butt-ifc4.ifc": 1.0, "square-butt-ifc4x3.ifc": 1e3}


def messages(path, *, rules=False):
    logger = ifcopenshell.validate.json_logger()
    ifcopenshell.validate.validate(ifcopenshell.open(path), logger, express_rules=rules)
    return [str(statement.get("message", statement)) for statement in logger.statements]


def world_mesh(element):
    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    geometry = ifcopenshell.geom.create_shape(settings, element).geometry
    return trimesh.Trimesh(
        np.array(geometry.verts).reshape(-1, 3), np.array(geometry.faces).reshape(-1, 3), process=True
    )


def two_bodies(shift=(0.0, 0.0, 0.0)):
    parts = [trimesh.creation.box((0.025, 0.4, 0.025)) for _ in range(2)]
    parts[0].apply_translation(np.add((0.001, 0.2, 0.0375), shift))
    parts[1].apply_translation(np.add((0.001, 0.61, 0.0375), shift))
    whole = trimesh.util.concatenate(parts)
    return TriangleMesh.of(whole.vertices, whole.faces)


def boards(path):
    return tuple(sorted(e.GlobalId for e in ifcopenshell.open(path).by_type("IfcPlate")))


def gap_of(path, **more):
    values = {
        "id": "J1", "kind": "square-butt", "elements": boards(path), "status": "ok", "designed_width": 0.025,
        "width_min": 0.0215, "width_mean": 0.0243, "width_max": 0.0291, "width_sigma": 0.0004, "length": 0.82,
        "area": 6.1e-4, "volume": 5.0e-4, "volume_sigma": 3e-6, "stations": 82, "measured": 80,
        "mesh": two_bodies(),
    }  # fmt: skip
    return AsBuiltGap(**{**values, **more})


@pytest.mark.parametrize("name", SCHEMAS)
def test_every_schema(name, tmp_path):
    source = SAMPLES / name
    before = source.read_bytes()
    output = write_as_built(source, [gap_of(source)], tmp_path / "as-built.ifc")
    assert source.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["as-built.ifc"]
    assert messages(output) == []
    old, new = ifcopenshell.open(source), ifcopenshell.open(output)
    assert new.schema_identifier == old.schema_identifier
    kept = {root.GlobalId: root for root in new.by_type("IfcRoot")}
    for root in old.by_type("IfcRoot"):
        assert kept[root.GlobalId].is_a() == root.is_a()
        assert kept[root.GlobalId].Name == root.Name
    (gap,) = new.by_type("IfcVirtualElement")
    storey = ifcopenshell.util.element.get_container(gap)
    assert storey == ifcopenshell.util.element.get_container(new.by_type("IfcPlate")[0])
    tied = {
        r.RelatingElement.GlobalId for r in new.by_type("IfcRelConnectsElements") if r.RelatedElement == gap
    }
    assert tied == set(boards(source))
    mesh = world_mesh(gap)
    wanted = two_bodies()
    assert mesh.body_count == 2
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(wanted.volume, rel=1e-9)
    np.testing.assert_allclose(mesh.bounds, wanted.bounds, atol=1e-9)


@pytest.mark.parametrize("name", SCHEMAS)
def test_figures_are_in_the_projects_units(name, tmp_path):
    unit = SCHEMAS[name]
    output = write_as_built(SAMPLES / name, [gap_of(SAMPLES / name)], tmp_path / "out.ifc")
    new = ifcopenshell.open(output)
    (gap,) = new.by_type("IfcVirtualElement")
    found = ifcopenshell.util.element.get_psets(gap)
    properties, quantities = found[GAP_SET], found[GAP_QUANTITIES]
    for key, metres in {
        "DesignedWidth": 0.025, "WidthMin": 0.0215, "WidthMean": 0.0243, "WidthMax": 0.0291,
        "WidthSigma": 0.0004, "Length": 0.82,
    }.items():  # fmt: skip
        assert properties[key] == pytest.approx(metres * unit, rel=1e-12), key
    assert (properties["Area"], properties["Volume"]) == pytest.approx(
        (6.1e-4, 5.0e-4)
    )  # m2, m3 in all three
    assert (properties["Status"], properties["Kind"], properties["JointId"]) == ("ok", "square-butt", "J1")
    assert (properties["Stations"], properties["MeasuredStations"]) == (82, 80)
    assert quantities["Width"] == pytest.approx(0.0243 * unit, rel=1e-12)
    assert quantities["Volume"] == pytest.approx(5.0e-4)


# ifcopenshell leaves the file of its rules open
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
def test_express_rules_hold(tmp_path):
    source = SAMPLES / "square-butt-ifc4.ifc"
    output = write_as_built(source, [gap_of(source)], tmp_path / "out.ifc")
    assert messages(output, rules=True) == []


def test_what_is_not_known_is_left_out(tmp_path):
    source = SAMPLES / "square-butt-ifc4.ifc"
    bare = AsBuiltGap("J1", "square-butt", boards(source), "no_data", 0.025, "no returns near the joint")
    output = write_as_built(source, [bare], tmp_path / "out.ifc")
    assert messages(output) == []
    new = ifcopenshell.open(output)
    (gap,) = new.by_type("IfcVirtualElement")
    found = ifcopenshell.util.element.get_psets(gap)
    assert gap.Representation is None
    assert GAP_QUANTITIES not in found
    assert set(found[GAP_SET]) - {"id"} == {
        "JointId", "Kind", "Status", "Reason", "DesignedWidth", "Stations", "MeasuredStations",
    }  # fmt: skip
    assert found[GAP_SET]["Reason"] == "no returns near the joint"


def test_overlap_is_a_property_but_no_quantity(tmp_path):
    source = SAMPLES / "square-butt-ifc4.ifc"
    output = write_as_built(source, [gap_of(source, width_min=-0.002)], tmp_path / "out.ifc")
    new = ifcopenshell.open(output)
    (gap,) = new.by_type("IfcVirtualElement")
    found = ifcopenshell.util.element.get_psets(gap)
    assert found[GAP_SET]["WidthMin"] == pytest.approx(-0.002)
    assert "WidthMin" not in found[GAP_QUANTITIES]


@pytest.mark.parametrize("name", ["square-butt-ifc2x3.ifc", "square-butt-ifc4x3.ifc"])
def test_an_as_built_model_can_be_written_to_again(name, tmp_path):
    source = SAMPLES / name
    once = write_as_built(source, [gap_of(source)], tmp_path / "once.ifc")
    same = write_as_built(source, [gap_of(source)], tmp_path / "same.ifc")
    twice = write_as_built(once, [gap_of(source)], tmp_path / "twice.ifc")
    assert messages(twice) == []
    ids = [
        [e.GlobalId for e in ifcopenshell.open(p).by_type("IfcVirtualElement")] for p in (once, same, twice)
    ]
    assert ids[0] == ids[1]  # the same joint keeps its GlobalId from run to run
    assert len(set(ids[2])) == 2


def turned(angle, shift, pivot):
    T = np.eye(4)
    T[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    T[:3, 3] = np.add(pivot, shift) - T[:3, :3] @ pivot
    return T


def test_moved_components_stand_where_the_motion_takes_them(tmp_path):
    source = SAMPLES / "facade.ifc"
    panels = {e.Name: e.GlobalId for e in ifcopenshell.open(source).by_type("IfcWall")}
    # panel 1.2 has a window, whose opening must come along
    T = turned(0.01, (0.004, -0.003, 0.002), (3.02, 0.0, 0.0))
    output = write_as_built(source, [], tmp_path / "out.ifc", moved={panels["Panel 1.2"]: T})
    assert messages(output) == []
    old, new = ifcopenshell.open(source), ifcopenshell.open(output)
    for name, guid in panels.items():
        before, after = world_mesh(old.by_guid(guid)), world_mesh(new.by_guid(guid))
        wanted = before.copy()
        if name == "Panel 1.2":
            wanted.apply_transform(T)
        assert after.volume == pytest.approx(before.volume, rel=1e-9), name
        np.testing.assert_allclose(after.bounds, wanted.bounds, atol=1e-8, err_msg=name)
    assert world_mesh(new.by_guid(panels["Panel 1.2"])).volume < 3.0 * 2.98 * 0.14 - 0.2
    found = ifcopenshell.util.element.get_psets(new.by_guid(panels["Panel 1.2"]))[DEVIATION_SET]
    assert (found["ShiftX"], found["ShiftY"], found["ShiftZ"]) == pytest.approx((4.0, -3.0, 2.0), abs=1e-6)
    assert found["Distance"] == pytest.approx(math.sqrt(29.0), abs=1e-6)
    assert found["Rotation"] == pytest.approx(0.01, abs=1e-9)


def test_map_coordinates_keep_their_precision(tmp_path):
    source = SAMPLES / "square-butt-ifc2x3.ifc"
    east = (458657.123456, 5438232.654321, 112.0)
    output = write_as_built(source, [gap_of(source, mesh=two_bodies(east))], tmp_path / "out.ifc")
    new = ifcopenshell.open(output)
    (gap,) = new.by_type("IfcVirtualElement")
    assert messages(output) == []
    origin = np.array(gap.ObjectPlacement.RelativePlacement.Location.Coordinates) * 1e-3
    np.testing.assert_array_equal(origin, np.floor(two_bodies(east).bounds[0]))
    brep = gap.Representation.Representations[0].Items[0]
    local = [p.Coordinates for face in brep.Outer.CfsFaces for p in face.Bounds[0].Bound.Polygon]
    low = origin + np.min(local, axis=0) * 1e-3
    np.testing.assert_allclose(low, two_bodies(east).bounds[0], atol=2e-9)


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"elements": ("0IjRD_pxn9aRaRUWq6Ebnq", "2geNRwqjn30uvGChtbfnYT")}, JointError, "0IjRD_pxn9"),
        ({"elements": ("no GlobalId at all", "x")}, JointError, "no GlobalId at all"),
    ],
)
def test_unknown_elements_leave_no_file(change, error, text, tmp_path):
    source = SAMPLES / "square-butt-ifc4.ifc"
    with pytest.raises(error, match=text):
        write_as_built(source, [gap_of(source, **change)], tmp_path / "out.ifc")
    assert list(tmp_path.iterdir()) == []


def test_the_input_is_never_overwritten(tmp_path):
    source = tmp_path / "model.ifc"
    source.write_bytes((SAMPLES / "square-butt-ifc4.ifc").read_bytes())
    before = source.read_bytes()
    with pytest.raises(ExportError, match="input"):
        write_as_built(source, [], source)
    link = tmp_path / "link.ifc"
    link.symlink_to(source)
    with pytest.raises(ExportError, match="input"):
        write_as_built(source, [], link)
    assert source.read_bytes() == before


def test_what_is_no_model_is_refused(tmp_path):
    bad = tmp_path / "bad.ifc"
    bad.write_text("nothing of the kind")
    with pytest.raises(ModelError):
        write_as_built(bad, [], tmp_path / "out.ifc")
    assert not (tmp_path / "out.ifc").exists()


def test_a_motion_that_is_none_is_refused(tmp_path):
    source = SAMPLES / "square-butt-ifc4.ifc"
    with pytest.raises(ExportError, match="4 x 4"):
        write_as_built(source, [], tmp_path / "out.ifc", moved={boards(source)[0]: np.full((4, 4), np.nan)})


@pytest.mark.parametrize(
    ("name", "elements"),
    [
        ("MULTICOM-banden.ifc", ("1L6a$l0008y34qCZStEJCr", "1L6a$l00091J4qCZStEJCr")),
        ("XELLA-3e_verdieping.ifc", ("0IjRD_pxn9aRaRUWq6Ebnq", "2geNRwqjn30uvGChtbfnYT")),
    ],
)
def test_real_models_get_no_new_messages(name, elements, tmp_path):
    if not (REAL / name).exists():
        pytest.skip("the shared models are not there")
    gap = AsBuiltGap("J1", "square-butt", elements, "ok", 0.01, width_mean=0.0102, mesh=two_bodies())
    T = turned(0.01, (0.004, -0.003, 0.002), (4.5, 6.6, 6.7))
    output = write_as_built(REAL / name, [gap], tmp_path / "out.ifc", moved={elements[0]: T})
    assert sorted(messages(output)) == sorted(messages(REAL / name))
    old, new = ifcopenshell.open(REAL / name), ifcopenshell.open(output)
    before, after = world_mesh(old.by_guid(elements[0])), world_mesh(new.by_guid(elements[0]))
    before.apply_transform(T)
    np.testing.assert_allclose(after.bounds, before.bounds, atol=1e-6)
    other = (world_mesh(model.by_guid(elements[1])).bounds for model in (old, new))
    np.testing.assert_allclose(*other, atol=1e-9)
    (made,) = [e for e in new.by_type("IfcVirtualElement") if e.ObjectType == "AsBuiltGap"]
    np.testing.assert_allclose(world_mesh(made).bounds, two_bodies().bounds, atol=1e-8)
