"""Both components of a station near a combined pose, each given the other (METHOD, section 4)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation import checks
from bimfit.estimation.context import Context, station_context
from bimfit.estimation.likelihood import edge_rows
from bimfit.estimation.ownership import (
    Cost,
    Ints,
    Mask,
    Scene,
    cover_cost,
    first_round,
    meeting,
    second_round,
    split_side,
)
from bimfit.estimation.posterior import Posterior, Window, component_posterior
from bimfit.estimation.residuals import residuals_of
from bimfit.estimation.result import Residuals, StationEstimate
from bimfit.estimation.slide import SlideResult
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile
from bimfit.geometry.slice import Slice

_FEW_THROUGH = 3
_LOOSE = 5.0


def components_at(
    context: Context,
    slice_: Slice,
    slid: SlideResult,
    cost: Cost,
    matches: tuple[Pose2D | None, Pose2D | None],
    reason: str,
) -> StationEstimate:
    """Estimate both components about a slid combined pose, and judge them.

    Parameters
    ----------
    matches : tuple of two (Pose2D or None)
        Each component's own search result: another place to start from.
    reason : str
        Why a hole between points is no evidence; empty where it is.
    """
    pose, beams = slid.pose, context.beams
    scene = context.scene((pose, pose))
    side = split_side(scene, beams, np.array([pose.u, pose.v]))
    usable = context.usable(scene, side, pose)
    window = context.window
    first: list[Posterior | None] = []
    for which in (0, 1):
        use = first_round(which, scene, side)
        first.append(_one(context, which, pose, use & usable, cost, window, matches[which]))
    posteriors = first
    poses = [p.pose if p is not None else pose for p in posteriors]
    scene = context.scene(poses)
    passed = context.passed(poses, scene)
    both = np.isfinite(scene.rho[0]) & np.isfinite(scene.rho[1])
    if all(p is not None for p in first) and (
        bool(np.any(both & usable)) or passed < _FEW_THROUGH or meeting(scene, _FEW_THROUGH)
    ):
        posteriors = list(first)
        # near the mouth two bodies lie side by side; deep in a groove they meet, nobody knows just where
        shallow = pose.inverse().apply(beams.points)[:, 1] > -3.0 * context.sensor.sigma
        for which in (0, 1):
            use, spent = second_round(
                which, scene, side, beams, cost, context.model, territory=shallow & (passed > 0)
            )
            posteriors[which] = _one(context, which, pose, use & usable, spent, window, poses[which])
            poses[which] = posteriors[which].pose if posteriors[which] is not None else pose  # type: ignore[union-attr]
            scene = context.scene(poses)
        passed = context.passed(poses, scene)
    if reason:
        posteriors = [p if p is None else _loosened(context, p) for p in posteriors]
    residuals = [_residuals(context, which, scene, side, usable, posteriors[which]) for which in (0, 1)]
    steps = [_corner_step(context, which, poses[which]) for which in (0, 1)]
    return checks.judge_station(
        slice_.s, context.section, slid, (posteriors[0], posteriors[1]), (residuals[0], residuals[1]),
        (steps[0], steps[1]), window, context.sensor, context.fit, passed, reason, context.virtual,
    )  # fmt: skip


def _one(
    context: Context, which: int, prior: Pose2D, use: Mask, cost: Cost, window: Window,
    begin: Pose2D | None,
) -> Posterior | None:  # fmt: skip
    """Posterior of one component from the beams in ``use``; None where hardly any meets it."""
    return component_posterior(
        context.rows[which], prior, context.beams, cost, context.model, window, use=use, begin=begin
    )


def _loosened(context: Context, p: Posterior) -> Posterior:
    """Points at random end up to two of their spacings, or of their noise, from an edge (see cloud.py)."""
    if p.weak_sd_ranges < context.sensor.sigma:
        return p
    reach = float(np.hypot(*(p.pivot - context.beams.eye[0, :2])))
    sd = 2.0 * max(context.sensor.sigma, context.beams.spacing * reach)
    wider = np.diag([sd * sd, 0.0, 0.0])
    return dataclasses.replace(
        p,
        covariance=p.covariance + wider,
        pivot_covariance=p.pivot_covariance + wider,
        weak_sd=math.hypot(p.weak_sd, sd * abs(float(p.weak_axis[0]))),
    )


def _corner_step(context: Context, which: int, pose: Pose2D) -> float:
    """Bearing of a mouth corner from the first sensor position, in beam steps.

    Counted from the middle of the beams, which is fixed to the sensor; beams made up from points have no
    middle of their own and are counted from the designed mouth. Not from farther off: the steps differ a
    little from slice to slice, and so many of them would hide that two slices see a corner in the same place.
    """
    if context.beams.spacing <= 0.0:
        return math.nan
    x, y = pose.apply(context.section.gap.mouth[which]) - context.beams.eye[0, :2]
    lx, ly = -context.beams.eye[0, :2] if context.virtual else context.beams.eye[0, 2:]
    return math.atan2(lx * y - ly * x, lx * x + ly * y) / context.beams.spacing


def _residuals(
    context: Context, which: int, scene: Scene, side: Ints, usable: Mask, posterior: Posterior | None
) -> Residuals:
    if posterior is None:
        return Residuals()
    return residuals_of(
        context.rows[which], posterior, context.beams, (scene.rho[which], scene.face[which]),
        scene.rho[1 - which], (side == which) & usable, context.sensor,
        checks.FIXED * context.window.shift,
    )  # fmt: skip


def reshaped(
    section: JointSection,
    slice_: Slice,
    station: StationEstimate,
    which: int,
    profiles: Sequence[Profile],
    sensor: SensorConfig,
    fit: FitConfig,
) -> list[Posterior | None]:
    """Posteriors of one component for each of several shapes, from the same beams, the other component held.

    Parameters
    ----------
    station : StationEstimate
        The same slice, estimated before.
    profiles : sequence of Profile
        Shapes to try; their evidences compare.
    """
    pose = station.combined
    if pose is None or station.components[which].pose is None:
        return [None] * len(profiles)
    context, _ = station_context(section, slice_, pose, sensor, fit)
    window = context.window
    # the combined pose was found with another shape, for which a prior about it would speak at every station
    window = dataclasses.replace(window, shift=_LOOSE * window.shift, angle=_LOOSE * window.angle)
    return reshaped_with(context, station, pose, which, profiles, None, window)


def reshaped_with(
    context: Context,
    station: StationEstimate,
    pose: Pose2D,
    which: int,
    profiles: Sequence[Profile],
    begin: Pose2D | None,
    window: Window,
) -> list[Posterior | None]:
    """The same with the station's own context, begun at a pose or where the component is."""
    beams = context.beams
    scene = context.scene((pose, pose))
    side = split_side(scene, beams, np.array([pose.u, pose.v]))
    usable = context.usable(scene, side, pose)
    poses = [pose if c.pose is None else c.pose for c in station.components]
    scene = context.scene(poses)
    shallow = pose.inverse().apply(beams.points)[:, 1] > -3.0 * context.sensor.sigma
    passed = context.passed(poses, scene)
    cost = cover_cost(beams, context.model, context.depth)
    use, spent = second_round(
        which, scene, side, beams, cost, context.model, territory=shallow & (passed > 0)
    )
    begin = begin or station.components[which].pose
    return [
        component_posterior(
            edge_rows(profile), pose, beams, spent, context.model, window, use=use & usable, begin=begin
        )
        for profile in profiles
    ]
