"""Profiles taught from slices: near the truth, kept to the last digit in their file, and used by the fit."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import shapely

from bimfit.cli.main import main
from bimfit.config import Config
from bimfit.errors import ConfigError, ScanError
from bimfit.geometry.joint_section import GapOutline
from bimfit.geometry.profile import Profile
from bimfit.geometry.shape import deformed
from bimfit.pipeline.bench_refusal import scanned
from bimfit.pipeline.fit import fit_joint
from bimfit.pipeline.profile_file import TaughtProfile, read_profile, write_profile
from bimfit.pipeline.samples import sample_model
from bimfit.pipeline.simulate import designed, longest_open
from bimfit.pipeline.survey import model_joints
from bimfit.pipeline.teach import spread, taught
from bimfit.simulation.motion import random_truth
from bimfit.simulation.scenario import Scenario


@pytest.fixture(scope="module")
def scene():
    model, found = model_joints(sample_model("v-groove.ifc"), Config().joints)
    joint = longest_open(found)
    scenario = Scenario(spacing=0.03, sigma=0.0015)
    sections = designed(model, joint, scenario)
    turned = {"bevel-angle": 0.09}  # 5 degrees
    real = tuple(deformed(deformed(s, 0, turned), 1, turned) for s in sections)
    truth = random_truth(sections, scenario, 5, joint_id=joint.id, elements=joint.elements)
    config = dataclasses.replace(Config(), sensor=dataclasses.replace(Config().sensor, sigma=0.0015))
    return joint, sections, real, scanned(real, truth, scenario, 5), config


def test_a_taught_profile_is_what_is_there_and_not_what_was_designed(scene):
    joint, sections, real, slices, config = scene
    section, used = taught(sections, slices, config)
    assert used >= 25
    for which in (0, 1):
        side, true, drawn = ((s.gap.side_a, s.gap.side_b)[which] for s in (section, real[0], sections[0]))
        bevel = shapely.LineString(true[:2])
        own = shapely.hausdorff_distance(shapely.LineString(side[:2]), bevel)
        assert own < 0.0012
        assert shapely.hausdorff_distance(shapely.LineString(drawn[:2]), bevel) > 1.5 * own
        assert section.components[which].area > 0.0
    profile = TaughtProfile(section.components, section.gap)
    fits = [
        fit_joint(joint, design, slices, config, motion="independent", threads=1)
        for design in (sections, profile.applied(sections))
    ]
    rms = [np.median([c.rms for s in fit.stations for c in s.components]) for fit in fits]
    ok = [sum(s.status.name == "ok" for s in fit.stations) for fit in fits]
    assert ok[1] >= ok[0]
    assert rms[1] < rms[0]


def test_teaching_wants_beams_and_enough_slices(scene):
    _, sections, _, slices, config = scene
    bare = [dataclasses.replace(cut, beams=None) for cut in slices]
    with pytest.raises(ScanError, match="beams"):
        taught(sections, bare, config)
    with pytest.raises(ScanError, match="only 2 of 2"):
        taught(sections[:2], slices[:2], config)
    assert spread(10, 4) == [0, 3, 6, 9]
    assert spread(3, 9) == [0, 1, 2]


def _profile(rng) -> TaughtProfile:
    a = Profile.polygon([(-0.01, 0.0), (-0.2, 0.01), (-0.2, -0.03), (-0.008, -0.03)])
    b = Profile.polygon([(0.01, 0.0), (0.012, -0.03), (0.2, -0.03), (0.2, 0.0)])
    a = dataclasses.replace(a, artificial=(np.array([False, True, False, False]),))
    b = dataclasses.replace(b, loops=(b.loops[0] + rng.normal(0.0, 1e-4, (4, 2)),))
    gap = GapOutline(np.array([(-0.01, 0.0), (-0.008, -0.03)]), b.loops[0][:2] / 3.0)
    return TaughtProfile((a, b), gap, {"scan": "x", "slices": 3})


def test_a_profile_survives_its_file_to_the_last_digit(tmp_path):
    for seed in range(5):
        profile = _profile(np.random.default_rng(seed))
        write_profile(profile, tmp_path / "p.json")
        back = read_profile(tmp_path / "p.json")
        for one, two in zip(profile.components, back.components, strict=True):
            assert np.array_equal(one.loops[0], two.loops[0])
            assert np.array_equal(one.surface, two.surface)
        assert np.array_equal(profile.gap.side_a, back.gap.side_a)
        assert np.array_equal(profile.gap.side_b, back.gap.side_b)
        assert back.taught == profile.taught


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.update(kind="x"), "no bimfit profile"),
        (lambda d: d.update(schema=9), "schema 9"),
        (lambda d: d["components"].pop(), "two components"),
        (lambda d: d["components"][0].update(loops=[]), r"components\[0\] wants loops"),
        (lambda d: d["components"][1]["loops"][0].pop(), "counter-clockwise|at least 3 points"),
        (lambda d: d["components"][0]["loops"][0].reverse(), "counter-clockwise"),
        (lambda d: d["components"][0].update(artificial=[[True]]), "for each edge"),
        (lambda d: d["gap"].update(side_a=[[0.0, "x"], [1.0, 2.0]]), r"gap.side_a wants at least 2 points"),
        (lambda d: d["gap"].update(side_b=[[0.0, 1e9], [1.0, 2.0]]), "write metres"),
    ],
)
def test_a_file_that_is_no_profile_is_refused_with_its_place(tmp_path, change, said):
    path = tmp_path / "p.json"
    write_profile(_profile(np.random.default_rng(0)), path)
    data = json.loads(path.read_text())
    if "at least 3" in said:
        data["components"][1]["loops"][0] = data["components"][1]["loops"][0][:3]
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(ConfigError, match=said):
        read_profile(path)


def test_teach_and_fit_on_the_command_line(tmp_path, capsys):
    model = str(sample_model("v-groove.ifc"))
    scenario = tmp_path / "s.toml"
    scenario.write_text("spacing = 0.08\n")
    scan, profile = str(tmp_path / "s.csv"), str(tmp_path / "p.json")
    assert main(["simulate", model, "--scenario", str(scenario), "--seed", "4", "-o", scan]) == 0
    assert main(["teach", scan, "--model", model, "--slices", "8", "-o", profile]) == 0
    assert "from 8 slices" in capsys.readouterr().out
    quiet = ["--no-pictures", "--no-report", "--no-as-built"]
    assert main(["fit", model, scan, "--profile", profile, "-o", str(tmp_path / "out"), *quiet]) == 0
    assert main(["fit", model, scan, "--profile", scan, "-o", str(tmp_path / "no"), *quiet]) == 2
    assert "s.csv" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
    assert main(["teach", scan, "--model", model, "-o", scan]) == 2
