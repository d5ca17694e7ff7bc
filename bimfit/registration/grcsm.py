"""GRCSM: the best-scoring pose of a window, proven (paper, section 4.4; METHOD, section 3)."""

from __future__ import annotations

import functools
import math
import threading
import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bimfit.config import Bound, SearchConfig
from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array, Pose2D, wrap_angle
from bimfit.registration import _kernels as kernels
from bimfit.registration import _kernels_table as table_kernels
from bimfit.registration.lattice import Integers, Lattice
from bimfit.registration.result import Stop
from bimfit.registration.table import BLUR_REACH, Tables, Target

MIN_POINTS = 3
PAD = kernels.PAD
WEIGHT_STEPS = 255  # unequal weights are rounded to this many steps of the greatest, or fewer
MOST_WEIGHT = 300_000  # steps of all points together that the kernels' 32 bits hold
TIME_SLICE = 2_000  # evaluations between two looks at the clock
NOTHING = kernels.NOTHING
_UNIT: NDArray[np.uint64] = np.zeros(0, np.uint64)  # stands for unit weights
ARM = 0.25  # a model's typical radius, as a share of its box's diagonal


def lattice_of(target: Target, config: SearchConfig, bound: Bound) -> Lattice:
    """The poses of a window; nodes are split by the model's size, unless the levels are asked for."""
    low_u, low_v, high_u, high_v = target.box
    derived = config.levels is None and config.axis_levels is None and bound != "block"
    return _lattice(config, ARM * math.hypot(high_u - low_u, high_v - low_v) if derived else 0.0)


@functools.lru_cache(maxsize=64)
def _lattice(config: SearchConfig, arm: float) -> Lattice:
    lattice = Lattice.of(config)
    return lattice.balanced(arm) if arm > 0.0 else lattice


@dataclass(frozen=True)
class Problem:
    """One slice against one target, in the kernels' terms.

    Attributes
    ----------
    tables : Tables
    pivot : tuple of 2 float
        The data turn about it, m.
    pu, pv : ndarray, shape (n,)
        Points about the pivot, in cells.
    weight, heft : ndarray of uint64 and of float32, shape (n,)
        Weights in steps, as the scores and as the quadratic bounds need them.
    unit : float
        Score that one step of weight times table value stands for.
    start : ndarray, shape (5,)
        Pivot's cell coordinates, ratios of the cell's sides, eps.
    """

    tables: Tables
    pivot: tuple[float, float]
    pu: Array
    pv: Array
    weight: NDArray[np.uint64]
    heft: NDArray[np.float32]
    unit: float
    start: Array
    rounding: float

    @property
    def n(self) -> int:
        """Number of points that can meet the model at all."""
        return len(self.pu)

    @property
    def chunk(self) -> int:
        """Points whose sum fits a lane of a word."""
        return max(1, kernels.LANE_SUM // (table_kernels.FULL * int(self.weight.max(initial=1))))


def pose_problem(
    target: Target,
    points: Array,
    prior: Pose2D,
    weights: ArrayLike | None,
    config: SearchConfig,
    bound: Bound,
) -> Problem | None:
    """Bring a slice into the kernels' terms.

    Points that no pose of the window brings near the model score 0 everywhere and are left out, as are
    those that are not numbers. None when fewer than three are left.

    Raises
    ------
    ConfigError
        When the weights do not suit the points.
    """
    lattice = lattice_of(target, config, bound)
    n = len(points)
    given, unit, rounding = weight_steps(weights, n)
    margin = BLUR_REACH * target.blur + lattice.step[0] + lattice.step[1]
    low_u, low_v, high_u, high_v = target.box
    box = np.array([low_u - margin, low_v - margin, high_u + margin, high_v + margin])
    back = prior.inverse()
    motion = np.array([math.cos(back.theta), math.sin(back.theta), back.u, back.v])
    step_u, step_v = lattice.step[0], lattice.step[1]
    padded = n + PAD
    pu, pv, weight, out = np.empty(padded), np.empty(padded), np.empty(padded, np.uint64), np.empty(4)
    heft = np.empty(padded, np.float32)
    kernels.prepare(
        points, motion, box, math.hypot(lattice.half[0], lattice.half[1]),
        2.0 * math.sin(0.5 * min(lattice.half[2], math.pi)), 1.0 / step_u, 1.0 / step_v, given, pu, pv,
        weight, heft, out,
    )  # fmt: skip
    kept = int(out[3])
    if kept < MIN_POINTS:
        return None
    tables = target.tables(lattice, bound, float(out[2]))
    start = np.array(
        [
            (out[0] + lattice.first[0] - tables.origin[0]) / step_u,
            (out[1] + lattice.first[1] - tables.origin[1]) / step_v,
            step_v / step_u,
            step_u / step_v,
            config.eps,
        ]
    )
    kept = -(-kept // PAD) * PAD
    return Problem(
        tables,
        (float(out[0]), float(out[1])),
        pu[:kept],
        pv[:kept],
        weight[:kept],
        heft[:kept],
        unit,
        start,
        rounding,
    )


def weight_steps(weights: ArrayLike | None, n: int) -> tuple[NDArray[np.uint64], float, float]:
    """Weights as whole steps (empty: all 1), the score of one step, and what rounding can change."""
    if n > MOST_WEIGHT:
        raise ConfigError(f"{n} points in one slice are too many", remedy="thin the scan or the slices")
    if weights is None:
        return _UNIT, 1.0 / table_kernels.FULL, 0.5 * n / table_kernels.FULL
    values = np.asarray(weights, float)
    if values.shape != (n,) or not np.all(np.isfinite(values)) or np.any(values < 0.0):
        raise ConfigError(f"weights are {n} numbers of at least 0, one a point")
    top = float(values.max(initial=0.0))
    if top == 0.0:
        raise ConfigError("all weights are 0")
    steps = max(1, min(WEIGHT_STEPS, MOST_WEIGHT // max(n, 1)))
    whole = np.rint(values * (steps / top))
    rounding = float(0.5 * values.sum() / table_kernels.FULL + 0.5 * n * top / steps)
    return whole.astype(np.uint64), top / (steps * table_kernels.FULL), rounding


def prior_table(config: SearchConfig, lattice: Lattice, unit: float) -> tuple[Integers, Integers, bool]:
    """Log-prior of every leaf an axis, and its maximum over every node, in the score's integer steps."""
    place = np.zeros((lattice.top + 1, 3), np.int64)
    if config.prior_sigma is None:
        return np.zeros(1, np.int64), place, False
    parts: list[Integers] = []
    offset = 0
    for axis in range(3):
        motion = lattice.first[axis] + lattice.step[axis] * np.arange(lattice.count[axis])
        nats = -0.5 * (motion / config.prior_sigma[axis]) ** 2
        leaf = np.rint(np.maximum(config.prior_weight * nats / unit, -1e12)).astype(np.int64)
        for level in range(lattice.top + 1):
            part = leaf.reshape(-1, int(lattice.size[level, axis])).max(axis=1)
            place[level, axis] = offset
            parts.append(part)
            offset += len(part)
    return np.concatenate(parts), place, True


@dataclass(frozen=True)
class Plan:
    """What a search of up to ``capacity`` points on one set of tables needs to know, worked out once."""

    first: int
    lowest: int
    roots: int
    fan: int
    slot_count: int
    near: int
    tally: int
    part: int
    capacity: int

    @classmethod
    def of(cls, tables: Tables, capacity: int) -> Plan:
        """Choose the first level and count what the workspace must hold."""
        lattice = tables.lattice
        top, nodes, size = lattice.top, lattice.nodes, lattice.size
        quads = np.flatnonzero(tables.quad_place[:, 0] >= 0)
        first, place = tables.first, tables.block_place
        lowest = min([first, *(h - 1 for h in range(2, first + 1) if h not in quads)])
        fan = max((int((size[h] // size[h - 1]).prod()) for h in range(1, top + 1)), default=1)
        ends = np.cumsum(nodes[:, 2])
        split = [(size[h] // size[h - 1])[:2] for h in range(1, top + 1)]
        tally = max([1, *(int(v) * (int(u) + table_kernels.RIM) for u, v in split)])
        part = int(nodes[first, 1] * place[first, 0, 5]) + 2 * table_kernels.RIM if place.ndim == 3 else 1
        return cls(
            first, lowest, int(nodes[first].prod()), fan, int(ends[-1]),
            int(nodes[quads, 2].sum()), tally, part, capacity,
        )  # fmt: skip


class Workspace:
    """Scratch arrays of one thread for one plan; the queue and the collected leaves grow as needed."""

    def __init__(self, plan: Plan, lattice: Lattice) -> None:
        n, angles, wide = plan.capacity, lattice.count[2], int(lattice.nodes[plan.first, :2].prod())
        self.pu, self.pv = np.empty(n), np.empty(n)
        self.weight, self.heft = np.empty(n, np.uint64), np.empty(n, np.float32)
        self.classes = np.empty((lattice.top + 1) * n, np.uint8)
        self.cu, self.cv = np.empty(angles * n, np.int32), np.empty(angles * n, np.int32)
        self.flags = np.zeros(angles + plan.slot_count, np.uint8)
        self.have, self.near_have = self.flags[:angles], self.flags[angles:]
        self.list_counts = np.empty(plan.slot_count, np.int32)
        self.lists = np.empty((4, plan.slot_count * n), np.int32)
        self.near = np.empty(max(1, plan.near) * n, np.uint8)
        self.at = np.empty(2 * max(n, kernels.RUN), np.int32)
        self.words = np.empty(kernels.RUN, np.uint64)
        self.halves = self.words.view(np.int32)
        self.coef = np.empty(5 * kernels.RUN, np.float32)
        self.sums, self.turns = np.empty(6), np.empty(3 * int(lattice.size[lattice.top, 2]))
        self.box = np.empty(max(wide, plan.fan), np.int64)
        self.tally = np.empty(plan.tally, np.int32)
        self.part = np.empty(plan.part, np.uint16)
        self.root = np.empty(plan.roots, np.int32)
        self.crest = np.empty(int(lattice.nodes[plan.first, 1:].prod()), np.int64)
        self.keys = np.empty(plan.roots + (lattice.top + 2) * plan.fan + 1024, np.int64)
        self.codes = np.empty_like(self.keys)
        self.found = np.empty(max(1024, 2 * plan.fan), np.int64)
        self.values = np.empty_like(self.found)

    @cached_property
    def scratch(self) -> kernels.Scratch:
        """All of it, as the kernels take it."""
        return kernels.Scratch(
            np.empty(5), self.pu, self.pv, self.weight, self.heft, self.classes, self.cu, self.cv, self.have,
            self.lists, self.list_counts, self.near, self.near_have, self.at, self.words, self.halves,
            self.coef, self.sums, self.turns, self.tally, self.part, self.box, self.root, self.crest,
            self.keys, self.codes, self.found, self.values, np.empty(kernels.STATE_SIZE, np.int64),
            np.empty(4), np.empty(4),
        )  # fmt: skip

    def clear(self) -> None:
        """Forget the last slice."""
        self.flags[:] = 0
        self.list_counts[:] = -1

    def grow(self, *names: str) -> None:
        """Double arrays, keeping their values."""
        for name in names:
            old = getattr(self, name)
            array = np.empty(2 * len(old), old.dtype)
            array[: len(old)] = old
            setattr(self, name, array)
        self.__dict__.pop("scratch", None)


_LOCAL = threading.local()
KEPT_WORKSPACES = 4


def workspace(tables: Tables, n: int) -> tuple[Plan, Workspace]:
    """The calling thread's plan and scratch arrays for some tables, made anew only for more points."""
    kept: dict[int, tuple[Tables, Plan, Workspace]] = _LOCAL.__dict__.setdefault("kept", {})
    held = kept.get(id(tables))
    if held is None or held[1].capacity < n:
        while len(kept) >= KEPT_WORKSPACES:
            del kept[next(iter(kept))]
        plan = Plan.of(tables, -(-n // 64) * 64)
        held = tables, plan, Workspace(plan, tables.lattice)
        kept[id(tables)] = held
    return held[1], held[2]


@dataclass(frozen=True)
class Outcome:
    """What a run of the kernel left."""

    score: int
    bound: int
    index: tuple[int, int, int]
    evaluations: int
    stop: Stop
    found: tuple[Integers, Integers]


def run(
    problem: Problem, config: SearchConfig, *, incumbent: tuple[int, int, int] | None = None,
    collect_from: int | None = None, deadline: float | None = None,
) -> Outcome:  # fmt: skip
    """Search, resuming after every look at the clock or growth of the queue."""
    tables, lattice, n = problem.tables, problem.tables.lattice, problem.n
    plan, work = workspace(tables, n)
    work.clear()
    prior, prior_at, has_prior = prior_table(config, lattice, problem.unit)
    kernels.point_classes(
        n, problem.pu, problem.pv, lattice.step[0], lattice.step[1], plan.lowest, lattice.half_angle,
        tables.class_of, work.classes,
    )  # fmt: skip
    state = np.zeros(kernels.STATE_SIZE, np.int64)
    state[kernels.BEST], state[kernels.BEST_CODE] = NOTHING, 0
    if incumbent is not None:
        state[kernels.BEST], state[kernels.BEST_CODE] = _leaf_score(
            problem, incumbent, prior, prior_at, has_prior
        )
    limit = config.max_evaluations if config.max_evaluations is not None else 1 << 60
    options = np.array(
        [n, plan.first, lattice.top, problem.chunk, limit, TIME_SLICE if deadline is not None else 1 << 60,
         collect_from is not None, collect_from or 0, has_prior, int(problem.weight.sum())], np.int64,
    )  # fmt: skip
    while True:
        scratch = work.scratch._replace(
            start=problem.start, pu=problem.pu, pv=problem.pv, weight=problem.weight, heft=problem.heft,
            state=state,
        )  # fmt: skip
        ended = kernels.search(options, tables.model, prior, prior_at, scratch)
        if ended == kernels.HEAP_FULL:
            work.grow("keys", "codes")
        elif ended == kernels.FOUND_FULL:
            work.grow("found", "values")
        elif (
            ended != kernels.BUDGET
            or state[kernels.EVALUATIONS] >= limit
            or (deadline is not None and time.perf_counter() >= deadline)
        ):
            break
    count = int(state[kernels.FOUND])
    names: dict[int, Stop] = {kernels.DONE: "proven", kernels.TOLERANCE: "tolerance"}
    stop = names.get(ended, "budget")
    return Outcome(
        int(state[kernels.BEST]), int(state[kernels.BOUND]), unpack(int(state[kernels.BEST_CODE])),
        int(state[kernels.EVALUATIONS]), stop, (work.found[:count].copy(), work.values[:count].copy()),
    )  # fmt: skip


def unpack(code: int) -> tuple[int, int, int]:
    """Leaf indices (u, v, theta) of a code."""
    mask = (1 << kernels.SHIFT_NODE) - 1
    return code & mask, (code >> kernels.SHIFT_NODE) & mask, code >> (2 * kernels.SHIFT_NODE)


def _leaf_score(
    problem: Problem, index: tuple[int, int, int], prior: Integers, prior_at: Integers, has_prior: bool
) -> tuple[int, int]:
    """Score and code of one leaf."""
    n, tables = problem.n, problem.tables
    cu, cv, at = (np.empty(n, np.int32) for _ in range(3))
    out = np.empty(1, np.int64)
    kernels.fill_cells(
        0, n, tables.cosine[index[2]], tables.sine[index[2]], problem.pu, problem.pv, problem.start, cu, cv
    )
    kernels.score_box(
        0, n, cu, cv, problem.weight, problem.chunk, tables.lanes, index[1], 1, index[0], 1, at, out, 0
    )
    value = int(out[0])
    if has_prior:
        value += int(sum(prior[prior_at[0, axis] + index[axis]] for axis in range(3)))
    return value, (index[2] << (2 * kernels.SHIFT_NODE)) | (index[1] << kernels.SHIFT_NODE) | index[0]


def pose_of(
    lattice: Lattice, pivot: tuple[float, float], index: tuple[int, int, int], prior: Pose2D
) -> Pose2D:
    """Motion of the model that a leaf stands for: the leaf moves the data, so it is inverted.

    ``prior @ Pose2D.about(pivot, *motion).inverse()``, written out: it is worked out for every slice.
    """
    u, v, theta = lattice.motion(index)
    c, s = math.cos(theta), math.sin(theta)
    a, b = pivot[0] + u, pivot[1] + v
    x, y = pivot[0] - c * a - s * b, pivot[1] + s * a - c * b
    c, s = math.cos(prior.theta), math.sin(prior.theta)
    return Pose2D(prior.u + c * x - s * y, prior.v + s * x + c * y, wrap_angle(prior.theta - theta))


def leaf_of(problem: Problem, pose: Pose2D, prior: Pose2D) -> tuple[int, int, int] | None:
    """The leaf nearest to a motion of the model, or None outside the window."""
    motion = (prior.inverse() @ pose).inverse()
    shift = motion.apply(problem.pivot) - problem.pivot
    return problem.tables.lattice.nearest((float(shift[0]), float(shift[1]), motion.theta))
