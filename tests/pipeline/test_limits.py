"""Verdicts on joints, the schedule, and results.json read back."""

from __future__ import annotations

import csv
import json
import math
import sys
from pathlib import Path

import numpy as np
import openpyxl
import pytest

from bimfit.cli.limits import read_limits
from bimfit.errors import ConfigError
from bimfit.pipeline.document import closest, read_results
from bimfit.pipeline.limits import Limits, judge
from bimfit.pipeline.schedule import COLUMNS, write_schedule

sys.path.insert(0, str(Path(__file__).parent))
from folder import joint, sample_joints, station, write_folder

LIMITS = Limits(width=(0.012, 0.030), step=(-0.003, 0.003))


def judged(tmp_path, joints, limits=LIMITS):
    results = read_results(write_folder(tmp_path, joints))
    return {one.id: judge(one, limits) for one in results.joints}


def test_a_station_out_of_a_limit_fails_its_joint(tmp_path):
    verdicts = judged(tmp_path, sample_joints())
    assert {name: verdict.outcome for name, verdict in verdicts.items()} == {
        "good": "pass", "wide": "fail", "steps": "fail", "lost": "not measured", "unseen": "not measured",
    }  # fmt: skip
    (breach,) = verdicts["wide"].breaches
    assert (breach.name, breach.count, breach.sure) == ("width", 3, True)  # at 0.8, 0.9 and 1.0 m
    assert breach.station.s == pytest.approx(1.0)
    assert breach.excess == pytest.approx(0.004)
    assert "34.0 ± 0.4 mm at 1000 mm along the joint, 4.0 mm out of 12 to 30 mm; 3 stations out" in (
        verdicts["wide"].reason
    )
    assert verdicts["steps"].breaches[0].name == "step"
    assert "no returns near the joint" in verdicts["lost"].reason
    assert judge(read_results(tmp_path).joints[0], None).outcome == ""


def test_what_is_not_trusted_neither_fails_nor_passes(tmp_path):
    wild = [station(0.1 * k, 0.5, status="ambiguous", reason="two poses fit") for k in range(3)]
    fine = [station(1.0 + 0.1 * k, 0.02) for k in range(7)]
    verdicts = judged(tmp_path, [joint("some", wild + fine), joint("most", wild * 3 + fine[:2])])
    assert verdicts["some"].outcome == "pass"
    assert verdicts["most"].outcome == "not measured"
    assert verdicts["most"].reason == "only 2 of 11 stations: two poses fit"


def test_a_breach_within_the_uncertainty_says_so(tmp_path):
    verdicts = judged(tmp_path, [joint("close", [station(0.1 * k, 0.0305, sigma=0.001) for k in range(4)])])
    assert verdicts["close"].outcome == "fail"
    assert not verdicts["close"].breaches[0].sure
    assert "within the uncertainty" in verdicts["close"].reason
    verdicts = judged(tmp_path, [joint("close", [station(0.1 * k, 0.0295, sigma=0.001) for k in range(4)])])
    assert verdicts["close"].outcome == "pass"
    assert "4 figures lie within their uncertainty" in verdicts["close"].reason


def test_an_overlap_is_a_clash_only_beyond_doubt():
    clear, touch = ("clearance", 0.004, 0.001), ("touch", 0.0, 0.001)
    doubtful, sure = ("overlap", -0.0019, 0.001), ("overlap", -0.0021, 0.001)
    assert closest([]) == closest([("", math.nan, math.nan)]) == ""
    assert closest([clear, clear]) == "clear"
    assert closest([clear, touch]) == "touch"
    assert closest([touch, doubtful, clear]) == "possible clash"
    assert closest([sure, doubtful, clear]) == "clash"
    assert closest([("overlap", -1e-4, math.nan)]) == "clash"  # nothing excuses it


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("width=12..30mm,step=3mm", LIMITS),
        (" width = ..30mm , narrowest=5mm..", Limits(width=(-math.inf, 0.03), narrowest=(0.005, math.inf))),
        ("step=-1..3mm,deviation=2mm", Limits(step=(-0.001, 0.003), deviation=(-0.002, 0.002))),
        ("root=0.01..0.02", Limits(root=(0.01, 0.02))),
    ],
)
def test_limits_are_read(text, wanted):
    limits = read_limits(text)
    for name, pair in wanted.given.items():
        assert limits.given[name] == pytest.approx(pair)
    assert set(limits.given) == set(wanted.given)


@pytest.mark.parametrize(
    "text", ["", "width", "width=", "width=30mm", "breadth=1..2mm", "width=30..12mm", "step=-3mm",
             "width=12..30", "width=1..2mm,width=1..2mm", "width=1..2mm,"],
)  # fmt: skip
def test_what_is_no_limit_is_refused(text):
    with pytest.raises(ConfigError, match="--limits"):
        read_limits(text)


def test_the_schedule_says_what_the_results_say(tmp_path):
    results = read_results(write_folder(tmp_path, sample_joints()))
    paths, note = write_schedule(results, tmp_path, LIMITS)
    assert [path.name for path in paths] == ["schedule.csv", "schedule.xlsx"] and note == ""
    rows = {row["joint"]: row for row in csv.DictReader(paths[0].read_text(encoding="utf-8").splitlines())}
    assert [row["verdict"] for row in rows.values()] == [
        "pass",
        "fail",
        "fail",
        "not measured",
        "not measured",
    ]
    widths = [1e3 * (0.02 + 0.014 * 0.1 * k) for k in range(11)]
    wide = rows["wide"]
    for name, value in (("min", min(widths)), ("mean", np.mean(widths)), ("max", max(widths))):
        assert float(wide[f"width {name} (mm)"]) == pytest.approx(value, rel=1e-5)
    assert float(wide["sealant volume (litre)"]) == pytest.approx(0.5)
    assert float(wide["mean less designed (mm)"]) == pytest.approx(7.0)
    assert float(rows["steps"]["largest step (mm)"]) == pytest.approx(4.0)
    assert rows["lost"]["width mean (mm)"] == "" and rows["lost"]["measured"] == "0"
    assert rows["steps"]["element A"] == "'=HYPERLINK(1)"  # text, whatever the element is called


def test_the_workbook_holds_numbers_and_a_frozen_head(tmp_path):
    results = read_results(write_folder(tmp_path, sample_joints()))
    write_schedule(results, tmp_path, LIMITS)
    book = openpyxl.load_workbook(tmp_path / "schedule.xlsx")
    sheet = book["joints"]
    assert sheet.freeze_panes == "C2"
    head = [cell.value for cell in sheet[1]]
    assert head == [column.heading for column in COLUMNS]
    at = {name: k for k, name in enumerate(head)}
    for row in sheet.iter_rows(min_row=2, values_only=True):
        for column, value in zip(COLUMNS, row, strict=True):
            assert value is None or isinstance(value, int | float) == bool(column.style), column.heading
    wide = next(row for row in sheet.iter_rows(min_row=2, values_only=True) if row[0] == "wide")
    assert wide[at["width max (mm)"]] == pytest.approx(34.0)
    assert sheet.max_row == 6
    steps = next(row for row in sheet.iter_rows(min_row=2) if row[0].value == "steps")
    assert steps[at["element A"]].data_type == "s"
    assert dict(book["about"].iter_rows(values_only=True))["limits"].startswith(
        "width at the mouth 12 to 30 mm"
    )
    book.close()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("joints"), "lacks 'joints'"),
        (lambda d: d.update(schema=2), "schema 1 is read here"),
        (lambda d: d["joints"][0]["stations"][0]["frame"].update(origin=[1, 2]), "cannot be used"),
        (lambda d: d["joints"][0].update(elements=["one"]), "cannot be used"),
        (lambda d: d.update(joints=3), "cannot be used"),
    ],
)
def test_a_damaged_results_file_is_one_line(change, message, tmp_path):
    folder = write_folder(tmp_path, sample_joints())
    value = json.loads((folder / "results.json").read_text())
    change(value)
    (folder / "results.json").write_text(json.dumps(value))
    with pytest.raises(ConfigError, match=message) as caught:
        read_results(folder)
    assert "results.json" in str(caught.value)
    (folder / "results.json").write_text("[")
    with pytest.raises(ConfigError, match="is not JSON"):
        read_results(folder)
    with pytest.raises(ConfigError, match=r"holds no results\.json"):
        read_results(tmp_path / "nowhere")
