"""One station: from the combined pose to both components' poses, covariances and status."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation.components import Reshaper, components_at
from bimfit.estimation.context import Context, sensor_here, station_context
from bimfit.estimation.inside import with_inside
from bimfit.estimation.lookalikes import gap_places, with_lookalikes
from bimfit.estimation.placing import placed
from bimfit.estimation.result import ComponentEstimate, StationEstimate
from bimfit.estimation.slide import best_start
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.slice import Slice
from bimfit.geometry.status import Status


def estimate_station(
    section: JointSection,
    slice_: Slice,
    combined: Pose2D | None,
    sensor: SensorConfig,
    fit: FitConfig,
    *,
    component_matches: tuple[Pose2D | None, Pose2D | None] = (None, None),
    rivals: Sequence[Pose2D] = (),
) -> StationEstimate:
    """Estimate where both components are at one station, and how well that is known.

    Parameters
    ----------
    section : JointSection
        The design.
    slice_ : Slice
        What the scan shows, in the section frame.
    combined : Pose2D or None
        Motion of both components as one, from the certified search; None when it found nothing.
    component_matches : tuple of two (Pose2D or None)
        Each component's own search result: another place to start from, never more than that.
    rivals : sequence of Pose2D
        Other combined poses within the search's near-optimal set.

    Returns
    -------
    StationEstimate
        Always; what could not be measured has a status that says why and no pose.
    """
    here = sensor_here(sensor, slice_)[0]
    finite = np.asarray(np.isfinite(slice_.points).all(axis=1))
    count = int(np.count_nonzero(finite))
    if count < fit.min_points:
        reason = f"{count} returns in the slice, {fit.min_points} are needed"
        return _nothing(slice_, combined, here, Status("no_data", reason))
    if count < len(finite):
        slice_ = dataclasses.replace(slice_, points=slice_.points[finite])
    if section.components[0].empty or section.components[1].empty:
        return _nothing(slice_, combined, here, Status("no_data", "the section plane misses a component"))
    if combined is None:
        return _nothing(slice_, None, here, Status("rejected", "the search found no pose of the joint"))
    try:
        best = _estimated(section, slice_, combined, sensor, fit, component_matches, rivals)
    except np.linalg.LinAlgError as error:
        reason = f"the returns do not determine a pose: {error}"
        return _nothing(slice_, combined, here, Status("rejected", reason))
    if not all(_finite(c) for c in best.components):
        reason = "the returns do not determine a pose: its figures are not finite"
        return _nothing(slice_, combined, here, Status("rejected", reason))
    return best


def _estimated(
    section: JointSection,
    slice_: Slice,
    combined: Pose2D,
    sensor: SensorConfig,
    fit: FitConfig,
    component_matches: tuple[Pose2D | None, Pose2D | None],
    rivals: Sequence[Pose2D],
) -> StationEstimate:
    """The estimate of a slice that has enough returns and a combined pose."""
    context = station_context(section, slice_, combined, sensor, fit)
    best = _with_inside(context, placed(context, combined, component_matches, rivals))
    if not best.status.measured or best.combined is None:
        return best
    others = []
    for place in gap_places(section, context.beams, best.combined):
        there = best_start(section, context.table, (place,), context.sensor, fit)
        others.append(_with_inside(context, components_at(context, there, (None, None))))
    return with_lookalikes(best, others, section.gap.width, fit.joint_sigma)


def _with_inside(context: Context, station: StationEstimate) -> StationEstimate:
    """The station, judged by what is inside its gap and by the edges of its mouth."""
    if station.combined is None:
        return station
    reshaper = Reshaper(context, station, station.combined, context.window)
    sigma, sweeps = context.sensor.sigma, context.slice.sweeps
    return with_inside(
        station, context.section, context.beams, sigma, sweeps, reshaper.glances, reshaper.posteriors
    )


def _finite(c: ComponentEstimate) -> bool:
    """Whether a component's figures, if it has any, are numbers."""
    if c.pose is None or c.covariance is None:
        return True
    return math.isfinite(c.pose.u + c.pose.v + c.pose.theta) and bool(np.isfinite(c.covariance).all())


def _nothing(slice_: Slice, combined: Pose2D | None, sensor: SensorConfig, status: Status) -> StationEstimate:
    none = ComponentEstimate(status=status)
    return StationEstimate(slice_.s, combined, (none, none), status, sensor)
