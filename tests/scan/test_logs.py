"""CARMEN logs, UBH and BreezySLAM tables."""

import gzip
import math

import numpy as np
import pytest

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.formats import read_scan

TAIL = "0.1 0.2 0.3 1234.5 host 0.5"


def flaser(ranges, x, y, theta, tail=TAIL):
    return f"FLASER {len(ranges)} {' '.join(map(repr, ranges))} {x!r} {y!r} {theta!r} {tail}\n"


def robotlaser(ranges, pose, *, first, field, step, greatest, remissions=None):
    bright = "" if remissions is None else f"{len(remissions)} {' '.join(map(str, remissions))} "
    return (
        f"ROBOTLASER1 0 {first!r} {field!r} {step!r} {greatest!r} 0.01 0 {len(ranges)} "
        f"{' '.join(map(repr, ranges))} {bright}{' '.join(map(repr, pose))} 9 9 9 0.1 0.2 0.3 0.4 0 "
        f"77.25 host 0.5\n"
    )


def written(tmp_path, text, name="robot.log"):
    (tmp_path / name).write_text(text)
    return tmp_path / name


# -- CARMEN ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "step"), [(180, 1.0), (181, 1.0), (360, 0.5), (361, 0.5)])
def test_flaser_beams_lie_where_the_robot_and_the_bearing_put_them(tmp_path, count, step):
    """Against complex numbers: a return is the robot's place plus its range, turned."""
    rng = np.random.default_rng(0)
    ranges = rng.uniform(0.5, 8.0, count).round(3).tolist()
    poses = [(458657.125, 5438232.5, 0.4), (458657.25, 5438232.75, -2.0)]
    text = "# CARMEN Logfile\nPARAM a b\nODOM 0 0 0 0 0 0 1 h 1\n"
    text += "".join(flaser(ranges, *pose) for pose in poses)
    scan = read_scan(written(tmp_path, text))
    assert np.array_equal(scan.scan, np.repeat([0, 1], count))
    for k, (x, y, theta) in enumerate(poses):
        angles = theta + np.radians(-90.0 + step * np.arange(count))
        expected = complex(0, 0) + np.array(ranges) * np.exp(1j * angles)
        hits = scan.hits[scan.scan == k] - (x, y, 0.0)
        assert np.allclose(hits[:, 0] + 1j * hits[:, 1], expected, atol=1e-8)
        assert np.array_equal(hits[:, 2], np.zeros(count))
    assert np.array_equal(np.unique(scan.extra["time"]), [1234.5])


def test_robotlaser_says_its_own_field_and_greatest_range(tmp_path):
    ranges = [1.0, 2.0, 30.0, 29.99, 0.0, 31.0]
    for remissions in (None, [], [5, 6, 7, 8, 9, 10]):
        text = robotlaser(
            ranges, (1.0, 2.0, math.pi / 2), first=-0.5, field=1.0, step=0.2, greatest=30.0,
            remissions=remissions,
        )  # fmt: skip
        scan = read_scan(written(tmp_path, text))
        assert np.array_equal(scan.returned, [True, True, False, True, False, False])
        assert np.allclose(scan.hits[1], (1.0 + 2.0 * math.sin(0.3), 2.0 + 2.0 * math.cos(0.3), 0.0))
        assert np.allclose(scan.origins, (1.0, 2.0, 0.0))
        assert np.array_equal(scan.extra["time"], [77.25] * 6)


def test_a_greatest_reading_means_nothing_only_where_it_is_repeated_and_far_off(tmp_path):
    near = [1.0 + 0.01 * k for k in range(90)]
    far = read_scan(written(tmp_path, flaser(near + [81.83] * 90, 0, 0, 0)))
    assert np.array_equal(far.returned, [True] * 90 + [False] * 90)
    assert "81.83 m count as nothing" in far.notes[0]
    wall = read_scan(written(tmp_path, flaser(near + [2.0] * 90, 0, 0, 0)))
    assert wall.returned.all()


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        (flaser([1.0] * 180, 0, 0, 0)[:300], "line 3: FLASER is cut short"),
        (flaser([1.0] * 180, 0, 0, 0).replace("1.0", "one", 1), "line 3: FLASER with something"),
        ("FLASER many 1 2 3\n", "line 3: FLASER does not begin"),
        ("FLASER -5 1 2 3\n", "line 3: FLASER with -5 readings"),
        ("FLASER 99999999999 1 2 3\n", "line 3: FLASER with 99999999999 readings"),
        (flaser([1.0] * 180, "inf", 0, 0).replace("'inf'", "inf"), "line 3: FLASER from no place"),
        (
            robotlaser([1.0], (0, 0, 0), first=0.0, field=99.0, step=0.1, greatest=9.0),
            "line 3: ROBOTLASER1 with a field",
        ),
        ("RLASER 1 2 3\n", "no FLASER or ROBOTLASER1 message; it has RLASER"),
    ],
)
def test_damaged_carmen_lines_are_named(tmp_path, line, complaint):
    with pytest.raises(ScanError, match=complaint) as error:
        read_scan(written(tmp_path, "PARAM a b\nODOM 0 0 0 0 0 0 1 h 1\n" + line))
    assert "robot.log" in str(error.value)


def test_the_intel_log(shared):
    """Against counts by awk, and the rooms: seen from many places, they must lie where they lay."""
    scan = read_scan(shared / "lidar" / "intel-corrected.log.gz")
    assert len(scan.sweeps) == 910 and len(scan) == 910 * 180
    assert np.count_nonzero(~scan.returned) == 4172
    with gzip.open(shared / "lidar" / "intel-corrected.log.gz", "rt") as log:
        first = next(line.split() for line in log if line.startswith("FLASER"))
    values = np.array(first[2:182], float)
    assert np.allclose(scan.ranges[:180], np.where(values > 80.0, np.nan, values), equal_nan=True)
    assert np.allclose(scan.origins[0], (float(first[182]), float(first[183]), 0.0))
    # rooms seen again and again: most 10 cm cells that were hit were hit in several sweeps
    cells = np.unique(np.c_[np.floor(scan.hits[:, :2] / 0.1), scan.scan[scan.returned]], axis=0)
    _, sweeps = np.unique(cells[:, :2], axis=0, return_counts=True)
    assert np.average(sweeps > 2, weights=sweeps) > 0.8


# -- UBH ---------------------------------------------------------------------------------------------


def ubh(scans, *, front=384, total=1024, start=44, end=725, turn=100, extra=""):
    head = (
        f"[timestamp]\n0\n[model]\nURG-04LX(Hokuyo)\n[frontStep]\n{front}\n[totalSteps]\n{total}\n"
        f"[startStep]\n{start}\n[endStep]\n{end}\n[scanMsec]\n{turn}\n[captureMode]\nGD_Capture_mode\n{extra}"
    )
    return head + "".join(f"[timestamp]\n{t}\n[logtime]\n2026:11:26\n[scan]\n{s}\n" for t, s in scans)


def test_ubh_sweeps(tmp_path):
    values = [1000 + k for k in range(682)]
    values[3], values[4], values[5] = 0, 7, 19
    file = written(
        tmp_path, ubh([(500, ";".join(map(str, values))), (600, ";".join(map(str, values)))]), "a.ubh"
    )
    scan = read_scan(file)
    assert len(scan.sweeps) == 2 and len(scan) == 2 * 682
    assert np.array_equal(np.flatnonzero(~scan.returned[:682]), [3, 4, 5])
    assert scan.ranges[10] == 1.010
    ahead = 384 - 44
    assert np.allclose(scan.directions[ahead], (1, 0, 0))
    assert np.allclose(scan.directions[ahead + 256], (0, 1, 0))  # a quarter turn to the left
    assert np.array_equal(scan.extra["code"][:6], [1000, 1001, 1002, 0, 7, 19])
    assert scan.extra["time"][ahead] == pytest.approx(0.5 + 384 / 1024 * 0.1)
    assert scan.extra["time"][682 + ahead] - scan.extra["time"][ahead] == pytest.approx(0.1)
    assert "2 nothing in range" in scan.notes[0] and "2 neighbouring steps failed" in scan.notes[0]


def test_ubh_echoes_intensities_and_merged_steps(tmp_path):
    cells = ";".join(f"{1000 + k}|{k}&{2000 + k}|9" for k in range(541))
    file = written(tmp_path, ubh([(0, cells)], front=540, total=1440, start=0, end=1080, turn=25), "b.ubh")
    scan = read_scan(file)
    assert np.allclose(scan.ranges, (1000 + np.arange(541)) / 1000)
    assert np.array_equal(scan.extra["intensity"], np.arange(541))
    bearing = np.degrees(np.arctan2(scan.directions[:, 1], scan.directions[:, 0]))
    # pairs of quarter degrees; the last stands alone
    assert np.allclose(bearing[:-1], -135 + 0.125 + 0.5 * np.arange(540))
    assert bearing[-1] == pytest.approx(135)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (("[frontStep]\n384\n", ""), r"no number for \[frontStep\]"),
        (("[totalSteps]\n1024", "[totalSteps]\n0"), "steps do not hold together"),
        (("1000;", "1e3;"), "line 22: .scan. with something that is no number"),
        (("1000;", ""), "681 values for the steps"),
        (("[timestamp]\n500", "[timestamp]\nnoon"), "line 18: 'noon' is no number"),
        (("[scan]\n", "[scn]\n"), "holds no .scan."),
    ],
)
def test_damaged_ubh(tmp_path, change, complaint):
    text = ubh([(500, ";".join(str(1000 + k) for k in range(682)))])
    assert change[0] in text
    with pytest.raises(ScanError, match=complaint):
        read_scan(written(tmp_path, text.replace(*change), "c.ubh"))


# -- BreezySLAM --------------------------------------------------------------------------------------


def test_the_breezyslam_table(shared):
    """Against the table as NumPy reads it."""
    file = shared / "lidar" / "breezyslam_exp2.dat"
    table = np.loadtxt(file)
    scan = read_scan(file)
    assert isinstance(scan, LineScan)
    raw = table[:, 24:706].reshape(-1)
    assert np.array_equal(scan.extra["code"], raw)
    assert np.array_equal(scan.returned, raw >= 20)
    assert np.allclose(scan.ranges[scan.returned], raw[raw >= 20] / 1000.0)
    assert np.allclose(np.diff(scan.extra["time"][::682]), np.diff(table[:, 0]) * 1e-6)
    bearing = np.degrees(np.arctan2(scan.directions[:682, 1], scan.directions[:682, 0]))
    assert np.allclose(np.diff(bearing), 360 / 1024)
    assert np.allclose(np.abs(bearing[[0, -1]]), 120, atol=0.5)
    assert "241,623 nothing in range" in scan.notes[0]  # of the 682 columns that are ranges


def test_damaged_breezyslam_tables(tmp_path):
    row = " ".join(["5"] * 707)
    with pytest.raises(ScanError, match=r"line 2: 706 cells where 707"):
        read_scan(written(tmp_path, f"{row}\n{row[2:]}\n", "t.dat"))
    with pytest.raises(ScanError, match=r"line 2, column 31: 'x' is not a number"):
        read_scan(
            written(tmp_path, row + "\n" + row.replace("5", "x", 31).replace("x", "5", 30) + "\n", "t.dat")
        )
