"""Every planar matcher under its name, all with one signature."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from bimfit.config import Bound, SearchConfig
from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Slice
from bimfit.geometry.status import OK, Status
from bimfit.registration import grcsm
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
    def runner(problem: Problem, config: SearchConfig) -> Outcome:
        deadline = None if config.time_budget is None else time.perf_counter() + config.time_budget
        start = None if incumbent is None else grcsm.leaf_of(problem, incumbent, prior)
        return grcsm.run(problem, config, incumbent=start, deadline=deadline)

    return _guarded(name, bound, target, slice_, prior, config, weights, runner)


def _guarded(
    name: str, bound: Bound, target: Target, slice_: Slice, prior: Pose2D, config: SearchConfig,
    weights: ArrayLike | None, runner: Callable[[Problem, SearchConfig], Outcome],
) -> MatchResult:  # fmt: skip
    points = np.ascontiguousarray(slice_.points, np.float64).reshape(-1, 2)
    if target.empty:
        return MatchResult(name, LOST, status=Status("no_data", "no surface of the model is visible"))
    if len(points) < grcsm.MIN_POINTS:
        return MatchResult(name, LOST, status=Status("no_data", f"only {len(points)} points in the slice"))
    problem = grcsm.pose_problem(target, points, prior, weights, config, bound)
    if problem is None:
        return MatchResult(
            name, LOST, status=Status("no_data", "no pose of the window brings the points to the model")
        )
    started = time.perf_counter()
    outcome = runner(problem, config)
    seconds = time.perf_counter() - started
    return _result(name, target, points, prior, config, problem, outcome, seconds)


def _result(
    name: str, target: Target, points: Array, prior: Pose2D, config: SearchConfig, problem: Problem,
    outcome: Outcome, seconds: float,
) -> MatchResult:  # fmt: skip
    lattice = problem.tables.lattice
    if outcome.score <= grcsm.NOTHING:
        return MatchResult(
            name, LOST, float("nan"), outcome.bound * problem.unit, outcome.evaluations, outcome.stop,
            Status("rejected", "the budget ended before any pose was scored"), lattice.levels,
            seconds=seconds,
        )  # fmt: skip
    pose = grcsm.pose_of(problem, outcome.index, prior)
    share, rmse = fitness_of(target, points, pose)
    status = OK
    modes: tuple[Mode, ...] = ()
    if share == 0.0:
        status = Status("rejected", "no point of the slice lies near the model in any pose of the window")
    elif config.delta > 0.0 and outcome.stop == "proven":
        modes = near_optimal(problem, config, outcome, prior)
        if modes:
            best = modes[0]
            status = Status("ambiguous", f"{len(modes)} rival pose(s), the best with score {best.score:.4g}")
    return MatchResult(
        name, pose.as_array(), outcome.score * problem.unit, outcome.bound * problem.unit,
        outcome.evaluations, outcome.stop, status, lattice.levels, share, rmse, modes, seconds,
        problem.rounding,
    )  # fmt: skip


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
