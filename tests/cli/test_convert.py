"""``bimfit convert``: nothing is lost where nothing need be, and what is lost is said."""

import numpy as np
import pytest

from bimfit.cli.main import main
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import read_scan, write_scan

MAP = np.array([458657.0, 5438232.0, 12.0])


@pytest.fixture
def beams(tmp_path):
    rng = np.random.default_rng(0)
    way = rng.normal(size=(60, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    ranges = np.where(rng.random(60) < 0.2, np.nan, rng.uniform(0.5, 4.0, 60))
    scan = LineScan.of(np.repeat([0, 1, 2], 20), np.tile(MAP, (60, 1)), way, ranges)
    write_scan(scan, tmp_path / "s.csv")
    return scan


def test_beams_stay_beams_between_csv_and_npz(tmp_path, beams, capsys):
    assert main(["convert", str(tmp_path / "s.csv"), str(tmp_path / "s.npz")]) == 0
    out = capsys.readouterr()
    assert out.out == f"{tmp_path / 's.npz'}: 60 beams in 3 sweeps\n"
    assert f"{np.isnan(beams.ranges).sum()} without return" in out.err
    assert main(["convert", str(tmp_path / "s.npz"), str(tmp_path / "t.csv")]) == 0
    assert (tmp_path / "t.csv").read_bytes() == (tmp_path / "s.csv").read_bytes()


@pytest.mark.parametrize("suffix", ["ply", "pcd", "xyz", "las", "laz"])
def test_beams_become_points_where_they_must_and_that_is_said(tmp_path, beams, capsys, suffix):
    if suffix in ("las", "laz"):
        pytest.importorskip("laspy")
    assert main(["convert", str(tmp_path / "s.csv"), str(tmp_path / f"p.{suffix}")]) == 0
    silent = np.isnan(beams.ranges).sum()
    assert f"left out: {silent} beams without return\n" in capsys.readouterr().err
    cloud = read_scan(tmp_path / f"p.{suffix}")
    assert isinstance(cloud, PointCloud)
    assert np.allclose(cloud.points, beams.hits, rtol=0, atol=0.51e-4 if suffix in ("las", "laz") else 0)


def test_points_in_feet_are_written_in_metres_and_moved(tmp_path):
    points = np.random.default_rng(1).uniform(-5, 5, (50, 3))
    write_scan(PointCloud(points), tmp_path / "p.ply")
    pose = ["--scan-pose", "458657,5438232,12,0,0,1.5707963267948966"]
    words = ["convert", str(tmp_path / "p.ply"), str(tmp_path / "q.xyz"), "--scan-unit", "ft", *pose]
    assert main(words) == 0
    turned = points[:, [1, 0, 2]] * (-1, 1, 1) * 0.3048
    assert np.allclose(read_scan(tmp_path / "q.xyz").points, turned + MAP, rtol=0, atol=2e-9)


def test_a_height_map_wants_its_pixels(tmp_path, capsys):
    np.save(tmp_path / "h.npy", np.arange(1, 601, dtype=np.uint16).reshape(20, 30))
    assert main(["convert", str(tmp_path / "h.npy"), str(tmp_path / "h.csv")]) == 2
    assert "give --pixel" in capsys.readouterr().err
    assert not (tmp_path / "h.csv").exists()
    words = ["convert", str(tmp_path / "h.npy"), str(tmp_path / "h.csv"), "--pixel", "0.1mm,0.2mm,0.01mm"]
    assert main(words) == 0
    scan = read_scan(tmp_path / "h.csv")
    assert np.allclose(scan.hits[-1], (0.0029, 0.0038, 0.006), rtol=0, atol=1e-12)
    for bad in ("0.1mm", "1,2,3,4", "a,b"):
        assert main([*words[:-1], bad]) == 2
        assert "--pixel" in capsys.readouterr().err


def test_recorded_dialogues_are_scans_too(shared, tmp_path, capsys):
    for name in ("example_urg_04lx.logr", "ug01_fw3.4.03_GD0044072501.reply"):
        assert main(["convert", str(shared / "scip" / name), str(tmp_path / "d.csv")]) == 0
        assert "SCIP dialogue: 682 beams in 1 sweeps" in capsys.readouterr().err
        assert len(read_scan(tmp_path / "d.csv")) == 682


def test_what_cannot_be_is_refused_in_one_line(tmp_path, beams, capsys):
    file = tmp_path / "s.csv"
    before = file.read_bytes()
    (tmp_path / "link.csv").symlink_to(file)
    for words, complaint in (
        ([file, file], "never overwritten"),
        ([file, tmp_path / "link.csv"], "never overwritten"),
        ([file, tmp_path / "s.doc"], "cannot be written as .doc"),
        ([tmp_path / "none.csv", tmp_path / "o.csv"], "cannot be read"),
        ([file, tmp_path / "o.csv", "--scan-unit", "yard"], "unknown unit yard; choose from m, mm"),
        ([file, tmp_path / "o.csv", "--scan-pose", "1,2"], "not a pose"),
    ):
        assert main(["convert", *map(str, words)]) == 2
        err = capsys.readouterr().err
        assert complaint in err and err.count("\n") == 1
    assert file.read_bytes() == before
    assert not (tmp_path / "o.csv").exists()
