import numpy as np
import pytest

from bimfit.geometry.line_scan import LineScan, joined


def make(numbers, ranges, y=0.0):
    count = len(numbers)
    return LineScan.of(
        numbers, np.tile([0.0, y, 1.0], (count, 1)), np.tile([0.0, 0.0, -1.0], (count, 1)), ranges
    )


def test_hits_are_where_the_beams_ended():
    scan = make([3, 3, 7], [0.25, np.inf, 1.0])
    assert len(scan) == 3
    assert np.array_equal(scan.returned, [True, False, True])
    assert np.isnan(scan.ranges[1])
    assert np.allclose(scan.hits, [(0, 0, 0.75), (0, 0, 0)])
    assert np.array_equal(scan.sweeps, [3, 7])
    assert np.allclose(scan.bounds, [(0, 0, 0), (0, 0, 0.75)])
    assert np.isnan(make([0], [np.nan]).bounds).all()


def test_a_rigid_motion_moves_hits_and_keeps_ranges():
    T = np.array([[0, -1, 0, 10.0], [1, 0, 0, 20.0], [0, 0, 1, 30.0], [0, 0, 0, 1]])
    scan = make([0, 0], [0.25, np.nan], y=2.0)
    moved = scan.transformed(T)
    assert np.allclose(moved.hits, [(8.0, 20.0, 30.75)])
    assert np.array_equal(moved.ranges, scan.ranges, equal_nan=True)
    assert np.allclose(moved.transformed(np.linalg.inv(T)).origins, scan.origins)
    assert np.allclose(scan.origins, (0.0, 2.0, 1.0))


def test_joined_scans_are_numbered_on():
    scan = joined([make([5, 5, 9], [1, 1, 1]), make([5], [2]), make([], [])], "both")
    assert np.array_equal(scan.scan, [0, 0, 1, 2])
    assert np.array_equal(scan.ranges, [1, 1, 1, 2])
    assert scan.source == "both"
    assert len(joined([])) == 0


def test_columns_that_do_not_belong_together():
    with pytest.raises(ValueError, match="2 sweep numbers"):
        LineScan.of([0, 1], np.zeros((1, 3)), np.zeros((1, 3)), [1.0])
