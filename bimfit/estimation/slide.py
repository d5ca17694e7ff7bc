"""Slide the combined pose along the joint's u until the missing beams fit (METHOD, section 4, step 1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation import _kernels
from bimfit.estimation.likelihood import BeamModel, BeamSet, edge_rows
from bimfit.estimation.ownership import Cost, packed
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
    shift: float = 0.0
    rival_odds: float = -math.inf
    rival: Pose2D | None = None


def slide_combined(
    section: JointSection, beams: BeamSet, cost: Cost, pose: Pose2D, sensor: SensorConfig, fit: FitConfig
) -> SlideResult:
    """Score the union of both components along u and keep the best shift.

    Parameters
    ----------
    cost : Cost
        What covering each beam adds besides its residual.
    """
    gap = designed_width(section)
    step = min(_STEP, max(gap / 8.0, 0.1 * _STEP))
    count = math.ceil(_REACH / step)
    shifts: Array = np.arange(-count, count + 1, dtype=np.float64) * step
    axis = pose.turn((1.0, 0.0))
    model = BeamModel.of(
        sensor,
        sigma=math.hypot(sensor.sigma, 1.2 * fit.placement_sigma),
        outliers=max(_OUTLIERS, sensor.outlier_share),
    )
    scores = np.empty(len(shifts))
    a, b = (edge_rows(component) for component in section.components)
    _kernels.slide(
        a, b, pose.as_array(), shifts[:, None] * axis, packed(beams, cost, model, alike=True), beams.start,
        beams.eye, cost.margin, min(_PRIOR, max(0.8 * gap, 0.010)), scores,
    )  # fmt: skip
    best = int(np.argmax(scores))
    moved = Pose2D(pose.u + shifts[best] * axis[0], pose.v + shifts[best] * axis[1], pose.theta)
    away = np.flatnonzero(np.abs(shifts - shifts[best]) > max(0.8 * gap, _APART))
    odds, rival = -math.inf, None
    if len(away):
        other = int(away[np.argmax(scores[away])])
        odds = float(scores[other] - scores[best])
        rival = Pose2D(pose.u + shifts[other] * axis[0], pose.v + shifts[other] * axis[1], pose.theta)
    return SlideResult(moved, shifts, scores, float(shifts[best]), odds, rival)


def best_start(
    section: JointSection,
    beams: BeamSet,
    cost: Cost,
    poses: Sequence[Pose2D],
    sensor: SensorConfig,
    fit: FitConfig,
) -> SlideResult:
    """Slide from every pose, the combined one first, and keep the best; the others become its rivals."""
    slid = [slide_combined(section, beams, cost, pose, sensor, fit) for pose in poses]
    top = [float(result.scores.max()) for result in slid]
    best = int(np.argmax(top))
    chosen = slid[best]
    odds, rival = chosen.rival_odds, chosen.rival
    for result, score in zip(slid, top, strict=True):
        apart = math.hypot(result.pose.u - chosen.pose.u, result.pose.v - chosen.pose.v)
        if apart > max(0.8 * designed_width(section), _APART) and score - top[best] > odds:
            odds, rival = score - top[best], result.pose
    shift = float(
        (chosen.pose.u - poses[0].u) * math.cos(poses[0].theta)
        + (chosen.pose.v - poses[0].v) * math.sin(poses[0].theta)
    )
    return replace(chosen, shift=shift, rival_odds=odds, rival=rival)


def designed_width(section: JointSection) -> float:
    """Designed width between the mouth corners, m."""
    a, b = section.gap.mouth
    return float(np.hypot(*(b - a)))
