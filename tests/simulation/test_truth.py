import json

import numpy as np
import pytest

from bimfit.errors import ConfigError
from bimfit.simulation.motion import random_truth
from bimfit.simulation.scenario import Scenario
from bimfit.simulation.truth import read_truth, write_truth

FAR = (458657.0, 5438232.0, 12.0)


@pytest.fixture
def truths(joint):
    sections = joint(np.arange(6) * 0.01, origin=FAR)
    return [
        random_truth(sections, Scenario(), seed, joint_id=f"J{seed}", elements=("a", "b"), kind="square-butt")
        for seed in (1, 2)
    ]


def test_a_truth_file_gives_everything_back(tmp_path, truths):
    write_truth(truths, tmp_path / "t.json", model="m.ifc", scan="s.csv")
    back = read_truth(tmp_path / "t.json")
    assert len(back) == 2
    for one, other in zip(truths, back, strict=True):
        assert (one.id, one.elements, one.kind, one.seed) == (
            other.id,
            other.elements,
            other.kind,
            other.seed,
        )
        assert (one.width, one.length) == (other.width, other.length)
        for a, b in zip(one.stations, other.stations, strict=True):
            assert (a.s, a.common, a.components) == (b.s, b.common, b.components)
            assert all(
                np.array_equal(getattr(a.frame, k), getattr(b.frame, k)) for k in ("origin", "u", "v", "n")
            )
            assert np.array_equal(a.gap.origin, b.gap.origin)
            assert np.array_equal(a.gap.polygon, b.gap.polygon)
            assert (a.gap.angle, a.gap.area, a.gap.width_root) == (b.gap.angle, b.gap.area, b.gap.width_root)


def test_the_file_has_the_shape_of_results_json(tmp_path, truths):
    """And its transforms carry the designed corners, in the world, to where the gap's polygon starts."""
    write_truth(truths, tmp_path / "t.json")
    value = json.loads((tmp_path / "t.json").read_text())
    assert value["schema"] == 1
    assert value["units"] == {"length": "m", "angle": "rad"}
    station = value["joints"][0]["stations"][3]
    frame = station["frame"]
    origin, u = np.array(frame["origin"]), np.array(frame["u"])
    assert np.allclose(np.cross(frame["u"], frame["v"]), frame["n"])
    T = np.array(station["components"][0]["transform"]).reshape(4, 4)
    corner = T @ np.r_[origin - 0.0125 * u, 1.0]
    assert np.allclose(corner[:3], station["gap"]["polygon"][0], atol=1e-7)  # float64 at 5,400 km
    assert station["components"][1]["element"] == "b"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{", "not JSON"),
        ("[]", "not a truth file"),
        ('{"schema": 2, "joints": []}', "not a truth file"),
        ('{"schema": 1, "joints": [{"id": "x"}]}', "joint 1"),
    ],
)
def test_what_is_no_truth_is_refused(tmp_path, text, complaint):
    file = tmp_path / "t.json"
    file.write_text(text)
    with pytest.raises(ConfigError, match=complaint):
        read_truth(file)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_truth(tmp_path / "none.json")
