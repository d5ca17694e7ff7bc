"""A cloud that does not know its sensor: on which side of a joint that is open both ways it was scanned."""

import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.config import Config
from bimfit.geometry.pose import Pose2D
from bimfit.pipeline.fit import fit_joint
from bimfit.pipeline.survey import cut_joint
from bimfit.scan.cloud import PointCloud

sys.path.insert(0, str(Path(__file__).parent))
from worlds import boards, corner_errors, fans

GAP, THICK = 0.020, 0.120
POSES = (Pose2D(-0.003, 0.002, 0.004), Pose2D(0.004, -0.003, -0.003))


@pytest.mark.parametrize("height", [1.2, -1.2])
def test_the_mouth_is_on_the_side_that_was_scanned(height):
    model, joint, profiles = boards(GAP, THICK, (0.3, 0.3), 0.4)
    assert joint.two_sided
    rng = np.random.default_rng(5)
    eye = np.array([0.1, height])
    scan = fans(
        profiles, POSES, np.arange(0.01, 0.4, 0.01), eye, np.radians(np.arange(-12, 12, 0.06)), 1e-3, rng
    )
    hit = np.isfinite(scan.ranges)
    cloud = PointCloud((scan.origins + scan.directions * scan.ranges[:, None])[hit])
    for mouth in (joint, joint.turned()):  # whichever side it is by default
        cut = cut_joint(model, mouth, cloud, Config())
        assert np.sign(cut[0].path.v[0, 2]) == np.sign(height)
    result = fit_joint(*cut, Config(), threads=1)
    z = 0.0 if height > 0.0 else -THICK
    errors = corner_errors(result, POSES, ((-GAP / 2, z), (GAP / 2, z)))
    ok = np.array([station.status.name == "ok" for station in result.stations])
    assert ok.mean() > 0.9
    assert np.nanmax(errors[ok]) < 2e-3


def test_points_on_both_sides_leave_the_mouth_where_more_of_them_are():
    model, joint, _ = boards(GAP, THICK, (0.3, 0.3), 0.2)
    x = np.concatenate([np.arange(-0.2, -0.011, 0.003), np.arange(0.011, 0.2, 0.003)])
    y = np.arange(0.0, 0.2, 0.002)
    grid = np.array(np.meshgrid(x, y)).reshape(2, -1).T
    above, below = (np.column_stack([grid, np.full(len(grid), z)]) for z in (0.0, -THICK))
    for more, sign in (
        (np.concatenate([above, below[::2]]), 1.0),
        (np.concatenate([above[::2], below]), -1.0),
    ):
        facing = cut_joint(model, joint, PointCloud(more), Config())[0]
        assert np.sign(facing.path.v[0, 2]) == sign
