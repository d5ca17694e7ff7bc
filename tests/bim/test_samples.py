"""The sample models: reproducible, valid, and of the sizes that their README states."""

import importlib.util
import math
from pathlib import Path

import ifcopenshell
import ifcopenshell.geom
import ifcopenshell.util.geolocation
import ifcopenshell.validate
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "ifc_samples"
NAMES = sorted(path.name for path in SAMPLES.glob("*.ifc"))
BUTTS = ["square-butt-ifc2x3.ifc", "square-butt-ifc4.ifc", "square-butt-ifc4x3.ifc"]


def messages(path, *, rules):
    logger = ifcopenshell.validate.json_logger()
    ifcopenshell.validate.validate(ifcopenshell.open(path), logger, express_rules=rules)
    return logger.statements


def meshes(name):
    """Name of every element -> (vertices, faces) in world metres."""
    model = ifcopenshell.open(SAMPLES / name)
    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    out = {}
    for element in model.by_type("IfcElement"):
        if not element.is_a("IfcOpeningElement"):
            geometry = ifcopenshell.geom.create_shape(settings, element).geometry
            vertices = np.array(geometry.verts).reshape(-1, 3)
            out[element.Name] = vertices, np.array(geometry.faces).reshape(-1, 3)
    return out


def boxes(name):
    return {key: np.stack([v.min(axis=0), v.max(axis=0)]) for key, (v, _) in meshes(name).items()}


def test_script_writes_the_same_bytes(tmp_path):
    spec = importlib.util.spec_from_file_location("make_samples", ROOT / "scripts" / "make_samples.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    written = script.main(tmp_path)
    assert sorted(path.name for path in written) == NAMES
    for path in written:
        assert path.read_bytes() == (SAMPLES / path.name).read_bytes(), path.name


@pytest.mark.parametrize("name", NAMES)
def test_follows_its_schema(name):
    assert messages(SAMPLES / name, rules=False) == []


# ifcopenshell leaves the file of its rules open
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.parametrize("name", ["square-butt-ifc2x3.ifc", "facade.ifc", "curved.ifc"])
def test_follows_the_express_rules(name):
    assert messages(SAMPLES / name, rules=True) == []


def test_validation_can_fail(tmp_path):
    # the guard of the tests above: a file with a doubled GlobalId is not passed over
    model = ifcopenshell.open(SAMPLES / "lap.ifc")
    first, second = model.by_type("IfcPlate")
    second.GlobalId = first.GlobalId
    model.write(str(tmp_path / "bad.ifc"))
    assert messages(tmp_path / "bad.ifc", rules=False)


def test_readme_names_every_file():
    text = (SAMPLES / "README.md").read_text("utf8")
    assert [name for name in NAMES if f"`{name}`" not in text] == []


@pytest.mark.parametrize("name", BUTTS)
def test_square_butt_is_the_papers(name):
    found = boxes(name)
    np.testing.assert_allclose(found["Board A"], [[-0.2125, 0, 0.025], [-0.0125, 0.82, 0.05]], atol=1e-9)
    np.testing.assert_allclose(found["Board B"], [[0.0125, 0, 0.025], [0.2125, 0.82, 0.05]], atol=1e-9)


def test_schemas_and_units_differ():
    schemas = {name: ifcopenshell.open(SAMPLES / name).schema_identifier for name in BUTTS}
    assert list(schemas.values()) == ["IFC2X3", "IFC4", "IFC4X3_ADD2"]
    prefixes = [ifcopenshell.open(SAMPLES / name).by_type("IfcSIUnit")[0].Prefix for name in BUTTS]
    assert prefixes == ["MILLI", None, "MILLI"]


def test_v_groove_opens_by_sixty_degrees():
    vertices, _ = meshes("v-groove.ifc")["Plate B"]
    bevel = vertices[(vertices[:, 0] < 0.1) & (vertices[:, 1] < 0.1)]
    top = bevel[np.argmax(bevel[:, 2])]
    middle = bevel[np.isclose(bevel[:, 2], 0.028)][0]
    assert math.degrees(math.atan2(top[0] - middle[0], top[2] - middle[2])) == pytest.approx(30.0, abs=1e-6)
    assert middle[0] == pytest.approx(0.0025, abs=1e-9)
    assert top[0] == pytest.approx(0.0025 + 0.022 * math.tan(math.pi / 6), abs=1e-9)


def test_lap_and_t_joint_gaps():
    found = boxes("lap.ifc")
    assert found["Upper board"][0, 2] - found["Lower board"][1, 2] == pytest.approx(0.006, abs=1e-9)
    assert found["Lower board"][1, 0] - found["Upper board"][0, 0] == pytest.approx(0.050, abs=1e-9)
    found = boxes("t-joint.ifc")
    assert found["Stem"][0, 2] - found["Base"][1, 2] == pytest.approx(0.012, abs=1e-9)


def test_mitre_faces_are_twenty_apart():
    found = meshes("mitre.ifc")
    across = np.array([1.0, -1.0, 0.0]) / math.sqrt(2.0)
    south, west = (found[name][0] @ across for name in ("South wall", "West wall"))
    assert south.min() == pytest.approx(0.010, abs=1e-9)
    assert west.max() == pytest.approx(-0.010, abs=1e-9)


def test_facade_has_its_joints_and_its_place_on_the_map():
    found = boxes("facade.ifc")
    assert len(found) == 12
    for row in range(1, 4):
        for column in range(1, 4):
            left, right = found[f"Panel {row}.{column}"], found[f"Panel {row}.{column + 1}"]
            assert right[0, 0] - left[1, 0] == pytest.approx(0.020, abs=1e-9)
    for column in range(1, 5):
        for row in range(1, 3):
            below, above = found[f"Panel {row}.{column}"], found[f"Panel {row + 1}.{column}"]
            assert above[0, 2] - below[1, 2] == pytest.approx(0.020, abs=1e-9)
    model = ifcopenshell.open(SAMPLES / "facade.ifc")
    # 10 m along the facade (project units: millimetres), against a turn worked out by hand
    east, north, height = ifcopenshell.util.geolocation.auto_xyz2enh(model, 10000.0, 0.0, 3000.0)
    assert east == pytest.approx(458657.21 + 10 * math.cos(math.radians(27)), abs=1e-6)
    assert north == pytest.approx(5438232.57 + 10 * math.sin(math.radians(27)), abs=1e-6)
    assert height == pytest.approx(115.4, abs=1e-6)


def test_curved_panels_lie_on_their_radii():
    for name, (low, high) in {"Lower panel": (0.0, 0.6), "Upper panel": (0.62, 1.22)}.items():
        vertices, _ = meshes("curved.ifc")[name]
        radius = np.hypot(vertices[:, 0], vertices[:, 1])
        assert np.all(np.isclose(radius, 2.9, atol=1e-6) | np.isclose(radius, 3.0, atol=1e-6))
        bearing = np.degrees(np.arctan2(vertices[:, 1], vertices[:, 0]))
        assert (bearing.min(), bearing.max()) == pytest.approx((0.0, 60.0), abs=1e-6)
        assert (vertices[:, 2].min(), vertices[:, 2].max()) == pytest.approx((low, high), abs=1e-9)
