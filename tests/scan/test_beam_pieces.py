"""Line scans larger than memory: read in pieces, and only what passes near the places kept."""

import numpy as np
import pytest

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan, continued
from bimfit.scan.boxes import Boxes
from bimfit.scan.formats import npz, read_scan, scan_chunks, text, write_scan
from bimfit.scan.nearby import Gatherer, passing_sweeps


def beams(count=900, sweep=37, seed=5):
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions[::11] = (0.0, 0.0, -1.0)  # along an axis
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges = rng.uniform(0.1, 4.0, count)
    ranges[rng.random(count) < 0.2] = np.nan
    scan = LineScan.of(np.arange(count) // sweep, rng.uniform(-2, 2, (count, 3)), directions, ranges)
    times = np.round(rng.uniform(0, 9, count), 3)
    return LineScan(scan.scan, scan.origins, scan.directions, scan.ranges, extra={"time": times})


def same(a, b):
    return all(
        np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
        for name in ("scan", "origins", "directions", "ranges")
    ) and np.array_equal(a.extra["time"], b.extra["time"])


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".txt"])
def test_pieces_are_the_scan(tmp_path, monkeypatch, suffix):
    made, path = beams(), tmp_path / f"s{suffix}"
    write_scan(made, tmp_path / "s.csv")
    (tmp_path / "s.csv").replace(path) if suffix == ".txt" else write_scan(made, path)
    monkeypatch.setattr(text, "CHUNK", 5000)
    monkeypatch.setattr(npz, "_PIECE", 100)
    pieces = list(scan_chunks(path))
    assert len(pieces) > 5
    assert same(continued(pieces), made) and same(read_scan(path), made)


def test_the_line_of_an_error_in_a_later_piece(tmp_path, monkeypatch):
    path = tmp_path / "s.csv"
    write_scan(beams(), path)
    lines = path.read_text().split("\n")
    lines[700] = lines[700].replace(lines[700].split(",")[4], "0.99999", 1)
    path.write_text("\n".join(lines))
    monkeypatch.setattr(text, "CHUNK", 5000)
    with pytest.raises(ScanError, match=r"line 701, column dx,dy,dz"):
        list(scan_chunks(path))


def test_the_row_of_an_error_in_a_later_piece(tmp_path, monkeypatch):
    made = beams()
    columns = dict(zip(("ox", "oy", "oz"), made.origins.T, strict=True))
    columns |= dict(zip(("dx", "dy", "dz"), made.directions.T.copy(), strict=True))
    columns["dx"][812] = 7.0
    np.savez(tmp_path / "s.npz", scan=made.scan, range=made.ranges, **columns)
    monkeypatch.setattr(npz, "_PIECE", 100)
    with pytest.raises(ScanError, match="row 812"):
        list(scan_chunks(tmp_path / "s.npz"))


def test_a_cut_off_archive_is_refused_in_pieces_too(tmp_path, monkeypatch):
    write_scan(beams(), tmp_path / "s.npz")
    whole = (tmp_path / "s.npz").read_bytes()
    monkeypatch.setattr(npz, "_PIECE", 100)
    for share in (0.3, 0.7, 0.99):
        (tmp_path / "cut.npz").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ScanError, match="cut short"):
            list(scan_chunks(tmp_path / "cut.npz"))


def test_a_column_of_words_far_down_is_left_out(tmp_path, monkeypatch):
    path = tmp_path / "s.csv"
    write_scan(beams(), path)
    lines = path.read_text().split("\n")
    lines[800] = ",".join([*lines[800].split(",")[:-1], "late"])
    path.write_text("\n".join(lines))
    monkeypatch.setattr(text, "CHUNK", 5000)
    read = read_scan(path)
    assert len(read) == 900 and not read.extra


@pytest.mark.parametrize("mark", [";", "\t"])
def test_decimal_commas_of_a_spreadsheet(tmp_path, mark):
    made = beams()
    write_scan(made, tmp_path / "s.csv")
    rows = (tmp_path / "s.csv").read_text().replace(",", mark).replace(".", ",")
    (tmp_path / "german.csv").write_bytes(b"\xef\xbb\xbf" + rows.replace("\n", "\r\n").encode())
    assert same(read_scan(tmp_path / "german.csv"), made)


@pytest.mark.parametrize("mark", [";", " ", "\t", "; "])
def test_points_with_decimal_commas(tmp_path, mark):
    points = np.round(np.random.default_rng(1).uniform(-9, 9, (50, 3)), 3)
    rows = "\n".join(mark.join(repr(x) for x in row) for row in points.tolist()).replace(".", ",")
    (tmp_path / "p.xyz").write_text(rows + "\n")
    assert np.array_equal(read_scan(tmp_path / "p.xyz").points, points)


@pytest.mark.parametrize(
    ("content", "remedy"),
    [
        ("scan,ox\r0,1\r0,2\r", "line ends"),
        ("scan,ox\n0,1\n".encode("utf-16"), "UTF-8"),
    ],
)
def test_what_a_spreadsheet_may_have_done_is_named(tmp_path, content, remedy):
    (tmp_path / "s.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ScanError, match=remedy):
        read_scan(tmp_path / "s.csv")


def test_sweeps_that_pass_a_place_against_points_along_their_beams():
    scan = beams(400, sweep=1)
    low = np.random.default_rng(2).uniform(-2, 2, (6, 3))
    boxes = Boxes.of(np.stack([low, low + 0.6], axis=1))
    far = np.where(scan.returned, scan.ranges, 10.0)
    steps = np.linspace(0.0, 1.0, 4001)
    brute = [
        bool(boxes.inside(o + d * (r * steps)[:, None]).any())
        for o, d, r in zip(scan.origins, scan.directions, far, strict=True)
    ]
    assert 30 < sum(brute) < 350
    assert passing_sweeps(scan, boxes).scan.tolist() == np.flatnonzero(brute).tolist()


def test_a_large_scan_keeps_the_sweeps_that_pass_and_them_whole():
    made = beams(900)
    boxes = Boxes.of([[[0.0, 0.0, 0.0], [0.3, 0.3, 0.3]]])
    gatherer = Gatherer(boxes, most_beams=200)
    for rows in np.split(np.arange(900), [111, 300, 555]):
        gatherer.add(made.taken(rows))
    kept = gatherer.done().scan
    wanted = passing_sweeps(made, boxes)
    assert set(wanted.sweeps) == set(kept.sweeps) and len(kept.sweeps) < len(made.sweeps)
    few = Gatherer(boxes)
    few.add(made)
    assert len(few.done().scan) == 900
