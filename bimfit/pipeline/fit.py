"""fit_joint(): one joint from scan to gap, as the paper's section 4.4 has it, a step a line."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bimfit.config import Config, SearchConfig
from bimfit.estimation.result import StationEstimate
from bimfit.estimation.station import estimate_station
from bimfit.gap.section import gap_section
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.slice import Slice
from bimfit.geometry.status import Status
from bimfit.pipeline.records import ComponentResult, JointResult, StationResult
from bimfit.pipeline.stitch import stitch
from bimfit.pipeline.targets import (
    COMBINED_BREAK_EVEN,
    COMPONENT_BREAK_EVEN,
    TargetCache,
    Targets,
    distinct,
    economic,
    matched_slice,
    prepare,
)
from bimfit.registration.matchers import MATCHERS
from bimfit.registration.result import MatchResult

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint

DESIGNED = Pose2D()
_MATCHER_OF = {"paper": "block", "search": "grcsm"}
METHODS = ("grcsm", "search", "paper", *(name for name in MATCHERS if name != "grcsm"))
"""What :func:`fit_joint` can be asked for."""


@dataclass(frozen=True)
class StationFit:
    """One station between the search and the gap."""

    section: JointSection
    slice: Slice
    combined: MatchResult
    components: tuple[MatchResult, MatchResult] | None
    estimate: StationEstimate | None
    seconds: float


def fit_joint(
    joint: Joint,
    sections: Sequence[JointSection],
    slices: Sequence[Slice],
    config: Config,
    *,
    method: str = "grcsm",
    motion: str = "auto",
    threads: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> JointResult:
    """Fit one joint: combined, then each component, then along the joint, then the gap.

    Parameters
    ----------
    joint : Joint
        As designed, its mouth towards the sensor.
    sections, slices : sequence
        The design and the scan at each station (:func:`bimfit.pipeline.survey.cut_joint`).
    config : Config
    method : str
        A name of METHODS. ``grcsm`` is the certified search followed by the estimate of METHOD sections 4
        and 5; ``search`` is that search alone; ``paper`` the method as printed (whole outlines, block
        tables, grid answers); every other matcher's own answer is reported as it is.
    motion : str
        Motion model along the joint: independent, const, rigid, linear, smooth, kinked or auto.
    threads : int, optional
        How many slices are fitted at a time; the result does not depend on it. None: one a processor.
    progress : callable
        Told the share done.

    Returns
    -------
    JointResult
        With a status and a reason at each station; a fit that failed is never an exception.
    """
    begin = time.perf_counter()
    targets = prepare(sections, slices, TargetCache(config, outlines=method == "paper"))
    fits = _fit_stations(sections, slices, targets, config, method, threads, progress)
    if method == "grcsm":
        fits, motion = _along_the_joint(fits, config, motion)
    else:
        motion = "independent"
    stations = tuple(_station_result(joint, fit) for fit in fits)
    mesh, volumes = stitch(stations, joint.path.length if joint.path.closed else None)
    built = sum(table.seconds for target in distinct(targets) for table in target.kept.values())
    return JointResult(joint, method, stations, mesh, volumes, motion, time.perf_counter() - begin, built)


def fit_station(
    section: JointSection, slice_: Slice, targets: Targets, config: Config, method: str = "grcsm"
) -> StationFit:
    """One station: the combined model first, then each component in its own small window (paper, 4.4)."""
    begin = time.perf_counter()
    match = MATCHERS[_MATCHER_OF.get(method, method)]
    wide = economic(config.search, targets.stations, COMBINED_BREAK_EVEN)
    near = matched_slice(slice_, config)
    combined = match(targets.combined, near, DESIGNED, wide)
    components: tuple[MatchResult, MatchResult] | None = None
    if combined.found:
        search = economic(component_search(section, config), targets.stations, COMPONENT_BREAK_EVEN)
        a, b = (match(target, near, combined.pose, search) for target in targets.components)
        components = (a, b)
    estimate = None
    if method == "grcsm":
        estimate = estimate_station(
            section,
            slice_,
            combined.pose if combined.found else None,
            config.sensor,
            config.fit,
            component_matches=_poses(components),
            rivals=[mode.pose for mode in combined.modes],
        )
    return StationFit(section, slice_, combined, components, estimate, time.perf_counter() - begin)


def _poses(matches: tuple[MatchResult, MatchResult] | None) -> tuple[Pose2D | None, Pose2D | None]:
    if matches is None:
        return None, None
    a, b = matches
    return a.pose if a.found else None, b.pose if b.found else None


def component_search(section: JointSection, config: Config) -> SearchConfig:
    """A component's own window: a fraction of the designed gap, never less than the placement tolerance."""
    a, b = section.gap.mouth
    width = float(((b - a) ** 2).sum() ** 0.5)
    reach = max(config.fit.gap_fraction * width, config.fit.placement_tolerance)
    return dataclasses.replace(config.search, window=(reach, reach, config.fit.component_angle))


def _fit_stations(
    sections: Sequence[JointSection],
    slices: Sequence[Slice],
    targets: Sequence[Targets],
    config: Config,
    method: str,
    threads: int | None,
    progress: Callable[[float], None],
) -> list[StationFit]:
    """All stations, several at a time (the kernels release the GIL)."""
    fits: list[StationFit] = []
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        jobs = [
            pool.submit(fit_station, section, slice_, target, config, method)
            for section, slice_, target in zip(sections, slices, targets, strict=True)
        ]
        for k, job in enumerate(jobs):
            fits.append(job.result())
            progress((k + 1) / len(jobs))
    return fits


def _along_the_joint(fits: list[StationFit], config: Config, motion: str) -> tuple[list[StationFit], str]:
    """Replace the stations' estimates by those of the joint as a whole (METHOD, section 5)."""
    if motion == "independent":
        return fits, motion
    from bimfit.estimation.motion import estimate_joint

    estimates = [fit.estimate for fit in fits if fit.estimate is not None]
    whole = estimate_joint(estimates, [fit.section for fit in fits], motion)
    return [
        dataclasses.replace(f, estimate=e) for f, e in zip(fits, whole.stations, strict=True)
    ], whole.model


def _station_result(joint: Joint, fit: StationFit) -> StationResult:
    if fit.estimate is not None:
        status = fit.estimate.status
        parts = [(c.pose, c.covariance, c.rms) for c in fit.estimate.components]
    elif fit.components is None:
        status = (
            fit.combined.status
            if not fit.combined.status.measured
            else Status("rejected", "no pose was found")
        )
        parts = [(None, None, float("nan"))] * 2
    else:
        status = _worst([m.status for m in fit.components])
        parts = [(m.pose if m.found else None, None, m.inlier_rmse) for m in fit.components]
    known = status.measured and all(pose is not None for pose, _, _ in parts)
    matches = fit.components or (None, None)
    components = tuple(
        ComponentResult(element, match, pose if known else None, cov if known else None, rms)
        for element, match, (pose, cov, rms) in zip(joint.elements, matches, parts, strict=True)
    )
    a, b = components
    gap = None
    if a.pose is not None and b.pose is not None:
        gap = gap_section(
            fit.section.s, fit.section.frame, fit.section.gap, a.pose, b.pose, a.covariance, b.covariance
        )
    return StationResult(fit.section, fit.slice, status, fit.combined, (a, b), gap, fit.seconds)


def _worst(statuses: Sequence[Status]) -> Status:
    order = ("ok", "weak", "ambiguous", "rejected", "no_data")
    return max(statuses, key=lambda status: order.index(status.name))
