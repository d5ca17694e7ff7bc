"""Units, what was read, and packed files."""

import gzip

import numpy as np
import pytest

from bimfit.errors import ScanError
from bimfit.scan.formats import read_scan, write_scan
from bimfit.scan.formats.options import UNITS, ReadOptions, unit_name, unit_named


@pytest.mark.parametrize("name", UNITS)
def test_every_unit_scales_lengths_alone(tmp_path, line_scan, name):
    """Against the definitions: 12 inches are a foot, 3937 feet of the US survey are 1200 m."""
    metres = {"m": 1, "cm": 1 / 100, "mm": 1 / 1000, "in": 0.3048 / 12, "ft": 0.3048, "usft": 1200 / 3937}
    write_scan(line_scan, tmp_path / "s.csv")
    back = read_scan(tmp_path / "s.csv", options=ReadOptions(unit=unit_named(name)))
    assert np.allclose(back.origins, line_scan.origins * metres[name], rtol=1e-15)
    assert np.allclose(back.ranges, line_scan.ranges * metres[name], rtol=1e-15, equal_nan=True)
    assert np.array_equal(back.directions, line_scan.directions)
    assert unit_name(unit_named(name)) in back.notes[-1]


def test_units_that_are_none(tmp_path):
    with pytest.raises(ScanError, match="choose from m, mm, cm, ft, usft, in"):
        unit_named("yard")
    for bad in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ScanError, match="unit"):
            ReadOptions(unit=bad)
    with pytest.raises(ScanError, match="pixel"):
        ReadOptions(pixel=(0.1, 0.0, None))


def test_what_was_read_is_said(tmp_path, line_scan, cloud):
    write_scan(line_scan, tmp_path / "s.npz")
    said = read_scan(tmp_path / "s.npz").notes[-1]
    silent = np.isnan(line_scan.ranges).sum()
    assert said.startswith(f"NPZ: 200 beams in 5 sweeps, {silent} without return, seen from 200 places")
    assert "stored in metres" in said
    write_scan(cloud, tmp_path / "c.ply")
    said = read_scan(tmp_path / "c.ply").notes[-1]
    assert said.startswith("PLY: 300 points, seen from (458658.25, 5438229.5, 15.75), stored in metres, from")
    assert f"({cloud.points.min(axis=0)[0]:.10g}"[:10] in said


def test_packed_files_are_unpacked_on_the_way(tmp_path, line_scan):
    write_scan(line_scan, tmp_path / "s.csv")
    data = (tmp_path / "s.csv").read_bytes()
    for name in ("s.csv.gz", "packed.csv"):
        (tmp_path / name).write_bytes(gzip.compress(data))
        back = read_scan(tmp_path / name)
        assert np.array_equal(back.ranges, line_scan.ranges, equal_nan=True)
        assert back.source == str(tmp_path / name)
    whole = gzip.compress(data)
    (tmp_path / "cut.csv.gz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ScanError, match=r"cut\.csv\.gz: packed by gzip, but cut short"):
        read_scan(tmp_path / "cut.csv.gz")
    (tmp_path / "bad.csv.gz").write_bytes(gzip.compress(b"scan,ox\n1,2\n"))
    with pytest.raises(ScanError, match=r"bad\.csv\.gz, line 1: column"):
        read_scan(tmp_path / "bad.csv.gz")
