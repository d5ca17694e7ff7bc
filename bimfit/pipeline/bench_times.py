"""What one slice costs: CPU time of every stage of the chain, beside a fixed piece of work."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bimfit.config import Config
from bimfit.estimation.context import station_context
from bimfit.estimation.inside import drop_at_mouth, place_sd, returns_inside
from bimfit.estimation.lookalikes import gap_places
from bimfit.estimation.motion import estimate_joint
from bimfit.estimation.posterior import component_posterior
from bimfit.estimation.slide import slide_combined
from bimfit.gap.section import gap_section
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.slice import Slice
from bimfit.pipeline.compare import Cut
from bimfit.pipeline.fit import DESIGNED, StationFit, estimate_fits, search_stations
from bimfit.pipeline.targets import TargetCache, Targets, prepare
from bimfit.registration.matchers import match_all
from bimfit.simulation.accuracy import PAPER_SECONDS_A_SLICE

_ROUNDS = 3


def bench_times(cuts: Sequence[Cut]) -> dict[str, float]:
    """CPU time of one thread, tables ready, s: medians over joints and rounds of the mean of their slices."""
    config = Config()
    cache = TargetCache(config)
    rows: list[dict[str, float]] = []
    for _, sections, slices in cuts:
        targets = prepare(sections, slices, cache)[0]
        estimate_fits(search_stations(sections[:1], slices[:1], targets, config), config.sensor, config)
        rows += [_round(sections, slices, targets, config) for _ in range(_ROUNDS)]
    middle = {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
    chain = middle["search"] + middle["estimate"] + middle["gap"]
    return {
        "posterior_a_component": 0.5 * middle["posteriors"],
        "chain_a_slice": chain,
        "chain_over_fixed_work": chain / middle["fixed_work"],
        "paper_a_slice": PAPER_SECONDS_A_SLICE["GRCSM"],
        "paper_over_chain": PAPER_SECONDS_A_SLICE["GRCSM"] / chain,
        **middle,
    }


def _round(
    sections: Sequence[JointSection], slices: Sequence[Slice], targets: Targets, config: Config
) -> dict[str, float]:
    """One joint once: every stage by the slice, motion models by the joint, and the fixed work, s."""
    searched, search = _timed(lambda: search_stations(sections, slices, targets, config))
    fits, estimate = _timed(lambda: estimate_fits(searched, config.sensor, config))
    row = {"search": search, "estimate": estimate, **_parts(fits, targets, config)}
    fresh = prepare(sections, slices, TargetCache(config))[0]
    row["tables"] = _timed(lambda: search_stations(sections[:1], slices[:1], fresh, config))[1]
    estimates = [fit.estimate for fit in fits if fit.estimate is not None]
    return {
        **{name: seconds / len(fits) for name, seconds in row.items()},
        "motion_a_joint": _timed(lambda: estimate_joint(estimates, sections, "auto"))[1],
        "fixed_work": _timed(_fixed_work)[1],
    }


def times_text(times: dict[str, float]) -> str:
    """The times as text."""
    ms = {name: 1e3 * value for name, value in times.items()}
    parts = ", ".join(f"{name} {ms[key]:.2f}" for name, key in _STAGES)
    return (
        f"CPU time, one thread, tables ready: posterior {ms['posterior_a_component']:.3f} ms a component "
        f"(asked 0.25); whole chain {ms['chain_a_slice']:.2f} ms a slice (asked 2.5, aim 1.5), "
        f"{times['chain_over_fixed_work']:.2f} times a fixed piece of work beside it; of it, ms: {parts}; "
        f"and {ms['tables']:.2f} a slice for the tables of the joint; "
        f"motion models {times['motion_a_joint']:.2f} s a joint of 83 slices (asked 0.5); the paper: "
        f"{ms['paper_a_slice']:.0f} ms a slice (MATLAB), {times['paper_over_chain']:.0f} times as long"
    )


_STAGES = (
    ("searches", "search"), ("the combined one", "combined"),
    ("estimate", "estimate"), ("slide", "slide"),
    ("two posteriors", "posteriors"), ("inside and look-alikes", "checks"), ("gap", "gap"),
)  # fmt: skip


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """What some work gives, and the CPU time of this thread that it took, s."""
    begin = time.thread_time()
    made = work()
    return made, time.thread_time() - begin


def _fixed_work() -> float:
    """About as much as a slice, half of it NumPy and half Python: what this machine can do right now."""
    x = np.linspace(0.0, 1.0, 2000)
    total = sum(float((np.sqrt(x * x + 1.0) * x).sum()) for _ in range(50))
    return total + float(sum(i * i for i in range(5000)))


def _parts(fits: Sequence[StationFit], targets: Targets, config: Config) -> dict[str, float]:
    """CPU time of parts of the searches and of the estimates, repeated by themselves, and of the gap, s."""
    near = [fit.slice for fit in fits]
    search = [config.search] * len(fits)
    out = {
        "combined": _timed(
            lambda: match_all("grcsm", targets.combined, near, [DESIGNED] * len(fits), search)
        )[1],
        **dict.fromkeys(("slide", "posteriors", "checks", "gap"), 0.0),
    }
    for fit in fits:
        if fit.estimate is None or fit.estimate.combined is None or fit.slice.beams is None:
            continue
        for name, work in _stages(fit, config).items():
            out[name] += _timed(work)[1]
    return out


def _stages(fit: StationFit, config: Config) -> dict[str, Callable[[], Any]]:
    """The stages of one station's estimate that can be run by themselves."""
    station, section, sensor = fit.estimate, fit.section, config.sensor
    assert station is not None and station.combined is not None and fit.slice.beams is not None
    pose = station.combined
    context = station_context(section, fit.slice, pose, sensor, config.fit)
    sight, beams = context.look(pose), context.beams
    a, b = station.components

    def posteriors() -> None:
        for which, own in enumerate(context.rows):
            component_posterior(own, pose, context.table, context.window, use=sight.first(which))

    def checks() -> None:
        drop_at_mouth(section, station, sensor.sigma)
        if a.pose is not None and b.pose is not None:
            spread = place_sd(section, station)
            returns_inside(section, beams, (a.pose, b.pose), spread, sensor.sigma, fit.slice.sweeps)
        gap_places(section, beams, pose)

    def gap() -> None:
        if a.pose is not None and b.pose is not None:
            gap_section(section.s, section.frame, section.gap, a.pose, b.pose, a.covariance, b.covariance)

    def slide() -> None:
        slide_combined(section, context.table, pose, sensor, config.fit)

    return {"slide": slide, "posteriors": posteriors, "checks": checks, "gap": gap}
