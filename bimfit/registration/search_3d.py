"""Branch and bound over boxes of poses in space, best first, with the workspace that it grows."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from bimfit.geometry.pose import Array
from bimfit.registration import _kernels_3d as kernels
from bimfit.registration.problem_3d import Problem3D, scales
from bimfit.registration.result import Stop

_CHUNK = 1000
_STARTS = 8
_ROTATION_WEIGHT = 0.85
_MAX_MODES = 64


@dataclass(frozen=True)
class Outcome3D:
    """What the branch and bound came to."""

    at: Array
    score: float
    bound: float
    evaluations: int
    stop: Stop
    rivals: tuple[tuple[float, Array], ...] = ()


def first_incumbent(problem: Problem3D, limit: float, start: Array | None = None) -> tuple[Array, float, int]:
    """Climb from a start (d,), the window's middle and a few points over it: (at, score, evaluations)."""
    from scipy.stats import qmc

    d = len(problem.steps)
    if not d:
        return np.zeros(0), problem.score(problem.x0), 1
    starts = np.zeros((1, d))
    if np.prod(2.0 * problem.reach + 1.0) > 1000.0:
        spread = 2.0 * qmc.Halton(d, scramble=False).random(_STARTS + 1)[1:] - 1.0
        starts = np.concatenate([starts, np.rint(0.6 * spread * problem.reach)])
    if start is not None:
        starts = np.concatenate([start[None], starts])
    first = max(1, 2 ** int(np.log2(max(problem.reach.max() / 3.0, 1.0))))
    best, score, spent = starts[0], -np.inf, 0
    field, points, _, weights, pivot, x0, V, steps, reach, prior = problem.packed
    for begin in starts:
        if spent >= limit:
            break
        at = begin.copy()
        found, count = kernels.climb(field, points, weights, pivot, x0, V, steps, reach, prior, at, first)
        spent += int(count)
        if found > score:
            best, score = at, float(found)
    return best, score, spent


class Search3D:
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
            2.0 * problem.target.blur / problem.target.spacing / (scales(problem) * problem.steps)
        )
        lever = np.array([_lever(problem.points, problem.V[3:, j]) for j in range(d)])
        self.motion = np.linalg.norm(problem.V[:3], axis=0) + _ROTATION_WEIGHT * lever * (turn > 0.0)

    def run(self, eps: float, delta: float, limit: float, deadline: float | None) -> Outcome3D:
        """Prove the best pose, then look for rivals when ``delta`` > 0."""
        if not len(self.problem.steps):
            score = float(self.state[0])
            return Outcome3D(self.best[0], score, score, int(self.state[4]), "proven")
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
        return Outcome3D(self.best[0].copy(), score, bound, int(self.state[4]), stop, tuple(rivals))

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
        field, points, _, weights, pivot, x0, V, steps, reach, prior = self.problem.packed
        leaf, summit = self.best[1].copy(), self.best[1].copy()
        score, count = kernels.climb(field, points, weights, pivot, x0, V, steps, reach, prior, summit, 4)
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
