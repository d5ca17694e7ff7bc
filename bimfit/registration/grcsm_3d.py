"""Certified correlative search in space: the best pose of a window, proven by admissible bounds.

The score of a pose is the weighted sum of the target's blurred surface (``table_3d``) at the points. The
window is a lattice of poses, a tolerance apart an axis. Boxes of them are bounded by affine majorants,
summed over the points so that slopes cancel, and split in two, best first (METHOD, section 9).

The six axes are those of the *designed model's* frame: shifts along x, y, z, and a rotation vector about
the centre of the data. An axis whose window is 0 is not searched: planar, yaw-only and translation-only
searches are the same code.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array, rigid_inverse, transform_points
from bimfit.geometry.status import OK, Status
from bimfit.registration import _kernels_3d as kernels
from bimfit.registration.problem_3d import (
    Problem3D,
    flat_directions,
    make_problem,
    motion_of,
    scales,
    without,
)
from bimfit.registration.result import MatchResult, Mode
from bimfit.registration.rigid_3d import Refined, Refiner, direction_name, parameters_of
from bimfit.registration.search_3d import Outcome3D, Search3D, first_incumbent
from bimfit.registration.table_3d import Target3D

_LEAST_SHARE = 0.1
_GOOD_SHARE = 0.5
_SCOUTING = 3000
Flat = tuple[tuple[str, Array], ...]
_NO_LOSS = 0.5
"""Scores that differ by less than this many points are as good."""


def match_3d(
    target: Target3D,
    points: ArrayLike,
    prior: ArrayLike | None = None,
    window: Sequence[float] = (0.03, 0.03, 0.03, 0.035, 0.035, 0.035),
    tolerance: Sequence[float] = (0.001, 0.001, 0.001, 0.00175, 0.00175, 0.00175),
    *,
    eps: float = 0.02,
    delta: float = 0.0,
    max_evaluations: int | None = None,
    time_budget: float | None = None,
    weights: ArrayLike | None = None,
    pivot: ArrayLike | None = None,
    prior_sigma: Sequence[float] | None = None,
    prior_weight: float = 1.0,
    incumbent: ArrayLike | None = None,
    refine: bool = True,
) -> MatchResult:
    """Find the model's motion that explains most of a cloud, and prove it.

    Parameters
    ----------
    target : Target3D
    points : array_like, shape (n, 3)
        The cloud, m, in the frame of the as-built world. About 1,000 evenly spread points serve best.
    prior : array_like, shape (4, 4) or (6,), optional
        Expected motion of the model (as built = motion * designed), middle of the window; default none.
    window, tolerance : sequence of 6 float
        Half widths and spacing of the lattice of poses: x, y, z (m) and rotation vector (rad), along the
        model's axes. A window of 0 leaves the axis at the prior.
    eps : float
        Stop once no pose can score more than (1 + eps) times the best one.
    delta : float
        Then look for rival poses that score more than (1 - delta) times the best one and lie apart.
    max_evaluations, time_budget : optional
        Give up after so many bounds and scores, or seconds; the result says what gap that left.
    weights : array_like, shape (n,), optional
        At least 0; default 1.
    pivot : array_like, shape (3,), optional
        What rotations turn about, in the cloud's frame; default the middle of the cloud.
    prior_sigma : sequence of 6 float, optional
        Standard deviations (m, rad) of a Gaussian prior on the motion within the window, axis by axis; its
        log, times ``prior_weight``, is added to the score. ``inf`` leaves an axis free.
    prior_weight : float
        Points' worth of one unit of log-prior.
    incumbent : array_like, shape (4, 4) or (6,), optional
        A motion to start from, such as that of the scan before. It never changes what is proven, only how
        soon; outside the window the nearest one within is taken.
    refine : bool
        Fit continuously to the surface from the best lattice pose on; not done where there is a prior on the
        pose, which that fit knows nothing of.

    Returns
    -------
    MatchResult
        ``parameters`` the motion of the model, (x, y, z, rotation vector); ``score`` and ``bound`` those of
        the lattice. Where the data leave a direction open the status is ``weak`` and names it; the search
        then holds it where the climb ended, and the certificate is conditional on that.

    Raises
    ------
    ScanError, ConfigError
        For points or settings that cannot be used.
    """
    begun = time.perf_counter()
    problem = make_problem(
        target,
        points,
        prior,
        window,
        tolerance,
        weights=weights,
        pivot=pivot,
        prior_sigma=prior_sigma,
        prior_weight=prior_weight,
    )
    limit = np.inf if max_evaluations is None else float(max_evaluations)
    deadline = None if time_budget is None else begun + time_budget
    if not (eps >= 0.0 and 0.0 <= delta < 1.0):
        raise ConfigError(f"eps must be at least 0 and delta in [0, 1), got {eps} and {delta}")
    if not len(problem.points):
        status = Status("no_data", "there are no points to match")
        return MatchResult("grcsm-3d", np.full(6, np.nan), status=status)
    start = None if incumbent is None else problem.nearest(motion_of(incumbent, "incumbent"))
    conditional, at, score, spent, flat = _prepare(problem, eps, limit, deadline, start)
    outcome = Search3D(conditional, at, score, spent).run(eps, delta, limit, deadline)
    pose = _polished(problem, conditional, outcome)
    seconds = time.perf_counter() - begun
    return _result(problem, conditional, outcome, pose, flat, refine and prior_sigma is None, seconds)


def _prepare(
    problem: Problem3D, eps: float, limit: float, deadline: float | None, start: Array | None
) -> tuple[Problem3D, Array, float, int, Flat]:
    """An incumbent, and the search without what the data leave open there.

    A poor incumbent says nothing of what the data fix, so that the search itself betters it first.
    """
    at, score, spent = first_incumbent(problem, limit, start)
    if score < _GOOD_SHARE * problem.total and len(at):
        first = Search3D(problem, at, score, spent).run(eps, 0.0, min(limit, spent + _SCOUTING), deadline)
        at, score, spent = first.at, first.score, first.evaluations
    flat, named = flat_directions(problem, problem.pose(at))
    if not flat.shape[1]:
        return problem, at, score, spent, named
    at = _at_prior(problem, at, score, flat)
    conditional = without(problem, at, flat)
    score = problem.score(problem.pose(at))
    return conditional, np.zeros(len(conditional.steps)), score, spent + 1, named


def _at_prior(problem: Problem3D, at: Array, score: float, flat: Array) -> Array:
    """Undo a climb's drift along flat directions, where the prior is as good."""
    scale = scales(problem) * problem.steps
    back = at - (flat @ (flat.T @ (at * scale))) / scale
    return back if problem.score(problem.pose(back)) >= score - problem.worth(_NO_LOSS) else at


def _polished(problem: Problem3D, conditional: Problem3D, outcome: Outcome3D) -> Array:
    """The best pose (6,); where directions were held, after a last climb along all of them."""
    pose = conditional.pose(outcome.at)
    if conditional is problem or not len(problem.steps):
        return pose
    around = replace(problem, x0=pose)
    at = np.zeros(len(problem.steps))
    field, points, _, weights, pivot, x0, V, steps, _, prior = around.packed
    score, _ = kernels.climb(field, points, weights, pivot, x0, V, steps, np.full(len(at), 8.0), prior, at, 4)
    return around.pose(at) if score > outcome.score + problem.worth(_NO_LOSS) else pose


def _result(
    problem: Problem3D,
    conditional: Problem3D,
    outcome: Outcome3D,
    pose: Array,
    flat: Flat,
    refine: bool,
    seconds: float,
) -> MatchResult:
    target = problem.target
    cloud = problem.points * target.spacing + target.origin + problem.pivot * target.spacing
    cloud = transform_points(problem.prior, cloud)
    refiner = Refiner(target.surface)
    T = problem.T_model_scan(pose)
    fitted = refiner.judge(cloud, T, 0.5 * target.blur)
    if refine:
        fitted = _refined(problem, refiner, cloud, T, outcome.score, fitted)
    modes = tuple(
        Mode(parameters_of(rigid_inverse(problem.T_model_scan(conditional.pose(at)))), score)
        for score, at in outcome.rivals
    )
    return MatchResult(
        "grcsm-3d",
        parameters_of(rigid_inverse(fitted.T)),
        score=outcome.score,
        bound=outcome.bound,
        evaluations=outcome.evaluations,
        stop=outcome.stop,
        status=_status(conditional, outcome, tuple(name for name, _ in flat)),
        levels=tuple(int(np.ceil(np.log2(2.0 * r + 1.0))) for r in conditional.reach),
        fitness=float(np.mean(fitted.inlier)),
        inlier_rmse=fitted.rmse,
        modes=modes,
        seconds=seconds,
        flat=flat,
    )


def _refined(
    problem: Problem3D, refiner: Refiner, cloud: Array, T: Array, score: float, before: Refined
) -> Refined:
    """Fit to the surface from the lattice pose on; kept while the score agrees."""
    blur = problem.target.blur
    after = refiner.refine(cloud, T, gates=(2.0 * blur, blur), floor=blur / 12.0)
    moved = (transform_points(after.T, cloud) - problem.target.origin) / problem.target.spacing
    still = replace(problem, points=np.ascontiguousarray(moved), pivot=np.zeros(3))
    return after if still.score(np.zeros(6)) >= 0.95 * score else before


def _status(problem: Problem3D, outcome: Outcome3D, names: tuple[str, ...]) -> Status:
    if outcome.score < _LEAST_SHARE * problem.total:
        share = outcome.score / max(problem.total, 1e-300)
        return Status("rejected", f"the best pose of the window explains {share:.0%} of the points")
    if outcome.rivals:
        shares = ", ".join(f"{score / outcome.score:.1%}" for score, _ in outcome.rivals)
        return Status(
            "ambiguous", f"{len(outcome.rivals)} other pose(s) of the window score {shares} of the best"
        )
    if names:
        return Status("weak", f"the points do not fix: {', '.join(names)}; the certificate holds all else")
    edge = np.flatnonzero((np.abs(outcome.at) >= problem.reach) & (problem.reach > 1.0))
    if len(edge):
        axes = ", ".join(direction_name(problem.V[:, j]) for j in edge)
        return Status("weak", f"the best pose lies on the edge of the window: {axes}")
    return OK
