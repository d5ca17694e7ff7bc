"""The options that choose joints, on every command that takes them."""

from __future__ import annotations

import csv
import json
import math
import re

import pytest
import typer

from bimfit.cli.choosing import length_range
from bimfit.cli.main import app, main
from bimfit.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("12..30mm", (0.012, 0.030)),
        ("1.2cm .. 0.03m", (0.012, 0.030)),
        ("12mm..", (0.012, math.inf)),
        ("..30mm", (-math.inf, 0.030)),
        ("-5..0mm", (-0.005, 0.0)),
        ("0.01..0.02", (0.01, 0.02)),
    ],
)
def test_ranges(text, wanted):
    assert length_range(text, "--width") == pytest.approx(wanted)


@pytest.mark.parametrize("text", ["", "..", "30mm", "30..12mm", "a..b", "1..2parsec", "12...30mm", "12..30"])
def test_what_is_no_range_is_refused(text):
    with pytest.raises(ConfigError, match="--width"):
        length_range(text, "--width")


def test_every_command_takes_the_same_choice(samples, tmp_path, capsys):
    """A chosen storey is simulated, fitted and compared: three joints of the facade's seventeen."""
    model, scan = str(samples / "facade.ifc"), str(tmp_path / "scan.npz")
    choice = ["--storey", "Storey 1", "--class", "IfcWall", "--width", "..60mm", "--length", "1m"]
    assert main(["joints", model, "--json", *choice]) == 0
    wanted = [joint["id"] for joint in json.loads(capsys.readouterr().out)]
    assert len(wanted) == 3
    (tmp_path / "coarse.toml").write_text("spacing = 1.0\n")
    words = ["--scenario", str(tmp_path / "coarse.toml"), "--truth", str(tmp_path / "truth.json")]
    assert main(["simulate", model, *choice, *words, "-o", scan]) == 0
    assert [joint["id"] for joint in json.loads((tmp_path / "truth.json").read_text())["joints"]] == wanted
    capsys.readouterr()
    out = tmp_path / "out"
    kept = ["--select", "IfcWall, Name=/Panel 1.[123]/"]
    quick = ["--motion", "independent", "--no-pictures", "--no-as-built"]
    assert main(["fit", model, scan, *choice, *kept, *quick, "-o", str(out)]) in (0, 1)
    fitted = [joint["id"] for joint in json.loads((out / "results.json").read_text())["joints"]]
    assert set(fitted) < set(wanted) and len(fitted) == 2
    words = ["--methods", "grcsm", "--truth", str(tmp_path / "truth.json"), "--joint", fitted[0]]
    assert main(["compare", model, scan, *words, "-o", str(out)]) == 0
    rows = csv.DictReader((out / "stations.csv").read_text().splitlines())
    stations = sum(row["joint"] == fitted[0] for row in rows)
    table = json.loads((out / "compare.json").read_text())["methods"][0]
    assert table["slices"] == stations


@pytest.mark.parametrize("command", ["joints", "fit", "compare", "simulate"])
def test_a_choice_that_cannot_be_is_one_line(command, samples, tmp_path, capsys):
    scan = tmp_path / "scan.csv"
    scan.write_text("scan,ox,oy,oz,dx,dy,dz,range\n0,0,0,1,0,0,-1,1\n")
    words = [command, str(samples / "facade.ifc")]
    words += {"joints": [], "simulate": ["-o", str(tmp_path / "o.csv")]}.get(
        command, [str(scan), "-o", str(tmp_path / "o")]
    )
    assert main([*words, "--storey", "Roof"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "Storey 1, Storey 2, Storey 3" in line
    assert not (tmp_path / "o").exists() and not (tmp_path / "o.csv").exists()


def test_help_lists_every_option_once_and_under_its_heading(capsys):
    assert main(["fit", "--help"]) == 0
    page = capsys.readouterr().out
    named = re.findall(r"^  (?:-\w, )?(--[\w-]+)", page, flags=re.MULTILINE)
    command = typer.main.get_command(app).commands["fit"]
    options = [param for param in command.params if param.param_type_name == "option"]
    known = [next(name for name in param.opts if name.startswith("--")) for param in options]
    assert sorted(named) == sorted([*known, "--help"])
    heading = dict.fromkeys(("--method", "--sigma", "--bcf", "--scan-crs", "--scan-unit", "--storey"), "")
    for block in page.split("\n\n"):
        for option in heading:
            if f"  {option} " in block:
                heading[option] = block.splitlines()[0]
    assert list(heading.values()) == [
        "Method:", "Slices and sensor:", "What is written:", "Where the scan lies:", "How the scan is read:",
        "Which joints:",
    ]  # fmt: skip
