"""Slide the combined pose along the joint's u until the missing beams fit (METHOD, section 4, step 1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation import _kernels_likelihood as kernels
from bimfit.estimation.likelihood import BeamModel
from bimfit.estimation.ownership import BeamTable
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D

_REACH = 0.045
_STEP = 0.001
_PRIOR = 0.020
_OUTLIERS = 0.03
_APART = 0.010


@dataclass(frozen=True)
class SlideResult:
    """Where the slide ended.

    Attributes
    ----------
    pose : Pose2D
        The combined pose after the slide.
    steps, scores : ndarray, shape (k,)
        Shifts tried (m) and their log posterior.
    score : float
        The best of them.
    shift : float
        The shift chosen, m.
    rival_odds : float
        Log-odds of the best place more than most of a gap away, against the one chosen.
    rival : Pose2D or None
        That place.
    """

    pose: Pose2D
    steps: Array
    scores: Array
    score: float
    shift: float = 0.0
    rival_odds: float = -math.inf
    rival: Pose2D | None = None


def slide_combined(
    section: JointSection, table: BeamTable, pose: Pose2D, sensor: SensorConfig, fit: FitConfig
) -> SlideResult:
    """Score the union of both components along u and keep the best shift; all beams count alike."""
    gap = section.gap.width
    shifts = _shifts(min(_STEP, max(gap / 8.0, 0.1 * _STEP)))
    model = BeamModel.of(
        sensor,
        sigma=math.hypot(sensor.sigma, 1.2 * fit.placement_sigma),
        outliers=max(_OUTLIERS, sensor.outlier_share),
    )
    a, b = section.components
    scores, best, other = kernels.slide(
        a.rows, b.rows, pose.as_array(), shifts, table.rows, table.start, table.eye, 1.0 / model.sigma,
        math.log(model.amplitude), table.margin, min(_PRIOR, max(0.8 * gap, 0.010)), max(0.8 * gap, _APART),
    )  # fmt: skip
    shift = float(shifts[best])
    if other < 0:
        return SlideResult(_along(pose, shift), shifts, scores, float(scores[best]), shift)
    odds, rival = float(scores[other] - scores[best]), _along(pose, float(shifts[other]))
    return SlideResult(_along(pose, shift), shifts, scores, float(scores[best]), shift, odds, rival)


@lru_cache(maxsize=64)
def _shifts(step: float) -> Array:
    """Shifts to try, m; never changed."""
    count = math.ceil(_REACH / step)
    return np.asarray(np.arange(-count, count + 1, dtype=np.float64) * step)


def _along(pose: Pose2D, shift: float) -> Pose2D:
    """The pose shifted along its own u."""
    return Pose2D(pose.u + shift * math.cos(pose.theta), pose.v + shift * math.sin(pose.theta), pose.theta)


def best_start(
    section: JointSection, table: BeamTable, poses: Sequence[Pose2D], sensor: SensorConfig, fit: FitConfig
) -> SlideResult:
    """Slide from every pose, the combined one first, and keep the best; the others become its rivals."""
    slid = [slide_combined(section, table, pose, sensor, fit) for pose in poses]
    if len(slid) == 1:
        return slid[0]
    chosen = max(slid, key=lambda result: result.score)
    odds, rival = chosen.rival_odds, chosen.rival
    for result in slid:
        apart = math.hypot(result.pose.u - chosen.pose.u, result.pose.v - chosen.pose.v)
        if apart > max(0.8 * section.gap.width, _APART) and result.score - chosen.score > odds:
            odds, rival = result.score - chosen.score, result.pose
    shift = (chosen.pose.u - poses[0].u) * math.cos(poses[0].theta)
    shift += (chosen.pose.v - poses[0].v) * math.sin(poses[0].theta)
    return replace(chosen, shift=shift, rival_odds=odds, rival=rival)
