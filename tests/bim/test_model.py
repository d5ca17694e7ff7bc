"""The loader: every state that a file can be in ends in a model or in one clear line."""

import dataclasses
import zipfile
from pathlib import Path

import ifcopenshell
import numpy as np
import pytest

from bimfit.bim import loading
from bimfit.bim.cache import cache_path
from bimfit.bim.drafts import Limits
from bimfit.bim.georeference import GeoReference, map_scale
from bimfit.bim.joint_store import store_key
from bimfit.bim.joints import find_joints
from bimfit.bim.model import element_from_mesh, load_model, model_from_elements
from bimfit.bim.source import nearest_schema, read_source
from bimfit.cli.main import main
from bimfit.config import JointConfig
from bimfit.errors import JointError, ModelError
from bimfit.geometry.mesh import TriangleMesh
from bimfit.pipeline.bench_fuzz import MUTATIONS, mutated, try_case

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "ifc_samples"
REAL = ROOT.parent / "shared" / "data" / "ifc"
BUTT = SAMPLES / "square-butt-ifc4.ifc"

needs_data = pytest.mark.skipif(not REAL.is_dir(), reason="../shared/data/ifc is not here")


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("BIMFIT_CACHE", str(tmp_path / "cache"))


def altered(tmp_path, old, new, name="model.ifc", source=BUTT):
    data = source.read_bytes()
    assert old in data
    (tmp_path / name).write_bytes(data.replace(old, new))
    return tmp_path / name


def test_elements_in_world_metres():
    model = load_model(SAMPLES / "square-butt-ifc2x3.ifc")  # in millimetres
    assert model.schema == "IFC2X3"
    assert [(e.name, e.ifc_class, e.storey) for e in sorted(model.elements, key=lambda e: e.name)] == [
        ("Board A", "IfcPlate", "Ground floor"),
        ("Board B", "IfcPlate", "Ground floor"),
    ]
    np.testing.assert_allclose(model.bounds, [[-0.2125, 0, 0.025], [0.2125, 0.82, 0.05]], atol=1e-9)
    for element in model.elements:
        assert len(element.mesh.vertices) == 8  # merged
        assert element.mesh.volume == pytest.approx(0.2 * 0.82 * 0.025)
    assert [e.guid for e in model.elements] == sorted(e.guid for e in model.elements)


def test_schemas_that_the_parser_refuses_are_read_as_the_nearest(tmp_path):
    path = altered(tmp_path, b"'IFC4'", b"'IFC4X1'")
    with pytest.raises(ifcopenshell.SchemaError):
        ifcopenshell.open(path)
    model = load_model(path)
    assert len(model.elements) == 2
    assert model.schema == "IFC4X1"
    assert model.notes == ("schema IFC4X1 was read as IFC4X3_ADD2",)
    names = {
        "IFC2X3_FINAL": "IFC2X3",
        "IFC2X3_TC1": "IFC2X3",
        "IFC4_ADD2": "IFC4",
        "IFC4X2": "IFC4X3_ADD2",
        "IFC4X3": "IFC4X3_ADD2",
        "IFC4X3_ADD1": "IFC4X3_ADD2",
        "IFC4X3_TC1": "IFC4X3_ADD2",
        "IFC4X3_RC4": "IFC4X3_ADD2",
        "AP214": None,
        "IFC5": None,
    }
    assert {name: nearest_schema(name) for name in names} == names


@pytest.mark.parametrize("schema", ["IFC4X3", "IFC4X3_TC1", "IFC2X3_FINAL"])
def test_each_refused_schema_loads_whole(tmp_path, schema):
    source = SAMPLES / f"square-butt-ifc{'2x3' if '2X3' in schema else '4x3'}.ifc"
    stated = b"'IFC2X3'" if "2X3" in schema else b"'IFC4X3_ADD2'"
    path = altered(tmp_path, stated, f"'{schema}'".encode(), source=source)
    with pytest.raises(ifcopenshell.SchemaError):
        ifcopenshell.open(path)
    model = load_model(path)
    assert len(model.elements) == 2
    assert schema in model.notes[0]


def test_types_that_the_schema_lacks_are_kept_or_named(tmp_path):
    # IFC4X1 has the subtypes of IFC4 that IFC4X3 dropped
    path = altered(tmp_path, b"IFCPLATE(", b"IFCPLATESTANDARDCASE(")
    path = altered(tmp_path, b"'IFC4'", b"'IFC4X1'", source=path)
    assert [e.ifc_class for e in load_model(path).elements] == ["IfcPlate", "IfcPlate"]
    data = BUTT.read_bytes().replace(b"IFCPLATE(", b"IFCBUILTELEMENT(", 1)
    path.write_bytes(data)
    model = load_model(path)
    assert len(model.elements) == 1
    assert model.notes == ("1 entities of types that IFC4 does not know were not read: IFCBUILTELEMENT",)


def test_a_file_cut_off_is_said_to_be(tmp_path):
    data = BUTT.read_bytes()
    path = tmp_path / "cut.ifc"
    path.write_bytes(data[: data.index(b"ENDSEC;", data.index(b"DATA;")) - 1])
    try:
        assert any("cut off" in note for note in load_model(path).notes)
    except ModelError as error:
        assert "export it again" in str(error)
    path.write_bytes(data[: data.index(b"END-ISO")])
    assert any("cut off" in note for note in load_model(path).notes)


def open_box(low, high, lost, turned):
    corners = [
        (x, y, z)
        for z in (low[2], high[2])
        for x, y in zip((low[0], high[0], high[0], low[0]), (low[1], low[1], high[1], high[1]), strict=True)
    ]
    sides = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    faces = [t for k, (a, b, c, d) in enumerate(sides) if k != lost for t in ((a, b, c), (a, c, d))]
    return corners, [face[::-1] if k in turned else face for k, face in enumerate(faces)]


@pytest.mark.parametrize("turned", [range(10), (0, 3, 5, 8)], ids=["inside out", "mixed"])
def test_open_bodies_of_any_winding_make_the_joint_that_is_there(tmp_path, turned):
    file = ifcopenshell.open(BUTT)
    a, b = sorted(file.by_type("IfcPlate"), key=lambda plate: plate.Name)
    origin = file.create_entity("IfcCartesianPoint", (0.0, 0.0, 0.0))
    for plate, low, high in ((a, -0.2125, -0.0125), (b, 0.0125, 0.2125)):
        corners, faces = open_box((low, 0.0, 0.025), (high, 0.82, 0.05), 1, set(turned))
        points = file.create_entity("IfcCartesianPointList3D", corners)
        indices = [[i + 1 for i in face] for face in faces]
        shape = plate.Representation.Representations[0]
        shape.Items = [file.create_entity("IfcTriangulatedFaceSet", Coordinates=points, CoordIndex=indices)]
        shape.RepresentationType = "Tessellation"
        plate.ObjectPlacement.RelativePlacement = file.create_entity("IfcAxis2Placement3D", origin)
    file.write(str(tmp_path / "open.ifc"))
    (joint,) = find_joints(load_model(tmp_path / "open.ifc"))
    assert (joint.state, joint.kind) == ("open", "square-butt")
    assert joint.width == pytest.approx(0.025, abs=1e-9)


def test_byte_order_mark_and_lower_case_schema(tmp_path):
    path = altered(tmp_path, b"'IFC4'", b"'ifc4'")
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    model = load_model(path)
    assert len(model.elements) == 2
    assert "byte-order mark" in model.notes[0]


def test_zip(tmp_path):
    with zipfile.ZipFile(tmp_path / "model.ifczip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(BUTT, "inner.ifc")
    assert len(load_model(tmp_path / "model.ifczip").elements) == 2


def test_hostile_archives_are_refused(tmp_path):
    bomb = tmp_path / "bomb.ifczip"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("inner.ifc", b"ISO-10303-21;" + b" " * 30_000_000)
    with pytest.raises(ModelError, match="far more than an IFC"):
        load_model(bomb)
    damaged = tmp_path / "damaged.ifczip"
    damaged.write_bytes(bomb.read_bytes()[:5000])
    with pytest.raises(ModelError, match="damaged archive"):
        load_model(damaged)
    two = tmp_path / "two.ifczip"
    with zipfile.ZipFile(two, "w") as archive:
        archive.write(BUTT, "a.ifc")
        archive.write(BUTT, "b.ifc")
    with pytest.raises(ModelError, match=r"2 \.ifc files"):
        load_model(two)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "cannot be read: No such file"),
        (b"", "is empty"),
        (b" \n ", "is empty"),
        (b"x,y,z\n1,2,3\n", "not an IFC file"),
        (b"\x00\x01\x02" * 500, "not an IFC file"),
        (b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><ifcXML/>', "is XML"),
        (b'{"type": "ifcJSON"}', "is JSON"),
        (b"ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\nENDSEC;\nEND-ISO-10303-21;\n", "names no schema"),
        (b"ISO-10303-21;\nHEADER;\nFILE_SCHEMA(('AP214'));\nENDSEC;\n", "schema AP214"),
    ],
)
def test_what_is_no_model_is_refused_in_one_line(tmp_path, content, says):
    path = tmp_path / "model.ifc"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ModelError) as caught:
        load_model(path)
    line = str(caught.value)
    assert says in line
    assert str(path) in line
    assert "\n" not in line


def test_a_folder_is_refused(tmp_path):
    with pytest.raises(ModelError, match="folder"):
        load_model(tmp_path)


def test_without_geometry(tmp_path):
    file = ifcopenshell.open(BUTT)
    for product in file.by_type("IfcPlate"):
        product.Representation = None
    file.write(str(tmp_path / "bare.ifc"))
    with pytest.raises(ModelError, match="none of its 2 elements has a representation"):
        load_model(tmp_path / "bare.ifc")
    for product in file.by_type("IfcPlate"):
        file.remove(product)
    file.write(str(tmp_path / "none.ifc"))
    with pytest.raises(ModelError, match="no building element with geometry"):
        load_model(tmp_path / "none.ifc")


def test_one_bad_body_is_skipped_and_listed(tmp_path):
    file = ifcopenshell.open(BUTT)
    solid = file.by_type("IfcExtrudedAreaSolid")[0]
    solid.Depth = 1e300
    file.write(str(tmp_path / "bad.ifc"))
    model = load_model(tmp_path / "bad.ifc")
    assert len(model.elements) == 1
    assert len(model.skipped) == 1
    assert model.skipped[0].reason
    with pytest.raises(JointError, match="was left out"):
        model.element(model.skipped[0].guid)


def test_unknown_guid_names_the_nearest():
    model = load_model(BUTT)
    guid = model.elements[0].guid
    with pytest.raises(JointError) as caught:
        model.element(guid[:-1] + "!")
    assert guid in str(caught.value)
    assert model.element(guid) is model.elements[0]


def test_parts_stand_for_their_whole(tmp_path):
    file = ifcopenshell.open(BUTT)
    whole, part = file.by_type("IfcPlate")
    file.create_entity(
        "IfcRelAggregates", ifcopenshell.guid.new(), RelatingObject=whole, RelatedObjects=[part]
    )
    file.write(str(tmp_path / "parts.ifc"))
    model = load_model(tmp_path / "parts.ifc")
    assert [(e.guid, e.parent_guid) for e in model.elements] == [(part.GlobalId, whole.GlobalId)]
    with pytest.raises(JointError, match="made of parts"):
        model.element(whole.GlobalId)


def test_include_takes_guids_and_classes():
    model = load_model(SAMPLES / "t-joint.ifc", include=["IfcMember"])
    assert [e.ifc_class for e in model.elements] == ["IfcMember"]
    guid = model.elements[0].guid
    assert [e.guid for e in load_model(SAMPLES / "t-joint.ifc", include=[guid]).elements] == [guid]


def test_cache_gives_the_same_and_survives_damage(monkeypatch):
    first = load_model(BUTT)
    path = cache_path(read_source(BUTT).digest)
    assert path.is_file()

    def forbidden(*_):
        raise AssertionError("tessellated again")

    with monkeypatch.context() as patch:
        patch.setattr("bimfit.bim.model.tessellate", forbidden)
        second = load_model(BUTT)
    for a, b in zip(first.elements, second.elements, strict=True):
        assert (a.guid, a.name, a.storey) == (b.guid, b.name, b.storey)
        np.testing.assert_array_equal(a.mesh.vertices, b.mesh.vertices)
        np.testing.assert_array_equal(a.mesh.faces, b.mesh.faces)
    whole = path.read_bytes()
    for damage in (whole[: len(whole) // 2], b"", whole[:200] + b"\xff" * 60 + whole[260:]):
        path.write_bytes(damage)
        assert len(load_model(BUTT).elements) == 2


def plain(joints):
    return [
        (joint.to_dict(), joint.legs, joint.path.points.tolist(), joint.path.v.tolist()) for joint in joints
    ]


def test_joints_come_out_of_the_cache_as_they_went_in(monkeypatch):
    model = load_model(SAMPLES / "facade.ifc")
    first = find_joints(model)
    assert len(first) == 17

    def forbidden(*_):
        raise AssertionError("searched again")

    with monkeypatch.context() as patch:
        patch.setattr("bimfit.bim.joints._joints", forbidden)
        assert plain(find_joints(load_model(SAMPLES / "facade.ifc"))) == plain(first)
        # other settings, another finder and models that are not to be kept are searched
        for config in (
            JointConfig(max_gap=0.03),
            JointConfig(min_length=2.99),
            JointConfig(classes=("IfcWall",)),
        ):
            if config.classes:  # all of them are walls: the same search
                assert plain(find_joints(model, config)) == plain(first)
                continue
            with pytest.raises(AssertionError, match="searched again"):
                find_joints(model, config)
        with pytest.raises(AssertionError, match="searched again"):
            find_joints(load_model(SAMPLES / "facade.ifc", cache=False))
        patch.setattr("bimfit.bim.joint_store._finder_version", lambda: "another")
        with pytest.raises(AssertionError, match="searched again"):
            find_joints(model)


def test_a_moved_vertex_is_another_search_and_damage_is_repaired():
    model = load_model(BUTT)
    limits, all_ = Limits(), np.ones(2, bool)
    key = store_key(model.elements, all_, limits)
    first, second = model.elements
    moved = dataclasses.replace(first, mesh=TriangleMesh.of(first.mesh.vertices + 1e-9, first.mesh.faces))
    assert store_key([moved, second], all_, limits) != key
    assert store_key(model.elements, np.array([True, False]), limits) != key
    assert store_key(model.elements, all_, Limits(max_gap=0.05)) != key
    before = plain(find_joints(model))
    (file,) = cache_path("").parent.glob("*.joints.npz")
    whole = file.read_bytes()
    for damage in (whole[: len(whole) // 2], b"", whole[:300] + b"\xff" * 60 + whole[360:]):
        file.write_bytes(damage)
        assert plain(find_joints(model)) == before


def test_no_cache_leaves_no_trace(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("BIMFIT_CACHE", str(tmp_path / "unused"))
    assert main(["joints", str(BUTT), "--no-cache"]) == 0
    assert not (tmp_path / "unused").exists()
    assert main(["joints", str(BUTT)]) == 0
    assert len(list((tmp_path / "unused").iterdir())) == 2
    assert "in 2 elements: 1 open" in capsys.readouterr().out


def test_what_was_left_out_is_said_to_the_user(tmp_path, capsys):
    file = ifcopenshell.open(SAMPLES / "facade.ifc")
    panel = file.by_type("IfcWall")[0]
    panel.Representation.Representations[0].Items[0].Depth = 1e300
    file.write(str(tmp_path / "bad.ifc"))
    path = altered(tmp_path, b"'IFC4'", b"'IFC4X1'", source=tmp_path / "bad.ifc")
    assert main(["joints", str(path), "--json"]) == 0
    said = capsys.readouterr().err
    assert "schema IFC4X1 was read as IFC4X3_ADD2" in said
    assert f"left out: {panel.GlobalId} {panel.Name} (IfcWall): it " in said


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("BIMFIT_CACHE", str(tmp_path / "file" / "below"))
    assert len(load_model(BUTT).elements) == 2
    monkeypatch.setenv("BIMFIT_CACHE", str(tmp_path / "unused"))
    load_model(BUTT, cache=False)
    assert not (tmp_path / "unused").exists()


GUARDED = """
import json, os, sys, time
import bimfit.bim.tessellate as child
real = child._send_shape
def strange(shape, number, out):
    if number == {guilty}:
        {act}
    real(shape, number, out)
child._send_shape = strange
child.main()
"""


@pytest.mark.parametrize(("act", "reason"), [("os.abort()", "crashed"), ("time.sleep(60)", "took more than")])
def test_a_kernel_that_crashes_or_hangs_loses_one_element(monkeypatch, act, reason):
    file = ifcopenshell.open(SAMPLES / "t-joint.ifc")
    guilty = file.by_type("IfcMember")[0]
    script = GUARDED.format(guilty=guilty.id(), act=act)
    real = loading.subprocess.Popen

    def popen(command, **rest):
        return real([command[0], "-c", script], **rest)

    monkeypatch.setattr(loading.subprocess, "Popen", popen)
    monkeypatch.setattr(loading, "_OPENING", 20.0)
    model = load_model(SAMPLES / "t-joint.ifc", time_limit=2.0, cache=False)
    assert [e.name for e in model.elements] == ["Base"]
    assert [s.guid for s in model.skipped] == [guilty.GlobalId]
    assert reason in model.skipped[0].reason


def test_a_parser_that_crashes_is_one_clear_line(monkeypatch):
    real = loading.subprocess.Popen
    monkeypatch.setattr(
        loading.subprocess,
        "Popen",
        lambda command, **rest: real([command[0], "-c", "import os; os.abort()"], **rest),
    )
    with pytest.raises(ModelError, match="crashed the parser"):
        load_model(BUTT, cache=False)


@pytest.mark.parametrize("number", range(len(MUTATIONS)))
def test_mutated_files_end_in_a_model_or_one_line(tmp_path, number):
    """A sample of ``bimfit bench --suite fuzz``: every mutation once."""
    case = try_case(4000 + number, tmp_path)
    assert case.good, case
    assert not list(tmp_path.iterdir())


def test_the_same_number_makes_the_same_file():
    assert [mutated(k) for k in range(len(MUTATIONS))] == [mutated(k) for k in range(len(MUTATIONS))]
    assert {mutated(k)[0] for k in range(len(MUTATIONS))} == set(MUTATIONS)
    # a damaged file is damaged: the study would prove nothing otherwise
    intact = {path.read_bytes() for path in SAMPLES.glob("*.ifc")}
    changed = [mutated(k)[1] not in intact for k in range(10 * len(MUTATIONS))]
    assert sum(changed) > 0.9 * len(changed)


def test_a_mesh_stands_in_for_an_element():
    mesh = TriangleMesh.of(np.eye(3), [[0, 1, 2]])
    a, b = element_from_mesh(mesh, "tube"), element_from_mesh(mesh, "plate")
    assert len(a.guid) == 22
    assert a.guid != b.guid
    assert element_from_mesh(mesh, "tube").guid == a.guid
    assert [e.guid for e in model_from_elements([a, b]).elements] == sorted([a.guid, b.guid])
    with pytest.raises(ModelError, match="same GlobalId"):
        model_from_elements([a, a])


def test_map_conversion_there_and_back():
    place = load_model(SAMPLES / "facade.ifc").georeference
    assert place == GeoReference(
        "EPSG:25832", 458657.21, 5438232.57, 112.4, pytest.approx(np.radians(27)), pytest.approx(1.0)
    )
    file = ifcopenshell.open(SAMPLES / "facade.ifc")
    import ifcopenshell.util.geolocation as geolocation

    point = np.array([10.0, 2.0, 3.0])
    # the oracle works in project units, millimetres
    east = geolocation.auto_xyz2enh(file, *(point * 1e3))
    np.testing.assert_allclose(place.to_map(point), east, atol=1e-6)
    np.testing.assert_allclose(place.to_project(place.to_map(point)), point, atol=1e-8)


@pytest.mark.parametrize(
    ("stated", "map_unit", "project_unit", "note"),
    [
        (0.001, 1.0, 0.001, ""),  # metres a millimetre: the standard's sense
        (1.0, 1.0, 1.0, ""),
        (1.0, 1.0, 0.001, "ratio of metres"),
        (0.9996, 1.0, 0.001, "ratio of metres"),
        (1000.0, 1.0, 0.001, "upside down"),
        (7.0, 1.0, 1.0, "makes no sense"),
    ],
)
def test_scale_is_read_in_the_sense_that_makes_sense(stated, map_unit, project_unit, note):
    scale, said = map_scale(stated, map_unit, project_unit)
    assert scale == pytest.approx(1.0, abs=1e-3)
    assert note in said
    assert bool(note) == bool(said)


@needs_data
def test_large_offsets_keep_their_precision():
    model = load_model(REAL / "large_offset.ifc")
    assert model.bounds[1].max() > 1e6
    wall = model.element("3UltsdvPH0afI77DdCyC7z")
    edges = np.linalg.norm(wall.mesh.triangles[:, 0] - wall.mesh.triangles[:, 1], axis=1)
    known = [1.05, 0.955, 0.213]
    known += [np.hypot(a, b) for a, b in ((1.05, 0.955), (1.05, 0.213), (0.955, 0.213))]
    assert np.abs(edges[:, None] - known).min(axis=1).max() < 1e-8


@needs_data
def test_a_second_map_conversion_and_the_property_set_form():
    place = load_model(REAL / "Duplex_A_20110907_georeferenced.ifc", include=["IfcSlab"]).georeference
    assert place.crs == "EPSG:9897"
    assert place.eastings == pytest.approx(76670.0)
    assert "ePSet" in place.source


def test_sizes_that_speak_for_a_wrong_unit_are_named(tmp_path):
    path = altered(
        tmp_path,
        b"IFCSIUNIT(*,.LENGTHUNIT.,.MILLI.,.METRE.)",
        b"IFCSIUNIT(*,.LENGTHUNIT.,$,.METRE.)",
        source=SAMPLES / "lap.ifc",
    )
    assert any("is its unit millimetre" in note for note in load_model(path).notes)
