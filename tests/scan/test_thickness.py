"""How thick slices are made where a user asks for stations wider apart than the scan is dense."""

import numpy as np
import pytest

from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.path import JointPath
from bimfit.scan.cloud import PointCloud
from bimfit.scan.coverage import slice_thickness

PATH = JointPath.straight((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))
BEARINGS = np.radians(np.arange(-30, 30.1, 1.0))


def sweeps(ys):
    d = np.stack([np.sin(BEARINGS), 0.0 * BEARINGS, -np.cos(BEARINGS)], axis=1)
    o = np.zeros((len(ys), len(d), 3))
    o[:, :, 1], o[:, :, 2] = np.asarray(ys)[:, None], 0.25 * PATH.v[0, 2]
    d[:, 2] *= PATH.v[0, 2]
    return LineScan.of(
        np.repeat(np.arange(len(ys)), len(d)), o.reshape(-1, 3), np.tile(d, (len(ys), 1)),
        np.tile(0.25 / np.cos(BEARINGS), len(ys)),
    )  # fmt: skip


def test_slices_take_what_lies_about_their_station():
    dense, sparse = sweeps(np.arange(0.0, 1.0, 0.004)), sweeps(np.arange(0.0, 1.0, 0.03))
    assert slice_thickness(dense, PATH, None) is None
    assert slice_thickness(dense, PATH, 0.008) is None
    assert slice_thickness(dense, PATH, 0.1) == pytest.approx(0.01)
    assert slice_thickness(sparse, PATH, 0.1) == pytest.approx(0.03, rel=1e-3)
    assert slice_thickness(sparse, PATH, 0.02) == pytest.approx(0.02)


def test_a_sparse_cloud_keeps_slices_thick_enough():
    points = np.random.default_rng(0).uniform((-0.1, 0.0, 0.0), (0.1, 1.0, 0.0), (1000, 3))
    assert slice_thickness(PointCloud(points), PATH, 0.2) == pytest.approx(0.04, rel=0.05)
