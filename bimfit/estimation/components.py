"""Both components of a station near a combined pose, each given the other (METHOD, section 4)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation import checks
from bimfit.estimation.context import Context, station_context
from bimfit.estimation.ownership import BeamTable, Mask, Sight, Views, second_round
from bimfit.estimation.posterior import Glance, Posterior, Window, component_glance, component_posterior
from bimfit.estimation.residuals import residuals_of
from bimfit.estimation.result import Residuals, StationEstimate
from bimfit.estimation.slide import SlideResult
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile
from bimfit.geometry.slice import Slice

_LOOSE = 5.0
_SHALLOW = 3.0

Pair = tuple[Posterior | None, Posterior | None]


def components_at(
    context: Context, slid: SlideResult, matches: tuple[Pose2D | None, Pose2D | None]
) -> StationEstimate:
    """Estimate both components about a slid combined pose, and judge them.

    Parameters
    ----------
    matches : tuple of two (Pose2D or None)
        Each component's own search result: another place to start from.
    """
    pose = slid.pose
    sight = context.look(pose)
    a, b = (_one(context, which, pose, sight.first(which), None, matches[which]) for which in (0, 1))
    views = context.weigh(_poses((a, b), pose), sight.usable)
    if a is not None and b is not None and views.close:
        a, b, views = _given_each_other(context, pose, sight, (a, b), views)
    if context.reason:
        a, b = (p if p is None else _loosened(context, p) for p in (a, b))
    residuals = [_residuals(context, which, views, sight, p) for which, p in enumerate((a, b))]
    steps = [_corner_step(context, which, p) for which, p in enumerate(_poses((a, b), pose))]
    return checks.judge_station(
        context, slid, (a, b), (residuals[0], residuals[1]), (steps[0], steps[1]), views.passed
    )


def _poses(posteriors: Pair, pose: Pose2D) -> tuple[Pose2D, Pose2D]:
    """Where the components are estimated to be, else the combined pose."""
    a, b = posteriors
    return (pose if a is None else a.pose, pose if b is None else b.pose)


def _given_each_other(
    context: Context, pose: Pose2D, sight: Sight, posteriors: Pair, views: Views
) -> tuple[Posterior | None, Posterior | None, Views]:
    """The second round: A given the first estimate of B, then B given the second of A."""
    shallow, (a, b) = _shallow(context, views), posteriors
    for which in (0, 1):
        use, table = second_round(which, views, sight, context.table, context.model, pose, shallow)
        found = _one(context, which, pose, use, table, _poses((a, b), pose)[which])
        a, b = (found, b) if which == 0 else (a, found)
        views = context.weigh(_poses((a, b), pose), sight.usable)
    return a, b, views


def _shallow(context: Context, views: Views) -> float:
    """Height above which two bodies lie side by side; deep in a groove they meet, nobody knows just where."""
    return -_SHALLOW * context.sensor.sigma if views.passed > 0 else math.inf


def _behind(context: Context, views: Views, pose: Pose2D) -> Mask:
    """Returns from at or behind the gap's root that nothing designed should have stopped: no slope."""
    root = float(min(side[-1, 1] for side in (context.section.gap.side_a, context.section.gap.side_b)))
    low = pose.inverse().apply(context.beams.points)[:, 1] < root + context.sensor.sigma
    passed = ~np.isfinite(views.ranges[:, : len(low)]).any(axis=0)
    return np.asarray(low & passed & (context.beams.r > 0.0))


def _one(
    context: Context, which: int, prior: Pose2D, use: Mask, table: BeamTable | None, begin: Pose2D | None
) -> Posterior | None:
    """Posterior of one component from the beams in ``use``; None where hardly any meets it."""
    return component_posterior(
        context.rows[which], prior, table or context.table, context.window, use=use, begin=begin
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
    ox, oy, lx, ly = context.beams.eye[0].tolist()
    if context.virtual:
        lx, ly = -ox, -oy
    x, y = pose.point(*context.section.gap.corners[which].tolist())
    x, y = x - ox, y - oy
    return math.atan2(lx * y - ly * x, lx * x + ly * y) / context.beams.spacing


def _residuals(
    context: Context, which: int, views: Views, sight: Sight, posterior: Posterior | None
) -> Residuals:
    if posterior is None:
        return Residuals()
    return residuals_of(
        which, context.rows[which], posterior, context.table, views, sight, context.sensor,
        context.beams.spread, checks.FIXED * context.window.shift,
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
    context = station_context(section, slice_, pose, sensor, fit)
    window = context.window
    # the combined pose was found with another shape, for which a prior about it would speak at every station
    window = dataclasses.replace(window, shift=_LOOSE * window.shift, angle=_LOOSE * window.angle)
    return Reshaper(context, station, pose, window).posteriors(which, profiles, None)


@dataclass(frozen=True)
class Reshaper:
    """Tries other shapes of one component of an estimated station, the other held where it is.

    Attributes
    ----------
    pose : Pose2D
        The station's combined pose.
    window : Window
        The components' window about it.
    """

    context: Context
    station: StationEstimate
    pose: Pose2D
    window: Window

    def posteriors(
        self, which: int, profiles: Sequence[Profile], begin: Pose2D | None
    ) -> list[Posterior | None]:
        """Posterior of each shape, begun at a pose or where the component is."""
        (use, table), begin = self._heard[which], begin or self.station.components[which].pose
        return [
            component_posterior(p.rows, self.pose, table, self.window, use=use, begin=begin) for p in profiles
        ]

    def glances(self, which: int, profiles: Sequence[Profile], begin: Pose2D | None) -> list[Glance | None]:
        """The same at a glance."""
        (use, table), begin = self._heard[which], begin or self.station.components[which].pose
        return [component_glance(p.rows, self.pose, table, self.window, use, begin) for p in profiles]

    @cached_property
    def _heard(self) -> tuple[tuple[Mask, BeamTable], tuple[Mask, BeamTable]]:
        """For A and B the beams that speak for it, and what they cost, given the other."""
        context, pose = self.context, self.pose
        sight = context.look(pose)
        a, b = (pose if c.pose is None else c.pose for c in self.station.components)
        views = context.weigh((a, b), sight.usable)
        shallow = _shallow(context, views)
        away = ~_behind(context, views, pose)
        first, second = (
            second_round(which, views, sight, context.table, context.model, pose, shallow) for which in (0, 1)
        )
        return (first[0] & away, first[1]), (second[0] & away, second[1])
