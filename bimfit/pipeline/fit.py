"""fit_joint(): one joint from scan to gap, as the paper's section 4.4 has it, a step a line."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bimfit.config import Config, SearchConfig, SensorConfig
from bimfit.errors import ConfigError
from bimfit.estimation.company import with_company
from bimfit.estimation.motion import estimate_joint
from bimfit.estimation.noise import Noise, estimate_noise
from bimfit.estimation.result import StationEstimate
from bimfit.estimation.station import estimate_station
from bimfit.gap.section import gap_section
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.slice import Slice
from bimfit.geometry.status import Status
from bimfit.pipeline.records import ComponentResult, JointResult, StationResult
from bimfit.pipeline.shape import StationShape, free_shapes, freedoms, judged, with_shape_sigma
from bimfit.pipeline.stitch import area_correlation, stitch
from bimfit.pipeline.targets import (
    COMBINED_PAYS,
    COMPONENT_PAYS,
    TargetCache,
    Targets,
    build_seconds,
    distinct,
    economic,
    matched_slice,
    prepare,
)
from bimfit.registration.fitness import own_returns
from bimfit.registration.matchers import LOCAL, MATCHERS, match_all
from bimfit.registration.result import MatchResult

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint

DESIGNED = Pose2D()
_MATCHER_OF = {"paper": "block", "search": "grcsm"}
MOTIONS = ("auto", "independent", "const", "rigid", "linear", "smooth", "kinked")
"""Motion models along the joint."""
_OTHER_SIGMA, _OTHER_SHARE = 0.1, 0.015
_NOISE_ROUNDS = 2
_RUN = 16
"""Stations searched in one go: enough to keep a table in the cache, few enough to share out."""


@dataclass(frozen=True)
class StationFit:
    """One station between the search and the gap."""

    section: JointSection
    slice: Slice
    combined: MatchResult
    components: tuple[MatchResult, MatchResult] | None
    estimate: StationEstimate | None
    seconds: float
    shape: StationShape | None = None


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
        One of :func:`methods`. ``grcsm`` is the certified search followed by the estimate of METHOD, 4
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

    Raises
    ------
    ConfigError
        For a method or a motion model that does not exist.
    """
    check_choice(method, motion)
    cache = TargetCache(config, outlines=method == "paper")
    fitted = fit_slices(sections, slices, config, cache, method=method, threads=threads, progress=progress)
    return fit_along(joint, fitted, motion)


@dataclass(frozen=True)
class SliceFits:
    """All stations of a joint, each fitted by itself.

    Attributes
    ----------
    method : str
    stations : tuple of StationFit
    noise : Noise or None
        What their residuals say of the sensor; None where no estimate was made.
    seconds, table_seconds : float
        Wall time, and how much of it went into look-up tables.
    """

    method: str
    stations: tuple[StationFit, ...]
    noise: Noise | None
    seconds: float
    table_seconds: float


def fit_slices(
    sections: Sequence[JointSection],
    slices: Sequence[Slice],
    config: Config,
    cache: TargetCache,
    *,
    method: str = "grcsm",
    threads: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> SliceFits:
    """Fit every slice of a joint by itself, with the noise and the shapes that they show together.

    Parameters
    ----------
    cache : TargetCache
        Where look-up tables come from and are kept; joints of one design may share it.
    """
    begin = time.perf_counter()
    targets = prepare(sections, slices, cache)
    before = sum(build_seconds(target) for target in distinct(targets))
    fits = _fit_all(sections, slices, targets, config, method, threads, progress)
    noise = None
    if method == "grcsm":
        noise = estimate_noise([fit.estimate for fit in fits if fit.estimate is not None], config.sensor)
        fits, noise = _with_noise(fits, noise, config.sensor, config)
        if config.shape.freedoms:
            fits, noise = _with_shape(fits, noise, config)
        fits = _with_company(fits, noise)
    built = sum(build_seconds(target) for target in distinct(targets)) - before
    return SliceFits(method, tuple(fits), noise, time.perf_counter() - begin, built)


def fit_along(joint: Joint, fitted: SliceFits, motion: str = "auto") -> JointResult:
    """The joint as a whole: motion along it, its gap, mesh and volumes (METHOD, sections 5 and 6)."""
    begin = time.perf_counter()
    fits, couplings = list(fitted.stations), None
    if fitted.method == "grcsm" and fits:
        whole = estimate_joint([f.estimate for f in fits if f.estimate], [f.section for f in fits], motion)
        fits = [dataclasses.replace(f, estimate=e) for f, e in zip(fits, whole.stations, strict=True)]
        motion, couplings = whole.model, whole.couplings
    else:
        motion = "independent"
    fits = [f if f.shape is None else _judged(f, f.shape) for f in fits]
    stations = tuple(_station_result(joint, fit) for fit in fits)
    correlation = None if couplings is None else area_correlation(stations, couplings)
    mesh, volumes = stitch(stations, joint.path.length if joint.path.closed else None, correlation)
    seconds = fitted.seconds + time.perf_counter() - begin
    return JointResult(
        joint, fitted.method, stations, mesh, volumes, motion, fitted.noise, seconds, fitted.table_seconds
    )


def methods() -> tuple[str, ...]:
    """What :func:`fit_joint` can be asked for; matchers that users add to MATCHERS are among them."""
    return ("grcsm", "search", "paper", *(name for name in MATCHERS if name != "grcsm"))


def check_choice(method: str, motion: str = "auto") -> None:
    """Refuse a method or a motion model that does not exist.

    Raises
    ------
    ConfigError
        Naming those that do.
    """
    for kind, name, known in (("method", method, methods()), ("motion", motion, MOTIONS)):
        if name not in known:
            raise ConfigError(f"unknown {kind} {name}", remedy=f"choose from {', '.join(known)}")


def fit_station(
    section: JointSection, slice_: Slice, targets: Targets, config: Config, method: str = "grcsm"
) -> StationFit:
    """One station: the combined model first, then each component in its own small window (paper, 4.4)."""
    return fit_stations([section], [slice_], targets, config, method)[0]


def fit_stations(
    sections: Sequence[JointSection],
    slices: Sequence[Slice],
    targets: Targets,
    config: Config,
    method: str = "grcsm",
) -> list[StationFit]:
    """:func:`fit_station` for stations that share their targets, a step for all of them at a time.

    The same results; but one table after the other stays in the processor's cache.
    """
    fits = search_stations(sections, slices, targets, config, method)
    return estimate_fits(fits, config.sensor, config) if method == "grcsm" else fits


def estimate_fits(fits: Sequence[StationFit], sensor: SensorConfig, config: Config) -> list[StationFit]:
    """The estimates of stations that have been searched."""
    return [_estimated(fit, sensor, config) for fit in fits]


def search_stations(
    sections: Sequence[JointSection],
    slices: Sequence[Slice],
    targets: Targets,
    config: Config,
    method: str = "grcsm",
) -> list[StationFit]:
    """The combined searches of :func:`fit_stations`, and then the components'."""
    begin = time.perf_counter()
    name = _MATCHER_OF.get(method, method)
    near = [matched_slice(slice_, config) for slice_ in slices]
    wide = economic(config.search, targets.combined, targets.stations, COMBINED_PAYS)
    combined = match_all(name, targets.combined, near, [DESIGNED] * len(near), [wide] * len(near))
    found = [i for i, match in enumerate(combined) if match.found]
    searches = [component_search(sections[i], config) for i in found]
    priors = [combined[i].pose for i in found]
    shares = [_shares(near[i], targets, combined[i].pose, method) for i in found]
    a, b = (
        match_all(
            name, target, [share[which] for share in shares], priors,
            [economic(search, target, targets.stations, COMPONENT_PAYS) for search in searches],
        )
        for which, target in enumerate(targets.components)
    )  # fmt: skip
    components = dict(zip(found, zip(a, b, strict=True), strict=True))
    seconds = (time.perf_counter() - begin) / max(len(slices), 1)
    return [
        StationFit(section, slice_, combined[i], components.get(i), None, seconds)
        for i, (section, slice_) in enumerate(zip(sections, slices, strict=True))
    ]


def _shares(near: Slice, targets: Targets, pose: Pose2D, method: str) -> tuple[Slice, Slice]:
    """What each component is matched with: all returns; its own, where a matcher has no window to hold it."""
    if method not in LOCAL:
        return near, near
    a, b = own_returns(targets.components, near.points, pose)
    return (
        dataclasses.replace(near, points=near.points[a], beams=None),
        dataclasses.replace(near, points=near.points[b], beams=None),
    )


def _estimate(fit: StationFit, sensor: SensorConfig, config: Config) -> StationEstimate:
    return estimate_station(
        fit.section,
        fit.slice,
        fit.combined.pose if fit.combined.found else None,
        sensor,
        config.fit,
        component_matches=_poses(fit.components),
        rivals=[mode.pose for mode in fit.combined.modes],
    )


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


def _fit_all(
    sections: Sequence[JointSection],
    slices: Sequence[Slice],
    targets: Sequence[Targets],
    config: Config,
    method: str,
    threads: int | None,
    progress: Callable[[float], None],
) -> list[StationFit]:
    """All stations, in runs that share their targets, several runs at a time (kernels release the GIL)."""
    fits: list[StationFit] = []
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        jobs = [
            pool.submit(fit_stations, sections[k:end], slices[k:end], targets[k], config, method)
            for k, end in _runs(targets)
        ]
        for job in jobs:
            fits += job.result()
            progress(len(fits) / len(targets))
    return fits


def _runs(targets: Sequence[Targets]) -> list[tuple[int, int]]:
    """First and end of runs of at most RUN stations with the same targets."""
    out, begin = [], 0
    for k in range(1, len(targets) + 1):
        if k == len(targets) or k - begin == _RUN or targets[k] is not targets[begin]:
            out.append((begin, k))
            begin = k
    return out


def _with_noise(
    fits: list[StationFit], noise: Noise, assumed: SensorConfig, config: Config
) -> tuple[list[StationFit], Noise]:
    """Estimate again while the joint's own residuals say that the sensor is not as it was assumed to be."""
    for _ in range(_NOISE_ROUNDS if config.sensor.adapt else 0):
        if not _differs(noise.sensor, assumed):
            break
        assumed = noise.sensor
        fits = estimate_fits(fits, assumed, config)
        noise = estimate_noise([fit.estimate for fit in fits if fit.estimate is not None], assumed)
    return fits, noise


def _estimated(fit: StationFit, sensor: SensorConfig, config: Config) -> StationFit:
    begin = time.perf_counter()
    estimate = _estimate(fit, sensor, config)
    return dataclasses.replace(fit, estimate=estimate, seconds=fit.seconds + time.perf_counter() - begin)


def _differs(found: SensorConfig, assumed: SensorConfig) -> bool:
    return (
        abs(math.log(found.pooled().sigma / assumed.pooled().sigma)) > _OTHER_SIGMA
        or abs(found.outlier_share - assumed.outlier_share) > _OTHER_SHARE
        or abs(found.miss_share - assumed.miss_share) > _OTHER_SHARE
    )


def _with_shape(fits: list[StationFit], noise: Noise, config: Config) -> tuple[list[StationFit], Noise]:
    """Free the components' shapes, and estimate again with them."""
    sensor = noise.sensor if config.sensor.adapt else config.sensor
    fits = free_shapes(fits, sensor, config)
    fits = estimate_fits(fits, sensor, config)
    noise = estimate_noise([fit.estimate for fit in fits if fit.estimate is not None], sensor)
    return _with_noise(fits, noise, sensor, config)


def _judged(fit: StationFit, shape: StationShape) -> StationFit:
    return fit if fit.estimate is None else dataclasses.replace(fit, estimate=judged(fit.estimate, shape))


def _with_company(fits: list[StationFit], noise: Noise) -> list[StationFit]:
    """Flag what only the joint as a whole can tell: a bend, another shape, a fit amid misfits."""
    estimates = [fit.estimate for fit in fits if fit.estimate is not None]
    judged = with_company(estimates, [fit.section for fit in fits], noise.correlation)
    return [dataclasses.replace(f, estimate=e) for f, e in zip(fits, judged, strict=True)]


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
        ComponentResult(
            element, match, pose if known else None, cov if known else None, rms, freedoms(fit.shape, which)
        )
        for which, (element, match, (pose, cov, rms)) in enumerate(
            zip(joint.elements, matches, parts, strict=True)
        )
    )
    a, b = components
    gap = None
    if a.pose is not None and b.pose is not None:
        gap = gap_section(
            fit.section.s, fit.section.frame, fit.section.gap, a.pose, b.pose, a.covariance, b.covariance
        )
        if fit.shape is not None and a.covariance is not None and b.covariance is not None:
            gap = with_shape_sigma(gap, fit.shape, (a.pose, b.pose), (a.covariance, b.covariance))
    return StationResult(fit.section, fit.slice, status, fit.combined, (a, b), gap, fit.seconds)


def _worst(statuses: Sequence[Status]) -> Status:
    order = ("ok", "weak", "ambiguous", "rejected", "no_data")
    return max(statuses, key=lambda status: order.index(status.name))
