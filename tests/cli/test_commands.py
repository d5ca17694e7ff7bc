"""The commands as a user runs them: outputs, exit statuses, and one clear line for bad input."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import trimesh

from bimfit.cli.main import main

SAMPLE = "square-butt-ifc4.ifc"


@pytest.fixture(scope="module")
def model(samples) -> Path:
    return samples / SAMPLE


@pytest.fixture(scope="module")
def scan(model, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scan")
    scenario = folder / "coarse.toml"
    scenario.write_text("spacing = 0.04\n")
    scan = folder / "scan.csv"
    words = ["simulate", str(model), "--scenario", str(scenario), "--seed", "4", "-o", str(scan)]
    assert main([*words, "--truth", str(folder / "truth.json")]) == 0
    return scan


@pytest.fixture(scope="module")
def results(model, scan, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("out")
    assert main(["fit", str(model), str(scan), "-o", str(folder)]) == 0
    return folder


NUMBER = {"type": ["number", "null"]}
VECTOR = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
MATRIX = {
    "anyOf": [
        {"type": "null"},
        {"type": "array", "items": {"type": "number"}, "minItems": 16, "maxItems": 16},
    ]
}
SEARCH = {
    "type": "object",
    "required": ["transform", "score", "bound", "evaluations", "stop"],
    "properties": {
        "transform": MATRIX,
        "stop": {"enum": ["proven", "tolerance", "budget", "converged", "unproven", None]},
    },
}
COMPONENT = {
    "type": "object",
    "required": ["element", "transform", "pose", "covariance", "search"],
    "properties": {"transform": MATRIX, "element": {"type": "string"}, "search": SEARCH},
}
GAP = {
    "type": "object",
    "required": ["origin", "angle", "width", "area", "polygon", "sigma"],
    "properties": {
        "origin": VECTOR,
        "width": {"type": "object", "required": ["mouth", "root", "narrowest"]},
        "polygon": {"type": "array", "items": VECTOR, "minItems": 3},
        "sigma": {"type": "object", "required": ["x", "y", "angle", "width", "area"]},
    },
}
STATION = {
    "type": "object",
    "required": ["s", "frame", "status", "reason", "combined", "components", "gap"],
    "properties": {
        "frame": {"type": "object", "properties": dict.fromkeys(("origin", "u", "v", "n"), VECTOR)},
        "status": {"enum": ["ok", "ambiguous", "weak", "rejected", "no_data"]},
        "components": {"type": "array", "items": COMPONENT, "minItems": 2, "maxItems": 2},
        "gap": {"anyOf": [{"type": "null"}, GAP]},
    },
}
SCHEMA = {
    "type": "object",
    "required": ["schema", "bimfit", "model", "scan", "units", "joints"],
    "properties": {
        "schema": {"const": 1},
        "units": {"const": {"length": "m", "angle": "rad"}},
        "joints": {
            "type": "array",
            "items": {
                "type": "object",
                "required": ["id", "elements", "kind", "designed", "stations", "volume", "length", "mesh"],
                "properties": {
                    "stations": {"type": "array", "items": STATION},
                    "designed": {"type": "object", "required": ["width", "length"]},
                    "volume": {"type": "object", "required": ["slices", "mesh", "sigma"]},
                },
            },
        },
    },
}


def test_results_keep_to_the_contract(results):
    value = json.loads((results / "results.json").read_text(), parse_constant=pytest.fail)
    jsonschema.validate(value, SCHEMA)
    joint = value["joints"][0]
    assert joint["designed"]["width"] == pytest.approx(0.025, abs=1e-6)
    assert joint["length"] == pytest.approx(0.82, abs=1e-6)
    for station in joint["stations"]:
        u, v, n = (np.array(station["frame"][k]) for k in ("u", "v", "n"))
        assert np.allclose(np.cross(u, v), n, atol=1e-9)
        assert (results / joint["mesh"]).is_file()


def test_transform_and_pose_are_the_same_motion(results):
    """as built = transform * designed; pose: turn by dtheta about the origin, then shift along u and v."""
    for station in json.loads((results / "results.json").read_text())["joints"][0]["stations"]:
        frame = {k: np.array(x) for k, x in station["frame"].items()}
        for component in station["components"]:
            if component["pose"] is None:
                assert component["transform"] is None
                continue
            du, dv, turn = component["pose"]
            T = np.array(component["transform"]).reshape(4, 4)
            origin = T[:3, :3] @ frame["origin"] + T[:3, 3]
            assert np.allclose(origin, frame["origin"] + du * frame["u"] + dv * frame["v"], atol=1e-9)
            assert np.allclose(T[:3, :3] @ frame["u"], np.cos(turn) * frame["u"] + np.sin(turn) * frame["v"])
            assert np.allclose(T[:3, :3] @ frame["n"], frame["n"])


def test_meshes_of_all_formats_enclose_the_reported_volume(results):
    joint = json.loads((results / "results.json").read_text())["joints"][0]
    assert set(joint["meshes"]) == {"stl", "ply", "obj", "glb", "3mf"}
    for suffix, name in joint["meshes"].items():
        mesh = trimesh.load(results / name, force="mesh")
        mesh.merge_vertices()
        volume = mesh.volume * (1e-9 if suffix == "3mf" and mesh.extents.max() > 10 else 1.0)
        assert mesh.is_watertight, suffix
        assert volume == pytest.approx(joint["volume"]["mesh"], rel=1e-4), suffix
    assert joint["volume"]["slices"] == pytest.approx(joint["volume"]["mesh"], rel=0.05)
    assert joint["volume"]["sigma"] > 0


def test_stations_csv_has_a_row_a_station(results):
    import csv

    with (results / "stations.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    stations = json.loads((results / "results.json").read_text())["joints"][0]["stations"]
    assert len(rows) == len(stations)
    for row, station in zip(rows, stations, strict=True):
        assert float(row["s_m"]) == station["s"]
        assert row["status"] == station["status"]
        if station["gap"] is not None:
            assert float(row["width_mouth_m"]) == station["gap"]["width"]["mouth"]
        else:
            assert row["width_mouth_m"] == ""


def test_as_built_model_holds_the_gap(results, model):
    import ifcopenshell

    file = ifcopenshell.open(str(results / "as-built.ifc"))
    joint = json.loads((results / "results.json").read_text())["joints"][0]
    (gap,) = file.by_type("IfcVirtualElement")
    ties = {t.RelatingElement.GlobalId for t in file.by_type("IfcRelConnectsElements")}
    ties |= {t.RelatedElement.GlobalId for t in file.by_type("IfcRelConnectsElements")}
    assert set(joint["elements"]) <= ties
    assert gap.Representation is not None
    before = {e.GlobalId for e in ifcopenshell.open(str(model)).by_type("IfcRoot")}
    assert before <= {e.GlobalId for e in file.by_type("IfcRoot")}


def test_schedule_and_report_are_there(results):
    assert {"schedule.csv", "schedule.xlsx", "report.html"} <= {path.name for path in results.iterdir()}
    joint = json.loads((results / "results.json").read_text())["joints"][0]
    text = (results / "report.html").read_text(encoding="utf-8")
    assert joint["id"] in text and "No limits were given" in text
    assert text.count("data:image/jpeg") == 3 and "canvas" in text


def test_issues_are_written_and_limits_told(model, scan, tmp_path, capsys):
    words = ["fit", str(model), str(scan), "--spacing", "0.2", "--motion", "independent", "--no-pictures"]
    words += ["--no-report", "--no-as-built", "--limits", "width=..1mm", "--bcf", str(tmp_path / "i.bcf")]
    assert main([*words, "--bcf-version", "3.0", "-o", str(tmp_path / "o")]) == 0
    told = capsys.readouterr().err
    assert "0 pass, 1 fail" in told and "1 issue in" in told
    assert (tmp_path / "i.bcf").stat().st_size > 10_000
    assert not (tmp_path / "o" / "report.html").exists()
    assert json.loads((tmp_path / "o" / "results.json").read_text())["limits"] == {"width": [None, 0.001]}


def test_pictures_are_drawn(results):
    pictures = sorted(path.name.split("-")[0] for path in results.glob("*.png"))
    assert pictures == ["gap", "scene", "slice", "tables"]


def test_a_second_run_replaces_the_first(model, scan, results, tmp_path):
    folder = tmp_path / "again"
    shutil.copytree(results, folder)
    earlier = json.loads((folder / "results.json").read_text())
    earlier["joints"][0]["meshes"]["stl"] = "gap-gone.stl"
    (folder / "results.json").write_text(json.dumps(earlier))
    (folder / "gap-gone.stl").write_text("stale")
    (folder / "mine.txt").write_text("kept")
    assert main(["fit", str(model), str(scan), "-o", str(folder), "--no-pictures"]) == 0
    assert not (folder / "gap-gone.stl").exists()
    assert (folder / "mine.txt").read_text() == "kept"


def test_a_run_that_is_broken_off_while_writing_changes_nothing(model, scan, results, tmp_path, monkeypatch):
    def broken(*_args, **_kw):
        raise KeyboardInterrupt

    monkeypatch.setattr("bimfit.pipeline.deliver.write_schedule", broken)
    words = ["fit", str(model), str(scan), "--no-pictures", "--no-report", "-o"]
    assert main([*words, str(tmp_path / "fresh")]) == 130
    assert not (tmp_path / "fresh").exists()
    folder = tmp_path / "again"
    shutil.copytree(results, folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert main([*words, str(folder)]) == 130
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_full_disk_is_told_by_the_name_that_the_file_would_have(model, scan, tmp_path, capsys, monkeypatch):
    def full(*_args, **_kw):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("bimfit.files.Path.replace", full)
    line = refused(["fit", model, scan, "--no-pictures", "--no-report", "-o", tmp_path / "o"], capsys)
    assert says(line, tmp_path / "o" / "gap-", "No space left")
    assert not (tmp_path / "o").exists()


def test_joints_lists_what_results_name(model, results, capsys):
    assert main(["joints", str(model), "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    joint = json.loads((results / "results.json").read_text())["joints"][0]
    assert len(listed) == 1
    for key in ("id", "elements", "kind", "designed"):
        assert listed[0][key] == joint[key]
    assert main(["joints", str(model)]) == 0
    assert listed[0]["id"] in capsys.readouterr().out


def test_compare_writes_its_table(model, scan, tmp_path, capsys):
    truth = scan.parent / "truth.json"
    words = ["compare", str(model), str(scan), "--truth", str(truth), "-o", str(tmp_path / "c")]
    assert main([*words, "--methods", "grcsm,icp-plane,mrcsm"]) == 0
    out = capsys.readouterr().out
    assert "grcsm" in out and "icp-plane" in out
    value = json.loads((tmp_path / "c" / "compare.json").read_text())
    rows = {row["method"]: row for row in value["methods"]}
    assert rows["grcsm"]["mean_mm"] < 0.8
    assert rows["grcsm"]["over_10_mm"] == 0
    assert rows["mrcsm"]["median_evaluations"] > rows["grcsm"]["median_evaluations"]
    starts = value["by_start"]["grcsm"]
    assert sum(row["slices"] for row in starts) == rows["grcsm"]["slices"]
    assert all(row["lost_share"] == 0.0 for row in starts if row["slices"])
    assert (tmp_path / "c" / "compare.png").stat().st_size > 10_000


def test_view_draws_a_picture(results, tmp_path):
    picture = tmp_path / "view.png"
    assert main(["view", str(results), "--picture", str(picture)]) == 0
    assert picture.stat().st_size > 10_000


def test_same_seed_same_bytes(model, scan, tmp_path):
    again = tmp_path / "again.csv"
    scenario = scan.parent / "coarse.toml"
    assert main(["simulate", str(model), "--scenario", str(scenario), "--seed", "4", "-o", str(again)]) == 0
    assert again.read_bytes() == scan.read_bytes()


def test_a_joint_that_cannot_be_estimated_is_exit_1(model, scan, tmp_path, capsys):
    """Every beam of the scan lost but a handful: the joint is named on stderr, and nothing is made up."""
    lines = scan.read_text().splitlines()
    kept = [lines[0]]
    for k, line in enumerate(lines[1:]):
        kept.append(line if k % 60 == 7 else line.rsplit(",", 1)[0] + ",")
    thin = tmp_path / "thin.csv"
    thin.write_text("\n".join(kept) + "\n")
    assert main(["fit", str(model), str(thin), "-o", str(tmp_path / "o"), "--no-pictures"]) == 1
    captured = capsys.readouterr()
    joint = json.loads((tmp_path / "o" / "results.json").read_text())["joints"][0]
    assert joint["id"] in captured.err
    assert joint["mesh"] is None and joint["volume"] is None
    for station in joint["stations"]:
        assert station["gap"] is None
        assert station["reason"]


def refused(words, capsys) -> str:
    """The one line on stderr of a command that ends with exit status 2."""
    assert main([str(word) for word in words]) == 2
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1, captured.err
    assert "Traceback" not in captured.err
    assert "internal error" not in captured.err
    return lines[0]


def says(line, *named) -> bool:
    return all(str(name) in line for name in named)


def test_a_program_named_alone_shows_its_help(capsys):
    assert main([]) == 0
    alone = capsys.readouterr().out
    assert main(["--help"]) == 0
    assert alone == capsys.readouterr().out
    assert len(alone.splitlines()) > 20


def test_not_an_ifc(scan, tmp_path, capsys):
    wrong = tmp_path / "wrong.ifc"
    wrong.write_text("this is not a model\n")
    assert says(refused(["fit", wrong, scan, "-o", tmp_path / "o"], capsys), "wrong.ifc", "before the scan")
    assert says(refused(["joints", tmp_path / "missing.ifc"], capsys), "missing.ifc")
    assert not (tmp_path / "o").exists()


def test_ifc_without_geometry(scan, tmp_path, capsys):
    import ifcopenshell

    bare = ifcopenshell.file(schema="IFC4")
    bare.create_entity("IfcProject", GlobalId=ifcopenshell.guid.new())
    bare.write(str(tmp_path / "bare.ifc"))
    assert says(refused(["fit", tmp_path / "bare.ifc", scan, "-o", tmp_path / "o"], capsys), "bare.ifc")


def test_no_joint_found(model, scan, tmp_path, capsys):
    """The sample's two boards, drawn far apart."""
    import ifcopenshell

    file = ifcopenshell.open(str(model))
    board = file.by_type("IfcElement")[0]
    point = board.ObjectPlacement.RelativePlacement.Location
    x, y, z = point.Coordinates
    point.Coordinates = (x + 50.0, y + 50.0, z)
    file.write(str(tmp_path / "apart.ifc"))
    assert says(refused(["joints", tmp_path / "apart.ifc"], capsys), "apart.ifc", "no joint")
    assert says(refused(["fit", tmp_path / "apart.ifc", scan, "-o", tmp_path / "o"], capsys), "no joint")


def test_a_model_that_is_cut_off_is_named_as_such(model, tmp_path, capsys):
    text = model.read_text()
    cut = tmp_path / "cut.ifc"
    cut.write_text(text[: text.rindex("=IFCPLATE(")])
    assert says(refused(["joints", cut], capsys), "cut.ifc", "no joint", "cut off")


def test_scan_far_from_the_model(model, scan, tmp_path, capsys):
    pose = "1000,0,0,0,0,0"
    assert says(
        refused(["fit", model, scan, "--scan-pose", pose, "-o", tmp_path / "o"], capsys), "scan.csv", "far"
    )


def test_empty_scan(model, tmp_path, capsys):
    empty = tmp_path / "empty.csv"
    empty.write_text("")
    assert says(refused(["fit", model, empty, "-o", tmp_path / "o"], capsys), "empty.csv")
    empty.write_text("scan,ox,oy,oz,dx,dy,dz,range\n")
    assert says(refused(["fit", model, empty, "-o", tmp_path / "o"], capsys), "empty.csv")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda lines: [lines[0], lines[1].replace(",", ",x", 1), *lines[2:]], ("line 2", "ox")),
        (lambda lines: [lines[0].replace(",dz", ",dq"), *lines[1:]], ("dz",)),
        (lambda lines: [*lines[:3], "0,0,0,0.3,0,0,-7,0.25", *lines[4:]], ("line 4",)),
        (lambda lines: [*lines[:2], "0,0,0", *lines[3:]], ("line 3",)),
    ],
    ids=["text-in-a-number", "missing-column", "not-a-unit-direction", "ragged-row"],
)
def test_damaged_line_scans(model, scan, tmp_path, capsys, change, named):
    damaged = tmp_path / "damaged.csv"
    damaged.write_text("\n".join(change(scan.read_text().splitlines())) + "\n")
    assert says(refused(["fit", model, damaged, "-o", tmp_path / "o"], capsys), "damaged.csv", *named)


def test_unknown_names(model, scan, tmp_path, capsys):
    out = ["-o", tmp_path / "o"]
    assert says(refused(["fit", model, scan, "--joint", "nosuch", *out], capsys), "nosuch")
    assert refused(["fit", model, scan, "--joint", "A,B", *out], capsys)
    assert says(refused(["fit", model, scan, "--method", "magic", *out], capsys), "magic", "grcsm")
    assert says(refused(["fit", model, scan, "--motion", "dance", *out], capsys), "dance", "kinked")
    assert says(refused(["compare", model, scan, "--methods", "grcsm,magic", *out], capsys), "magic")
    assert says(refused(["fit", model, scan, "--window", "1,2", *out], capsys), "--window")
    assert says(refused(["fit", model, scan, "--tolerance", "1parsec,1mm,1deg", *out], capsys), "--tolerance")
    assert refused(["fit", model, scan, "--spacing", "-1mm", *out], capsys)
    assert says(refused(["fit", model, scan], capsys), "output")
    assert says(refused(["fit", model, scan, "--limits", "width=3", *out], capsys), "--limits", "12..30mm")
    assert says(
        refused(["fit", model, scan, "--bcf", tmp_path / "i.bcf", "--bcf-version", "4", *out], capsys), "3.0"
    )
    assert says(refused(["fit", model, scan, "--bcf", model, *out], capsys), ".bcf")
    assert says(refused(["nosuchcommand"], capsys), "nosuchcommand")
    assert says(refused(["view", tmp_path], capsys), "results.json")
    settings = tmp_path / "settings.toml"
    settings.write_text("[search]\nwindwo = 3\n")
    assert says(
        refused(["fit", model, scan, "--config", settings, *out], capsys), "settings.toml", "windwo", "window"
    )


def test_inputs_are_never_overwritten(model, scan, tmp_path, capsys):
    mine = tmp_path / "results.json"
    shutil.copy(scan, tmp_path / "scan.csv")
    shutil.copy(model, mine)  # a model by the name of an output
    assert says(
        refused(["fit", mine, tmp_path / "scan.csv", "-o", tmp_path], capsys),
        "results.json",
        "never overwritten",
    )
    assert mine.read_bytes() == model.read_bytes()
    copy = tmp_path / "model.ifc"
    shutil.copy(model, copy)
    assert says(refused(["simulate", copy, "-o", copy], capsys), "never overwritten")
    assert copy.read_bytes() == model.read_bytes()


def test_units_of_window_and_tolerance(model, scan, tmp_path):
    words = ["fit", str(model), str(scan), "--no-pictures", "--motion", "independent", "--spacing", "0.2"]
    assert (
        main(
            [*words, "--window", "60mm,6cm,20deg", "--tolerance", "2mm,0.002,1deg", "-o", str(tmp_path / "a")]
        )
        == 0
    )
    other = "0.06,0.06,0.3490658503988659"
    assert main([*words, "--window", other, "--tolerance", "2mm,2mm,1deg", "-o", str(tmp_path / "b")]) == 0
    a, b = (json.loads((tmp_path / n / "results.json").read_text())["joints"][0] for n in "ab")
    assert [s["combined"]["pose"] for s in a["stations"]] == [s["combined"]["pose"] for s in b["stations"]]
    assert all(abs(s["combined"]["pose"][0]) <= 0.06 for s in a["stations"])


def test_import_is_light_and_every_public_name_is_there():
    code = (
        "import sys, bimfit; heavy = {'open3d', 'numba', 'ifcopenshell', 'pyvista', 'matplotlib', 'numpy'};"
        "print(sorted(heavy & set(sys.modules))); [getattr(bimfit, n) for n in bimfit.__all__]"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_version_and_help(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("bimfit ")
    assert main(["--help"]) == 0
    assert "simulate" in capsys.readouterr().out


def test_paper_runs_the_method_as_printed(model, scan, tmp_path, capsys):
    words = ["fit", str(model), str(scan), "--paper", "-o", str(tmp_path)]
    assert main([*words, "--no-pictures", "--no-report", "--no-as-built"]) == 0
    joint = json.loads((tmp_path / "results.json").read_text())["joints"][0]
    stations = joint["stations"]
    assert {s["combined"]["stop"] for s in stations} == {"unproven"}
    for s in stations:  # a grid cell is all there is: nothing is known of its uncertainty
        assert all(c["covariance"] is None for c in s["components"])
        assert s["gap"]["sigma"] is None or s["gap"]["sigma"]["x"] is None
    assert main([*words[:3], "--paper", "--method", "mrcsm", "-o", str(tmp_path / "two")]) == 2
    assert "give one of them" in capsys.readouterr().err
    assert not (tmp_path / "two").exists()


def test_a_scan_of_a_piece_of_a_joint_says_how_to_fit_it(model, scan, tmp_path, capsys):
    rows = scan.read_text().splitlines()
    first = [row for row in rows[1:] if float(row.split(",")[2]) < 0.12]
    (tmp_path / "piece.csv").write_text("\n".join([rows[0], *first]) + "\n")
    words = ["fit", model, tmp_path / "piece.csv", "-o", tmp_path / "o"]
    assert says(refused(words, capsys), "piece.csv", "as a whole", "--joint")
    assert main([str(word) for word in [*words, "--joint", "hxkft", "--no-pictures", "--no-report"]]) == 0


def test_a_recorded_dialogue_is_a_scan_for_fit_too(model, shared, tmp_path, capsys):
    """It is read and placed; what it shows is a room, and no joint."""
    file = shared / "scip" / "ug01_fw3.4.03_GD0044072501.reply"
    words = [str(word) for word in ("fit", model, file, "-o", tmp_path / "o", "--scan-pose", "0,0,1,0,0,0")]
    assert main(words) == 2
    assert "unknown kind" not in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_behind_standard_output_is_one_line(model):
    with Path("/dev/full").open("w") as full:
        words = [sys.executable, "-m", "bimfit", "joints", str(model)]
        ended = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stderr == "bimfit: the output cannot be written: No space left on device\n"


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_the_middle_leaves_nothing_behind(model, scan, tmp_path, number):
    out = tmp_path / "o"
    words = [sys.executable, "-m", "bimfit", "fit", str(model), str(scan), "-o", str(out), "--no-pictures"]
    running = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(2.0)
    running.send_signal(number)
    said = running.communicate(timeout=60)[1]
    assert "Traceback" not in said
    assert not list(tmp_path.rglob(".*"))
