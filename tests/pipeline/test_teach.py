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
from bimfit.pipeline.survey import model_joints, mouth_paths
from bimfit.pipeline.teach import spread, taught
from bimfit.scan.formats import write_scan
from bimfit.simulation.motion import random_truth
from bimfit.simulation.rangefinder import simulate_scan
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
    profile = taught(sections, slices, config)
    assert profile.taught["slices"] >= 25
    assert "disagreement" not in profile.taught
    for which in (0, 1):
        side, true, drawn = ((s.gap.side_a, s.gap.side_b)[which] for s in (profile, real[0], sections[0]))
        bevel = shapely.LineString(true[:2])
        own = shapely.hausdorff_distance(shapely.LineString(side[:2]), bevel)
        assert own < 0.0012
        assert shapely.hausdorff_distance(shapely.LineString(drawn[:2]), bevel) > 1.5 * own
        assert profile.components[which].area > 0.0
    fits = [
        fit_joint(joint, design, slices, config, motion="independent", threads=1)
        for design in (sections, profile.applied(sections))
    ]
    rms = [np.median([c.rms for s in fit.stations for c in s.components]) for fit in fits]
    ok = [sum(s.status.name == "ok" for s in fit.stations) for fit in fits]
    assert ok[1] >= ok[0]
    assert rms[1] < rms[0]


def test_slices_that_show_two_shapes_are_told(scene):
    _, sections, _, _, config = scene
    turned = {"bevel-angle": 0.18}
    mixed = tuple(
        deformed(deformed(s, 0, turned), 1, turned) if k < len(sections) // 2 else s
        for k, s in enumerate(sections)
    )
    scenario = Scenario(spacing=0.03, sigma=0.0015)
    truth = random_truth(sections, scenario, 8, joint_id="x", elements=("a", "b"))
    profile = taught(sections, scanned(mixed, truth, scenario, 8), config)
    assert "do not show one shape" in profile.taught["disagreement"]


def test_points_teach_as_beams_do_and_two_slices_do_not(scene):
    _, sections, real, slices, config = scene
    profile = taught(sections, [dataclasses.replace(cut, beams=None) for cut in slices], config)
    for taught_side, true in (
        (profile.gap.side_a, real[0].gap.side_a),
        (profile.gap.side_b, real[0].gap.side_b),
    ):
        own = shapely.LineString(taught_side[:2])
        assert shapely.hausdorff_distance(own, shapely.LineString(true[:2])) < 0.0015
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


def _angles(component, side):
    """Of the face in the gap against the outer face, rad: what no motion changes."""
    mouth, deep = side[0], side[1]
    loop = component.loops[0]
    k = int(np.argmin(np.hypot(*(loop - mouth).T)))
    ways = [loop[(k + step) % len(loop)] - mouth for step in (1, -1)]
    out = min(ways, key=lambda way: abs(way @ (deep - mouth)) / np.hypot(*way))
    cosine = (out @ (deep - mouth)) / np.hypot(*out) / np.hypot(*(deep - mouth))
    return float(np.arccos(cosine))


@pytest.mark.parametrize("form", ["beams", "points"])
def test_a_line_and_a_scan_teach_a_profile_without_a_model(tmp_path, capsys, form):
    model, found = model_joints(sample_model("v-groove.ifc"), Config().joints)
    joint = longest_open(found)
    scenario = Scenario(spacing=0.03, sigma=0.0015)
    sections = designed(model, joint, scenario)
    truth = random_truth(sections, scenario, 8, joint_id=joint.id, elements=joint.elements)
    scan = simulate_scan(sections, truth, scenario, 8)
    file, profile = tmp_path / "s.npz", tmp_path / "p.json"
    if form == "points":
        hit = np.isfinite(scan.ranges)
        file = tmp_path / "s.xyz"
        np.savetxt(file, scan.origins[hit] + scan.directions[hit] * scan.ranges[hit, None], fmt="%.6f")
    else:
        write_scan(scan, file)
    path = mouth_paths(joint)[0]
    line = ",".join(f"{x:.6f}" for x in (*path.points[0], *path.points[-1]))
    out = ",".join(f"{x:.6f}" for x in sections[0].frame.v)
    words = ["teach", str(file), "--line", line, "--sigma", "1.5mm", "-o", str(profile)]
    words += ["--out", out, "--spacing", "30mm"] if form == "points" else []
    assert main(words) == 0
    assert "along the line" in capsys.readouterr().out
    got = read_profile(profile)
    for which in (0, 1):
        own = _angles(got.components[which], (got.gap.side_a, got.gap.side_b)[which])
        true = _angles(sections[0].components[which], (sections[0].gap.side_a, sections[0].gap.side_b)[which])
        assert own == pytest.approx(true, abs=np.radians(1.5))
    assert np.allclose(sum(got.gap.mouth), 0.0, atol=1e-9)
    cuts = scanned(sections, truth, scenario, 8)
    fit = fit_joint(joint, got.applied(sections), cuts, Config(), motion="independent", threads=1)
    assert sum(s.status.name == "ok" for s in fit.stations) > 0.8 * len(sections)


def test_a_line_that_runs_across_the_gap_is_refused_in_one_line(tmp_path, capsys):
    x, y = np.meshgrid(np.linspace(-0.16, 0.16, 161), np.arange(0.0, 0.8, 0.01))
    keep = np.abs(x) > 0.0125
    np.savetxt(tmp_path / "s.xyz", np.column_stack([x[keep], y[keep], 0.0 * x[keep]]), fmt="%.4f")
    words = ["teach", str(tmp_path / "s.xyz"), "--line", "0,0,0,0.8,0,0", "--out", "0,0,1"]
    assert main([*words, "-o", str(tmp_path / "p.json")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "too few returns to guess component" in line
    assert "--line" in line


def test_what_teach_is_asked_for_must_make_sense(tmp_path, capsys):
    scan = tmp_path / "s.xyz"
    scan.write_text("0 0 0\n0.1 0 0\n0 0.1 0\n" * 4)
    profile = str(tmp_path / "p.json")
    for words, said in (
        ([], "--model or a --line"),
        (["--out", "0,0,1"], "go with --line"),
        (["--line", "0,0,0,1,0"], "wants 6 numbers"),
        (["--line", "0,0,0,0,0,0"], "no length"),
        (["--line", "0,0,0,1,0,0"], "sensor stood"),
        (["--line", "0,0,0,1,0,0", "--out", "1,0,0"], "along the line"),
        (["--line", "0,0,9,1,0,9", "--out", "0,0,1"], "slices along the line"),
    ):
        assert main(["teach", str(scan), *words, "-o", profile]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "p.json").exists()
