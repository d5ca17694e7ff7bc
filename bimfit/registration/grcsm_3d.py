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
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import qmc

from bimfit.errors import ConfigError, ScanError
from bimfit.geometry.pose import Array, rigid_inverse, transform_points
from bimfit.geometry.status import OK, Status
from bimfit.registration import _kernels_3d as kernels
from bimfit.registration.result import MatchResult, Mode, Stop
from bimfit.registration.rigid_3d import (
    WEAK_POINTS,
    Refined,
    Refiner,
    about,
    direction_name,
    matrix_of,
    parameters_of,
)
from bimfit.registration.table_3d import Target3D

_CHUNK = 1000
_STARTS = 8
_ROTATION_WEIGHT = 0.85
_MAX_MODES = 64
_LEAST_SHARE = 0.1
_GOOD_SHARE = 0.5
_SCOUTING = 3000
_NO_LOSS = 0.5
"""Scores that differ by less than this many points are as good."""


@dataclass(frozen=True)
class Problem3D:
    """One search: points about their pivot and a lattice of poses. Lengths in lattice cells.

    Attributes
    ----------
    target : Target3D
    prior : ndarray, shape (4, 4)
        Motion of the model at the window's middle.
    points : ndarray, shape (n, 3)
        Data in the designed model's frame, about ``pivot``.
    weights : ndarray, shape (n,)
    pivot : ndarray, shape (3,)
        From the field's first node.
    x0 : ndarray, shape (6,)
        Pose (shift, rotation vector) at lattice coordinates 0.
    V : ndarray, shape (6, d)
        Directions that are searched; pose = x0 + V (steps * coordinates).
    steps, reach : ndarray, shape (d,)
        Length of a lattice step, and how many steps the window reaches each way.
    """

    target: Target3D
    prior: Array
    points: Array
    weights: Array
    pivot: Array
    x0: Array
    V: Array
    steps: Array
    reach: Array

    @property
    def rho(self) -> Array:
        """Distance of every point from the pivot, cells."""
        return np.asarray(np.linalg.norm(self.points, axis=1))

    @property
    def lever(self) -> float:
        """Root mean square distance of the points from the pivot, cells."""
        return float(max(np.sqrt(np.mean(self.rho**2)), 1e-9))

    @property
    def total(self) -> float:
        """No pose scores more than this."""
        return float(self.weights.sum())

    def worth(self, points: float) -> float:
        """Score of so many points of mean weight that lie on the surface."""
        return points * self.total / max(len(self.points), 1)

    @property
    def packed(self) -> tuple[Any, ...]:
        """The kernels' argument."""
        return (
            self.target.field,
            self.points,
            self.rho,
            self.weights,
            self.pivot,
            self.x0,
            self.V,
            self.steps,
            self.reach,
        )

    def pose(self, at: ArrayLike) -> Array:
        """Shift (cells) and rotation vector at lattice coordinates ``at`` (d,), shape (6,)."""
        return np.asarray(self.x0 + self.V @ (self.steps * np.asarray(at, float)))

    def score(self, pose: Array) -> float:
        """Score of a pose (6,) as ``pose`` gives it."""
        J, R = np.empty((3, 3)), np.empty((3, 3))
        args = (self.target.field, self.points, self.weights, self.pivot, np.ascontiguousarray(pose), R, J)
        return float(kernels.score_at(*args))

    def bound(self, low: ArrayLike, high: ArrayLike) -> float:
        """Upper bound of the score over the lattice poses ``low`` .. ``high`` (d,)."""
        a, b = np.asarray(low, float), np.asarray(high, float)
        half = 0.5 * (b - a) * self.steps
        slope = np.empty(len(half))
        constant = kernels.bound_node(
            self.points,
            self.rho,
            self.weights,
            self.pivot,
            self.pose(0.5 * (a + b)),
            half,
            self.V,
            self.target.tables.packed,
            np.empty((3, 3)),
            np.empty((3, 3)),
            slope,
        )
        return float(min(constant + np.abs(slope) @ half, self.total))

    def T_model_scan(self, pose: Array) -> Array:
        """What carries the scan to the designed model at a pose (6,), shape (4, 4)."""
        cell = self.target.spacing
        pivot = self.target.origin + self.pivot * cell
        return np.asarray(about(pivot, pose[:3] * cell, pose[3:]) @ rigid_inverse(self.prior))


@dataclass(frozen=True)
class _Outcome:
    """What the branch and bound came to."""

    at: Array
    score: float
    bound: float
    evaluations: int
    stop: Stop
    rivals: tuple[tuple[float, Array], ...] = ()


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
    refine : bool
        Fit continuously to the surface from the best lattice pose on.

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
    problem = make_problem(target, points, prior, window, tolerance, weights=weights, pivot=pivot)
    limit = np.inf if max_evaluations is None else float(max_evaluations)
    deadline = None if time_budget is None else begun + time_budget
    if not (eps >= 0.0 and 0.0 <= delta < 1.0):
        raise ConfigError(f"eps must be at least 0 and delta in [0, 1), got {eps} and {delta}")
    if not len(problem.points):
        status = Status("no_data", "there are no points to match")
        return MatchResult("grcsm-3d", np.full(6, np.nan), status=status)
    conditional, at, score, spent, names = _prepare(problem, eps, limit, deadline)
    outcome = _Search(conditional, at, score, spent).run(eps, delta, limit, deadline)
    pose = _polished(problem, conditional, outcome)
    seconds = time.perf_counter() - begun
    return _result(problem, conditional, outcome, pose, names, refine, seconds)


def _prepare(
    problem: Problem3D, eps: float, limit: float, deadline: float | None
) -> tuple[Problem3D, Array, float, int, tuple[str, ...]]:
    """An incumbent, and the search without what the data leave open there.

    A poor incumbent says nothing of what the data fix, so that the search itself betters it first.
    """
    at, score, spent = _incumbent(problem, limit)
    if score < _GOOD_SHARE * problem.total and len(at):
        first = _Search(problem, at, score, spent).run(eps, 0.0, min(limit, spent + _SCOUTING), deadline)
        at, score, spent = first.at, first.score, first.evaluations
    flat, names = flat_directions(problem, problem.pose(at))
    if not flat.shape[1]:
        return problem, at, score, spent, names
    at = _at_prior(problem, at, score, flat)
    conditional = _without(problem, at, flat)
    score = problem.score(problem.pose(at))
    return conditional, np.zeros(len(conditional.steps)), score, spent + 1, names


def _at_prior(problem: Problem3D, at: Array, score: float, flat: Array) -> Array:
    """Undo a climb's drift along flat directions, where the prior is as good."""
    scale = _scales(problem) * problem.steps
    back = at - (flat @ (flat.T @ (at * scale))) / scale
    return back if problem.score(problem.pose(back)) >= score - problem.worth(_NO_LOSS) else at


def _polished(problem: Problem3D, conditional: Problem3D, outcome: _Outcome) -> Array:
    """The best pose (6,); where directions were held, after a last climb along all of them."""
    pose = conditional.pose(outcome.at)
    if conditional is problem or not len(problem.steps):
        return pose
    around = replace(problem, x0=pose)
    at = np.zeros(len(problem.steps))
    field, points, _, weights, pivot, x0, V, steps, _ = around.packed
    score, _ = kernels.climb(field, points, weights, pivot, x0, V, steps, np.full(len(at), 8.0), at, 4)
    return around.pose(at) if score > outcome.score + problem.worth(_NO_LOSS) else pose


def make_problem(
    target: Target3D,
    points: ArrayLike,
    prior: ArrayLike | None,
    window: Sequence[float],
    tolerance: Sequence[float],
    *,
    weights: ArrayLike | None = None,
    pivot: ArrayLike | None = None,
) -> Problem3D:
    """Check a search's input and bring it to lattice cells; arguments as those of :func:`match_3d`.

    Raises
    ------
    ScanError, ConfigError
    """
    half, step = np.asarray(window, float), np.asarray(tolerance, float)
    if half.shape != (6,) or step.shape != (6,):
        raise ConfigError("window and tolerance take six numbers: x, y, z (m) and rotation vector (rad)")
    if not (np.all(np.isfinite(half)) and np.all(half >= 0.0) and np.all(half[3:] <= np.pi)):
        raise ConfigError(f"window must be six numbers of at least 0, angles at most pi, got {half.tolist()}")
    if not (np.all(np.isfinite(step)) and np.all(step > 0.0)):
        raise ConfigError(f"tolerance must be six positive numbers, got {step.tolist()}")
    cloud = np.asarray(points, float)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or not np.all(np.isfinite(cloud)):
        raise ScanError(f"points must be an (n, 3) array of finite numbers, got shape {cloud.shape}")
    w = np.ones(len(cloud)) if weights is None else np.asarray(weights, float)
    if w.shape != (len(cloud),) or not np.all(np.isfinite(w)) or np.any(w < 0.0):
        raise ConfigError("weights must be one number of at least 0 a point")
    motion = _motion(prior)
    back = rigid_inverse(motion)
    local = transform_points(back, cloud)
    centre = np.zeros(3) if not len(cloud) else 0.5 * (local.min(axis=0) + local.max(axis=0))
    if pivot is not None:
        centre = transform_points(back, np.asarray(pivot, float))
    cell = target.spacing
    # Neighbours in space are neighbours in memory: their look-ups share cache lines.
    tile = np.floor((local - target.origin) / (8.0 * cell)).astype(np.int64)
    order = np.lexsort((tile[:, 2], tile[:, 1], tile[:, 0]))
    searched = np.flatnonzero(half > 0.0)
    scale = np.array([cell] * 3 + [1.0] * 3)
    return Problem3D(
        target,
        motion,
        np.ascontiguousarray((local[order] - centre) / cell),
        np.ascontiguousarray(w[order]),
        np.ascontiguousarray((centre - target.origin) / cell),
        np.zeros(6),
        np.ascontiguousarray(np.eye(6)[:, searched]),
        (step / scale)[searched],
        np.ceil(half / step - 1e-9)[searched],
    )


def _motion(prior: ArrayLike | None) -> Array:
    if prior is None:
        return np.eye(4)
    given = np.asarray(prior, float)
    if given.shape not in ((6,), (4, 4)) or not np.all(np.isfinite(given)):
        raise ConfigError("prior must be a 4 x 4 matrix or six numbers: x, y, z and rotation vector")
    motion = matrix_of(given) if given.shape == (6,) else given
    if not np.allclose(motion[:3, :3] @ motion[:3, :3].T, np.eye(3), atol=1e-6):
        raise ConfigError("prior must be a rigid motion")
    return motion


def _incumbent(problem: Problem3D, limit: float) -> tuple[Array, float, int]:
    """Climb from the window's middle and from a few points spread over it: (at, score, evaluations)."""
    d = len(problem.steps)
    if not d:
        return np.zeros(0), problem.score(problem.x0), 1
    starts = np.zeros((1, d))
    if np.prod(2.0 * problem.reach + 1.0) > 1000.0:
        spread = 2.0 * qmc.Halton(d, scramble=False).random(_STARTS + 1)[1:] - 1.0
        starts = np.concatenate([starts, np.rint(0.6 * spread * problem.reach)])
    first = max(1, 2 ** int(np.log2(max(problem.reach.max() / 3.0, 1.0))))
    best, score, spent = starts[0], -1.0, 0
    field, points, _, weights, pivot, x0, V, steps, reach = problem.packed
    for start in starts:
        if spent >= limit:
            break
        at = start.copy()
        found, count = kernels.climb(field, points, weights, pivot, x0, V, steps, reach, at, first)
        spent += int(count)
        if found > score:
            best, score = at, float(found)
    return best, score, spent


def flat_directions(problem: Problem3D, pose: Array) -> tuple[Array, tuple[str, ...]]:
    """The searched directions that the score hardly depends on at a pose (6,).

    The score's curvature over half a blur is an effective number of points that fix a direction. A
    direction is flat where they are too few to fix it within the tolerance (the noise taken as half the
    blur), but never for lack of more than one in a hundred, and always under ``WEAK_POINTS``.

    Returns
    -------
    flat : ndarray, shape (d, k)
        Orthonormal, in the searched axes with rotations scaled by the lever.
    names : tuple of str
    """
    d = len(problem.steps)
    scale = _scales(problem)
    blur = problem.target.blur / problem.target.spacing
    h = 0.5 * blur
    directions = problem.V / scale

    def score(z: Array) -> float:
        return problem.score(pose + directions @ z)

    H = np.zeros((d, d))
    unit = h * np.eye(d)
    middle = problem.score(pose)
    for i in range(d):
        H[i, i] = (2.0 * middle - score(unit[i]) - score(-unit[i])) / h**2
        for j in range(i):
            H[i, j] = H[j, i] = (
                score(unit[i] - unit[j])
                + score(unit[j] - unit[i])
                - score(unit[i] + unit[j])
                - score(-unit[i] - unit[j])
            ) / (4.0 * h**2)
    values, vectors = np.linalg.eigh(H) if d else (np.zeros(0), np.zeros((0, 0)))
    # Fixed to within a tolerance: so many points of half a blur's spread does it take.
    needed = (0.5 * blur / float(np.median(problem.steps * scale))) ** 2 if d else 0.0
    limit = problem.worth(max(WEAK_POINTS, min(needed, 0.01 * len(problem.points))))
    # Far from a summit the score curves upwards too, but there it changes.
    still = [max(abs(score(h * v) - middle), abs(score(-h * v) - middle)) < 0.5 * limit for v in vectors.T]
    flat = vectors[:, (values * blur**2 < limit) & np.array(still, bool)]
    return flat, tuple(direction_name(problem.V @ column) for column in flat.T)


def _scales(problem: Problem3D) -> Array:
    """Motion of the data, cells, a unit of each searched direction, shape (d,)."""
    shift = np.linalg.norm(problem.V[:3], axis=0)
    turn = np.linalg.norm(problem.V[3:], axis=0)
    return np.asarray(shift + problem.lever * turn)


def _without(problem: Problem3D, at: Array, flat: Array) -> Problem3D:
    """The search with flat directions held at lattice coordinates ``at`` (d,)."""
    scale = _scales(problem)
    basis = np.linalg.svd(flat, full_matrices=True)[0][:, flat.shape[1] :] if flat.size else np.eye(len(at))
    V = problem.V / scale @ basis
    step = problem.steps * scale
    steps = np.sqrt((basis**2).T @ step**2)
    # The new axes' box must hold the old one, wherever in it the climb ended.
    half = np.abs(basis).T @ (step * (problem.reach + np.abs(at)))
    return replace(
        problem,
        x0=problem.pose(at),
        V=np.ascontiguousarray(V),
        steps=np.ascontiguousarray(steps),
        reach=np.ceil(half / steps - 1e-9) if len(steps) else np.zeros(0),
    )


class _Search:
    """Branch and bound with its workspace, which grows as the kernel asks."""

    def __init__(self, problem: Problem3D, at: Array, score: float, spent: int) -> None:
        self.problem = problem
        d = len(problem.steps)
        capacity = 1 << 14
        self.keys = np.zeros(capacity)
        self.low = np.zeros((capacity, d), np.int32)
        self.high = np.zeros((capacity, d), np.int32)
        self.heap = np.zeros(capacity, np.int64)
        self.free = np.zeros(capacity, np.int64)
        self.best = np.stack([at, at])
        self.state = np.array([score, 1.0, 1.0, 0.0, float(spent), 0.0, 0.0, 0.0])
        self.keys[0] = problem.total
        self.low[0] = -problem.reach
        self.high[0] = problem.reach
        self.zones = np.zeros((_MAX_MODES, d))
        turn = np.linalg.norm(problem.V[3:], axis=0)
        self.zone_half = (
            2.0 * problem.target.blur / problem.target.spacing / (_scales(problem) * problem.steps)
        )
        lever = np.array([_lever(problem.points, problem.V[3:, j]) for j in range(d)])
        self.motion = np.linalg.norm(problem.V[:3], axis=0) + _ROTATION_WEIGHT * lever * (turn > 0.0)

    def run(self, eps: float, delta: float, limit: float, deadline: float | None) -> _Outcome:
        """Prove the best pose, then look for rivals when ``delta`` > 0."""
        if not len(self.problem.steps):
            score = float(self.state[0])
            return _Outcome(self.best[0], score, score, int(self.state[4]), "proven")
        done = self._phase(0.0, eps, delta, limit, deadline)
        score = float(self.state[0])
        still_open = float(self.keys[self.heap[0]]) if self.state[1] > 0 else 0.0
        bound = max(score, float(self.state[5]), still_open)
        rivals: list[tuple[float, Array]] = []
        if done == 0 and delta > 0.0:
            self.zones[0] = self.best[0]
            self.state[6] = 1.0
            while self.state[6] < _MAX_MODES and self._phase(1.0, eps, delta, limit, deadline) == 3:
                self._take_rival(rivals)
        rivals.sort(key=lambda rival: -rival[0])
        stop: Stop = "budget" if done else ("proven" if bound <= score else "tolerance")
        return _Outcome(self.best[0].copy(), score, bound, int(self.state[4]), stop, tuple(rivals))

    def _phase(self, phase: float, eps: float, delta: float, limit: float, deadline: float | None) -> int:
        """0 done, 1 out of budget, 3 a rival leaf."""
        while True:
            allowed = min(limit, self.state[4] + _CHUNK) if deadline is not None else limit
            verdict = kernels.search(
                self.problem.packed,
                self.problem.target.tables.packed,
                (self.keys, self.low, self.high, self.heap, self.free),
                self.state,
                self.best,
                self.motion,
                (eps, delta, float(allowed), phase),
                self.zones,
                self.zone_half,
            )
            if verdict == 2:
                self._grow()
            elif verdict == 1:
                if self.state[4] >= limit or (deadline is not None and time.perf_counter() >= deadline):
                    return 1
            else:
                return int(verdict)

    def _grow(self) -> None:
        n = len(self.keys)
        self.keys = np.concatenate([self.keys, np.zeros(n)])
        self.low = np.concatenate([self.low, np.zeros_like(self.low)])
        self.high = np.concatenate([self.high, np.zeros_like(self.high)])
        self.heap = np.concatenate([self.heap, np.zeros_like(self.heap)])
        self.free = np.concatenate([self.free, np.zeros_like(self.free)])

    def _take_rival(self, rivals: list[tuple[float, Array]]) -> None:
        """Climb from a leaf that lies apart; keep its summit unless it is one that is known."""
        field, points, _, weights, pivot, x0, V, steps, reach = self.problem.packed
        leaf, summit = self.best[1].copy(), self.best[1].copy()
        score, count = kernels.climb(field, points, weights, pivot, x0, V, steps, reach, summit, 4)
        self.state[4] += count
        k = int(self.state[6])
        known = np.any(np.all(np.abs(self.zones[:k] - summit) <= self.zone_half, axis=1))
        if not known:
            rivals.append((float(score), summit))
        # A shoulder of a known mode is marked too, so that its leaves are not met one by one.
        self.zones[k] = leaf if known else summit
        self.state[6] += 1.0


def _lever(points: Array, axis: Array) -> float:
    """Root mean square of |axis x point|."""
    return float(np.sqrt(np.mean(np.sum(np.cross(axis, points) ** 2, axis=1))))


def _result(
    problem: Problem3D,
    conditional: Problem3D,
    outcome: _Outcome,
    pose: Array,
    names: tuple[str, ...],
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
        status=_status(conditional, outcome, names),
        levels=tuple(int(np.ceil(np.log2(2.0 * r + 1.0))) for r in conditional.reach),
        fitness=float(np.mean(fitted.inlier)),
        inlier_rmse=fitted.rmse,
        modes=modes,
        seconds=seconds,
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


def _status(problem: Problem3D, outcome: _Outcome, names: tuple[str, ...]) -> Status:
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
