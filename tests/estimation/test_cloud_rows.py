"""A terrestrial scanner's slice holds several columns of points, each a little aside of the last."""

import numpy as np
import pytest

from bimfit.estimation.cloud import virtual_beams
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.slice import Slice

EYE, GAP = np.array([0.4, 2.0]), 0.03
PITCH = 8e-4


@pytest.mark.parametrize(("columns", "aside"), [(1, 0.0), (4, 0.01), (5, 0.11), (8, 0.08), (4, 0.25)])
def test_only_the_gap_is_filled_with_missing_beams(columns, aside):
    """``aside`` is by what share of the pitch each column lies beside the last."""
    steps = (np.arange(-500, 500)[:, None] + aside * np.arange(columns)).ravel() * PITCH
    bearing = np.arctan2(-EYE[1], -EYE[0]) + np.sort(steps)
    d = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    points = EYE - d * (EYE[1] / d[:, 1])[:, None]
    points = points[(np.abs(points[:, 0]) > 0.5 * GAP) & (np.abs(points[:, 0]) < 0.3)]
    made = virtual_beams(Slice(0.0, points, None, EYE), Pose2D()).beams
    lost = ~np.isfinite(made.ranges)
    o, d = made.origins[lost], made.directions[lost]
    at = o[:, 0] - d[:, 0] * o[:, 1] / d[:, 1]
    assert lost.sum() >= 5
    assert (np.abs(at) < 0.5 * GAP + 0.5 * PITCH * EYE[1]).all()
