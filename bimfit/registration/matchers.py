"""Every planar matcher under its name, all with one signature."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from bimfit.config import Bound, SearchConfig
from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Slice
from bimfit.geometry.status import OK, Status
from bimfit.registration import _kernels_table as kernels
from bimfit.registration import grcsm
from bimfit.registration.batch import Found, search_slices
from bimfit.registration.fitness import fitness_of
from bimfit.registration.grcsm import Outcome, Problem
from bimfit.registration.icp import g_icp, icp_multistart, icp_plane, icp_plane_robust, icp_point
from bimfit.registration.modes import near_optimal
from bimfit.registration.printed import run_brute, run_printed
from bimfit.registration.result import MatchResult, Mode
from bimfit.registration.table import Target

Matcher = Callable[..., MatchResult]
LOST = np.full(3, np.nan)


def match(
    target: Target,
    slice_: Slice,
    prior: Pose2D,
    config: SearchConfig,
    *,
    weights: ArrayLike | None = None,
    incumbent: Pose2D | None = None,
) -> MatchResult:
    """Find the best-scoring pose of the window about ``prior``, and prove it.

    The *window* is laid about the data: the slice is carried into the designed frame by ``prior``'s
    inverse, and then turned by theta about its own centre (of its bounding box, points that cannot meet
    the model left aside) and shifted by (u, v), each within plus or minus ``config.window`` in the
    designed section frame. The returned pose is the motion of the *model* that puts it on the data:
    ``prior`` composed with that motion's inverse.

    The score is the sum over points of weight times look-up value, the value read at a point's cell
    from a table of 256 steps (``MatchResult.quantisation`` bounds what the rounding to steps can
    change). With a ``config.prior_sigma``, the log-prior is added, rounded to the same steps.

    Parameters
    ----------
    target : Target
        The model with its blur.
    slice_ : Slice
        Returns in the section frame.
    prior : Pose2D
        Expected motion of the model; the window's middle.
    config : SearchConfig
        Window, tolerances, s, L, bound, eps, budgets, delta. With ``bound="block"`` the search as printed
        is run instead.
    weights : array_like, shape (n,), optional
        One weight a point; rounded to 1/255 of the greatest.
    incumbent : Pose2D, optional
        A likely answer, such as the previous slice's: it saves work and never changes the result.

    Raises
    ------
    ConfigError
        For weights that do not suit the points or a lattice too fine to hold.
    """
    if config.bound == "block":
        return match_block(target, slice_, prior, config, weights=weights)
    return _search("grcsm", config.bound, target, slice_, prior, config, weights, incumbent)


def match_overlap(
    target: Target, slice_: Slice, prior: Pose2D, config: SearchConfig, *, weights: ArrayLike | None = None,
    incumbent: Pose2D | None = None,
) -> MatchResult:  # fmt: skip
    """GRCSM with overlapped block maxima alone: proven, slower than majorants."""
    return _search("overlap", "overlap", target, slice_, prior, config, weights, incumbent)


def match_mrcsm(
    target: Target, slice_: Slice, prior: Pose2D, config: SearchConfig, *, weights: ArrayLike | None = None,
    incumbent: Pose2D | None = None,
) -> MatchResult:  # fmt: skip
    """Olson's two levels with an equal number of tests on each, by the same proven search."""
    two = dataclasses.replace(config, levels=2, axis_levels=None, axis_tests=None, bound="overlap")
    return _search("mrcsm", "overlap", target, slice_, prior, two, weights, incumbent)


def match_block(
    target: Target, slice_: Slice, prior: Pose2D, config: SearchConfig, *, weights: ArrayLike | None = None
) -> MatchResult:
    """The search as the paper prints it (Eq. 3 to 5): not a bound, so the result is ``unproven``."""
    return _guarded("block", "block", target, slice_, prior, config, weights, run_printed)


def match_brute(
    target: Target, slice_: Slice, prior: Pose2D, config: SearchConfig, *, weights: ArrayLike | None = None
) -> MatchResult:
    """Score every pose of the window."""
    return _guarded("brute", "overlap", target, slice_, prior, config, weights, run_brute)


def _search(
    name: str, bound: Bound, target: Target, slice_: Slice, prior: Pose2D, config: SearchConfig,
    weights: ArrayLike | None, incumbent: Pose2D | None,
) -> MatchResult:  # fmt: skip
    if config.time_budget is None:
        every = None if weights is None else [weights]
        return _search_many(name, bound, target, [slice_], [prior], config, every, [incumbent], 1)[0]

    def runner(problem: Problem, config: SearchConfig) -> Outcome:
        deadline = None if config.time_budget is None else time.perf_counter() + config.time_budget
        start = None if incumbent is None else grcsm.leaf_of(problem, incumbent, prior)
        return grcsm.run(problem, config, incumbent=start, deadline=deadline)

    return _guarded(name, bound, target, slice_, prior, config, weights, runner)


def match_many(
    target: Target,
    slices: Sequence[Slice],
    priors: Sequence[Pose2D],
    config: SearchConfig,
    *,
    weights: Sequence[ArrayLike] | None = None,
    incumbents: Sequence[Pose2D | None] | None = None,
    threads: int = 1,
) -> list[MatchResult]:
    """:func:`match` for many slices of one profile, several at a time; same results, less overhead.

    Parameters
    ----------
    slices, priors, weights, incumbents : sequence
        One a slice, as for :func:`match`.
    threads : int
        How many slices are searched at a time; the results do not depend on it.
    """
    if config.time_budget is not None or config.bound == "block":
        heft: Sequence[ArrayLike | None] = weights or [None] * len(slices)
        every = zip(slices, priors, heft, incumbents or [None] * len(slices), strict=True)
        return [match(target, s, p, config, weights=w, incumbent=i) for s, p, w, i in every]
    return _search_many(
        "grcsm", config.bound, target, slices, priors, config, weights, incumbents, max(1, threads)
    )


def _search_many(
    name: str, bound: Bound, target: Target, slices: Sequence[Slice], priors: Sequence[Pose2D],
    config: SearchConfig, weights: Sequence[ArrayLike] | None, incumbents: Sequence[Pose2D | None] | None,
    threads: int,
) -> list[MatchResult]:  # fmt: skip
    points = [_points(slice_) for slice_ in slices]
    out: list[MatchResult | None] = [_too_little(name, target, own) for own in points]
    wanted = [i for i, result in enumerate(out) if result is None]
    if weights is None:
        groups: list[tuple[list[int], ArrayLike | None]] = [(wanted, None)] if wanted else []
    else:  # a slice's weights have a unit of their own
        groups = [([i], weights[i]) for i in wanted]
    for members, own in groups:
        steps, unit, rounding = grcsm.weight_steps(own, len(points[members[0]]))
        started = time.perf_counter()
        found = search_slices(
            target, [points[i] for i in members], [priors[i] for i in members], config, bound, steps, unit,
            None if incumbents is None else [incumbents[i] for i in members], threads,
        )  # fmt: skip
        seconds = (time.perf_counter() - started) / len(members)
        for i, one in zip(members, found, strict=True):
            half = 0.5 * len(points[i]) / kernels.FULL if own is None else rounding
            if one.kept < grcsm.MIN_POINTS:
                out[i] = _nowhere(name)
            else:
                collect = None
                if config.delta > 0.0:
                    collect = functools.partial(
                        _modes, target, points[i], priors[i], own, config, bound, one.score
                    )
                out[i] = _result(name, one, priors[i], unit, half, seconds, collect)
    return [result for result in out if result is not None]


def _guarded(
    name: str, bound: Bound, target: Target, slice_: Slice, prior: Pose2D, config: SearchConfig,
    weights: ArrayLike | None, runner: Callable[[Problem, SearchConfig], Outcome],
) -> MatchResult:  # fmt: skip
    points = _points(slice_)
    if lost := _too_little(name, target, points):
        return lost
    problem = grcsm.pose_problem(target, points, prior, weights, config, bound)
    if problem is None:
        return _nowhere(name)
    started = time.perf_counter()
    outcome = runner(problem, config)
    seconds = time.perf_counter() - started
    lattice = problem.tables.lattice
    share, rmse = 0.0, float("nan")
    if outcome.score > grcsm.NOTHING:
        share, rmse = fitness_of(target, points, grcsm.pose_of(lattice, problem.pivot, outcome.index, prior))
    found = Found(
        problem.n, outcome.index, problem.pivot, outcome.score,
        outcome.bound, outcome.evaluations, outcome.stop, share, rmse, lattice,
    )  # fmt: skip
    collect = None
    if config.delta > 0.0:
        collect = functools.partial(_modes, target, points, prior, weights, config, bound, outcome.score)
    return _result(name, found, prior, problem.unit, problem.rounding, seconds, collect)


def _points(slice_: Slice) -> Array:
    return np.ascontiguousarray(slice_.points, np.float64).reshape(-1, 2)


def _too_little(name: str, target: Target, points: Array) -> MatchResult | None:
    if target.empty:
        return MatchResult(name, LOST, status=Status("no_data", "no surface of the model is visible"))
    if len(points) < grcsm.MIN_POINTS:
        return MatchResult(name, LOST, status=Status("no_data", f"only {len(points)} points in the slice"))
    return None


def _nowhere(name: str) -> MatchResult:
    reason = "no pose of the window brings the points to the model"
    return MatchResult(name, LOST, status=Status("no_data", reason))


def _modes(
    target: Target, points: Array, prior: Pose2D, weights: ArrayLike | None, config: SearchConfig,
    bound: Bound, score: int,
) -> tuple[Mode, ...]:  # fmt: skip
    problem = grcsm.pose_problem(target, points, prior, weights, config, bound)
    return () if problem is None else near_optimal(problem, config, score, prior)


def _result(
    name: str, found: Found, prior: Pose2D, unit: float, rounding: float, seconds: float,
    collect: Callable[[], tuple[Mode, ...]] | None,
) -> MatchResult:  # fmt: skip
    lattice = found.lattice
    if found.score <= grcsm.NOTHING:
        return MatchResult(
            name, LOST, float("nan"), found.bound * unit, found.evaluations, found.stop,
            Status("rejected", "the budget ended before any pose was scored"), lattice.levels,
            seconds=seconds,
        )  # fmt: skip
    pose = grcsm.pose_of(lattice, found.pivot, found.index, prior)
    status = OK
    modes: tuple[Mode, ...] = ()
    if found.share == 0.0:
        status = Status("rejected", "no point of the slice lies near the model in any pose of the window")
    elif collect is not None and found.stop == "proven":
        modes = collect()
        if modes:
            best = modes[0]
            status = Status("ambiguous", f"{len(modes)} rival pose(s), the best with score {best.score:.4g}")
    return MatchResult(
        name, pose.as_array(), found.score * unit, found.bound * unit, found.evaluations, found.stop, status,
        lattice.levels, found.share, found.rmse, modes, seconds, rounding,
    )  # fmt: skip


LOCAL = ("icp-point", "icp-plane", "icp-plane-robust", "icp-multistart", "g-icp")
"""Matchers that go downhill from the prior: a component is given its own returns, or another's mislead it."""

MATCHERS: dict[str, Matcher] = {
    "grcsm": match,
    "overlap": match_overlap,
    "block": match_block,
    "mrcsm": match_mrcsm,
    "brute": match_brute,
    "icp-point": icp_point,
    "icp-plane": icp_plane,
    "icp-plane-robust": icp_plane_robust,
    "icp-multistart": icp_multistart,
    "g-icp": g_icp,
}


def matcher(name: str) -> Matcher:
    """The matcher of that name.

    Raises
    ------
    ConfigError
        When there is none; the message lists them.
    """
    try:
        return MATCHERS[name]
    except KeyError:
        raise ConfigError(f"unknown method {name}", remedy=f"choose from {', '.join(MATCHERS)}") from None


def match_all(
    name: str,
    target: Target,
    slices: Sequence[Slice],
    priors: Sequence[Pose2D],
    configs: Sequence[SearchConfig],
) -> list[MatchResult]:
    """Match slices by the matcher of that name, each about its own prior with its own settings."""
    if name != "grcsm":
        run = matcher(name)
        return [run(target, s, p, c) for s, p, c in zip(slices, priors, configs, strict=True)]
    out: list[MatchResult] = []
    for config, group in itertools.groupby(range(len(slices)), key=configs.__getitem__):
        own = list(group)
        out += match_many(target, [slices[i] for i in own], [priors[i] for i in own], config)
    return out
