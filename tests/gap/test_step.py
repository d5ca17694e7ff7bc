"""The step at the mouth, against moved points and sampled poses."""

from __future__ import annotations

import numpy as np
import pytest

from bimfit.gap.step import gap_step
from bimfit.geometry.joint_section import GapOutline
from bimfit.geometry.pose import Pose2D

OUTLINE = GapOutline(
    np.array([[-0.0125, 0.001], [-0.0125, -0.025]]), np.array([[0.0125, -0.002], [0.0125, -0.025]])
)
POSES = Pose2D(0.004, -0.003, 0.05), Pose2D(-0.002, 0.006, -0.08)


def test_it_is_the_difference_of_the_moved_corners():
    step = gap_step(OUTLINE, *POSES)
    a, b = (
        pose.apply(side[:1])[0] for pose, side in zip(POSES, (OUTLINE.side_a, OUTLINE.side_b), strict=True)
    )
    assert step.value == pytest.approx(b[1] - a[1], abs=1e-15)
    assert step.designed == pytest.approx(-0.003)
    assert step.deviation == pytest.approx(b[1] - a[1] + 0.003)
    assert step.sigma is None
    unmoved = gap_step(OUTLINE, Pose2D(), Pose2D())
    assert unmoved.deviation == 0.0


def test_its_deviation_is_that_of_sampled_poses():
    rng = np.random.default_rng(5)
    covariances = []
    for _ in POSES:
        root = rng.normal(size=(3, 3)) * np.array([2e-4, 2e-4, 2e-3])[:, None]
        covariances.append(root @ root.T)
    step = gap_step(OUTLINE, *POSES, *covariances)
    samples = [
        rng.multivariate_normal(pose.as_array(), cov, 20_000)
        for pose, cov in zip(POSES, covariances, strict=True)
    ]
    heights = [
        np.sin(p[:, 2]) * side[0, 0] + np.cos(p[:, 2]) * side[0, 1] + p[:, 1]
        for p, side in zip(samples, (OUTLINE.side_a, OUTLINE.side_b), strict=True)
    ]
    assert step.sigma == pytest.approx((heights[1] - heights[0]).std(), rel=0.03)
    assert gap_step(OUTLINE, *POSES, covariances[0], None).sigma is None
