"""Scans to write and read."""

from __future__ import annotations

import numpy as np
import pytest

from bimfit.geometry.line_scan import LineScan
from bimfit.scan.cloud import PointCloud

MAP = np.array([458657.0, 5438232.0, 12.0])


@pytest.fixture
def line_scan():
    """Five sweeps at map coordinates, a fifth of the beams without return, in full float64."""
    rng = np.random.default_rng(1)
    number = np.repeat(np.arange(5), 40)
    origins = MAP + np.stack([0.1 * rng.random(200), 0.01 * number, 0.25 + 0.0 * number], axis=1)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges = rng.uniform(0.1, 5.0, 200)
    ranges[rng.random(200) < 0.2] = np.nan
    return LineScan.of(number, origins, directions, ranges, "made up")


@pytest.fixture
def cloud():
    """Points at map coordinates with all that a cloud can carry."""
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(
        MAP + rng.uniform(-5.0, 5.0, (300, 3)),
        viewpoint=MAP + np.array([1.25, -2.5, 3.75]),
        normals=normals,
        colors=rng.integers(0, 256, (300, 3)).astype(np.uint8),
        intensity=rng.random(300),
    )
