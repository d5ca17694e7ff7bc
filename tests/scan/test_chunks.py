"""Scans in pieces: the same points whole and in pieces, and boxes against a naive look at every point."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import bimfit.scan.formats.las as las
import bimfit.scan.formats.pcd as pcd
import bimfit.scan.formats.ply as ply
from bimfit.errors import ScanError
from bimfit.geometry.pose import transform_points
from bimfit.scan.boxes import Boxes
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import FORMATS, read_scan, scan_chunks, text, write_scan
from bimfit.scan.formats.las import read_las
from bimfit.scan.formats.options import ReadOptions


def naive(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    low, high = boxes.min(axis=1), boxes.max(axis=1)
    return ((points[:, None] >= low) & (points[:, None] <= high)).all(axis=2).any(axis=1)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 40),
    size=st.sampled_from([0.0, 0.05, 1.0, 30.0]),
    away=st.sampled_from([0.0, 1e3, 5e6]),
    apart=st.sampled_from([0.0, 5e6]),
)
def test_boxes_keep_just_what_lies_in_one(
    seed: int, count: int, size: float, away: float, apart: float
) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-10, 10, (count, 1, 3)) + away
    array = corners + rng.uniform(-1, 1, (count, 2, 3)) * size
    array[::3, :, 1] += apart  # the same places in other coordinates
    boxes = Boxes.of(array)
    points = np.concatenate(
        [
            rng.uniform(-12, 12, (300, 3)) + away,
            rng.uniform(-12, 12, (100, 3)) + away + np.array([0.0, apart, 0.0]),
            boxes.array.reshape(-1, 3),  # corners belong to their box
            boxes.array.mean(axis=1),
            [[np.nan, away, away], [np.inf, away, away]],
        ]
    )
    kept = naive(array, points)
    assert np.array_equal(boxes.inside(points), kept)
    index, cell = boxes.find(*points.T)
    assert np.array_equal(index, np.flatnonzero(kept))
    for k in range(0, count, 7):
        within = naive(array[k : k + 1], points[index])
        assert np.isin(cell[within], boxes.cells_of(boxes.array[k])).all()


def test_boxes_take_integers_with_scale_and_offset_of_any_stride() -> None:
    rng = np.random.default_rng(1)
    raw = rng.integers(-10_000, 10_000, (50_000, 5)).astype(np.int32)
    scale, offset = np.array([1e-3, 2e-3, 1e-3]), np.array([458_657.0, 5_438_232.0, 100.0])
    points = raw[:, :3] * scale + offset
    low = offset + rng.uniform(-10, 8, (30, 3))
    array = np.stack([low, low + rng.uniform(0.1, 3, (30, 3))], axis=1)
    index, _ = Boxes.of(array).find(raw[:, 0], raw[:, 1], raw[:, 2], scale, offset)
    assert np.array_equal(index, np.flatnonzero(naive(array, points)))


def test_boxes_moved_hold_what_they_held() -> None:
    rng = np.random.default_rng(2)
    array = rng.uniform(-5, 5, (20, 2, 3))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = 0.9996 * turn, (458_657.0, 5_438_232.0, 30.0)
    points = rng.uniform(-6, 6, (5000, 3))
    inside = Boxes.of(array).inside(points)
    assert 0 < inside.sum() < len(points)
    assert Boxes.of(array).moved(T).inside(transform_points(T, points))[inside].all()


def test_bad_boxes_are_refused() -> None:
    for bad in (np.zeros((0, 2, 3)), np.zeros((4, 3)), np.full((1, 2, 3), np.nan)):
        with pytest.raises(ValueError, match="boxes take"):
            Boxes.of(bad)


def cloud(count: int, away: float = 0.0) -> PointCloud:
    rng = np.random.default_rng(count)
    points = np.round(np.array([away, 10 * away, 0.0]) + rng.uniform(-3, 3, (count, 3)), 4)
    return PointCloud(points, intensity=rng.integers(0, 255, count).astype(float))


def write_las(scan: PointCloud, path: Path) -> None:
    import laspy

    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales, header.offsets = np.full(3, 1e-4), np.floor(scan.points.min(axis=0))
    record = laspy.ScaleAwarePointRecord.zeros(len(scan), header=header)
    record.x, record.y, record.z = scan.points.T
    record.intensity = scan.intensity
    with laspy.open(path, "w", header=header) as writer:
        writer.write_points(record)


WRITERS = {".las": write_las, ".laz": write_las}
SUFFIXES = [s for form in FORMATS for s in form.extensions if form.write or s in WRITERS]


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("piece", [97, 1000])
def test_pieces_are_the_file(tmp_path, monkeypatch, suffix: str, piece: int) -> None:
    """In order and without loss, in other units too; and with boxes at least what lies in them."""
    monkeypatch.setattr(las, "_CHUNK", piece)
    for module in (ply, pcd):
        monkeypatch.setattr(module, "PIECE", piece)
    monkeypatch.setattr(text, "CHUNK", 40 * piece)
    path = tmp_path / f"cloud{suffix}"
    made = cloud(997, 45_000.0)
    WRITERS.get(suffix, write_scan)(made, path)
    whole = read_scan(path)
    assert isinstance(whole, PointCloud)
    pieces = list(scan_chunks(path))
    assert len(pieces) > 5 or piece == 1000 or suffix in (".csv", ".npz")
    assert np.array_equal(np.concatenate([p.points for p in pieces]), whole.points)
    np.testing.assert_allclose(whole.points, made.points, atol=1e-4, rtol=0)
    said = pieces[0].notes[-1]
    assert said.endswith(", in metres") and whole.notes[-1].startswith(said.split(",")[0] + ": ")
    assert {note for p in pieces for note in p.notes} - {said} == set(whole.notes[:-1])
    in_mm = np.concatenate([p.points for p in scan_chunks(path, ReadOptions(1e-3))])
    np.testing.assert_allclose(in_mm, 1e-3 * whole.points, rtol=1e-15)
    low = made.points[:5] - 0.5
    boxes = Boxes.of(np.stack([low, low + 1.0], axis=1))
    some = np.concatenate([p.points for p in scan_chunks(path, ReadOptions(boxes=boxes.array))])
    assert np.array_equal(some[boxes.inside(some)], whole.points[boxes.inside(whole.points)])
    small = np.concatenate([p.points for p in scan_chunks(path, ReadOptions(1e-3, boxes=1e-3 * boxes.array))])
    np.testing.assert_allclose(small, 1e-3 * some, rtol=1e-15)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_pieces_leave_out_what_no_box_holds(tmp_path, monkeypatch, suffix: str) -> None:
    monkeypatch.setattr(las, "_CHUNK", 100)
    path = tmp_path / f"cloud{suffix}"
    write_las(cloud(1000), path)
    made = read_las(path)
    boxes = Boxes.of(np.array([[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]]))
    pieces = list(scan_chunks(path, ReadOptions(boxes=boxes.array)))
    assert len(pieces) == 10
    assert np.array_equal(np.concatenate([p.points for p in pieces]), made.points[boxes.inside(made.points)])
    assert np.array_equal(
        np.concatenate([p.intensity for p in pieces]), made.intensity[boxes.inside(made.points)]
    )
    nowhere = Boxes.of(boxes.array + 100.0)
    assert sum(map(len, scan_chunks(path, ReadOptions(boxes=nowhere.array)))) == 0


def test_a_file_cut_short_is_told(tmp_path) -> None:
    path = tmp_path / "cloud.las"
    write_las(cloud(1000), path)
    path.write_bytes(path.read_bytes()[:-400])
    boxes = Boxes.of(np.array([[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]]))
    for wanted in (None, boxes.array):
        # a record of point format 0 has 20 bytes
        with pytest.raises(ScanError, match=r"cut short: 980 of 1,000 points; .*again"):
            list(scan_chunks(path, ReadOptions(boxes=wanted)))
    with pytest.raises(ScanError, match="unit"):
        next(scan_chunks(path, ReadOptions(-1.0)))
