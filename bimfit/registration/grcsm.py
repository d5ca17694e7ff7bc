"""GRCSM: the best-scoring pose of a window, proven (paper, section 4.4; METHOD, section 3)."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bimfit.config import Bound, SearchConfig
from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array, Pose2D
from bimfit.registration import _kernels as kernels
from bimfit.registration.lattice import Integers, Lattice
from bimfit.registration.result import Stop
from bimfit.registration.table import BLUR_REACH, Tables, Target

MIN_POINTS = 3
WEIGHT_STEPS = 255  # unequal weights are rounded to this many steps of the greatest
ROOT_COST = 40_000.0  # table rows that the first level may cost
TIME_SLICE = 20_000  # evaluations between two looks at the clock
NOTHING = kernels.NOTHING


@dataclass(frozen=True)
class Problem:
    """One slice against one target, in the kernels' terms.

    Attributes
    ----------
    tables : Tables
    pivot : ndarray, shape (2,)
        The data turn about it, m.
    pu, pv : ndarray, shape (n,)
        Points about the pivot, in cells.
    weight : ndarray of uint64, shape (n,)
    unit : float
        Score that one step of weight times table value stands for.
    start : ndarray, shape (5,)
        Pivot's cell coordinates, ratios of the cell's sides, eps.
    """

    tables: Tables
    pivot: Array
    pu: Array
    pv: Array
    weight: NDArray[np.uint64]
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
        return max(1, kernels.LANE_SUM // (kernels.FULL * int(self.weight.max(initial=1))))


def pose_problem(
    target: Target, points: Array, weights: ArrayLike | None, config: SearchConfig, bound: Bound
) -> Problem | None:
    """Bring a slice, already carried by the prior's inverse, into the kernels' terms.

    Points that no pose of the window brings near the model score 0 everywhere and are left out. None
    when fewer than three are left.

    Raises
    ------
    ConfigError
        When the weights do not suit the points.
    """
    lattice = Lattice.of(config)
    w, unit, rounding = _weights(weights, len(points))
    margin = BLUR_REACH * target.blur + lattice.step[0] + lattice.step[1]
    low, high = target.edges.min(axis=(0, 1)) - margin, target.edges.max(axis=(0, 1)) + margin
    off = np.maximum(np.maximum(low - points, points - high), 0.0)
    far = np.sqrt(off[:, 0] ** 2 + off[:, 1] ** 2)
    shift = math.hypot(lattice.half[0], lattice.half[1])
    near = points[far <= shift]
    if len(near) == 0:
        near = points
    pivot = 0.5 * (near.min(axis=0) + near.max(axis=0))
    arm = points - pivot
    radius = np.sqrt(arm[:, 0] ** 2 + arm[:, 1] ** 2)
    keep = far <= shift + 2.0 * math.sin(0.5 * min(lattice.half[2], math.pi)) * radius
    if not keep.all():
        arm, radius, w = arm[keep], radius[keep], w[keep]
    if len(arm) < MIN_POINTS:
        return None
    tables = target.tables(lattice, bound, float(radius.max()))
    step_u, step_v = lattice.step[0], lattice.step[1]
    start = np.array(
        [
            (pivot[0] + lattice.first[0] - tables.origin[0]) / step_u,
            (pivot[1] + lattice.first[1] - tables.origin[1]) / step_v,
            step_v / step_u,
            step_u / step_v,
            config.eps,
        ]
    )
    pu, pv = np.ascontiguousarray(arm[:, 0] / step_u), np.ascontiguousarray(arm[:, 1] / step_v)
    return Problem(tables, pivot, pu, pv, np.ascontiguousarray(w), unit, start, rounding)


def _weights(weights: ArrayLike | None, n: int) -> tuple[NDArray[np.uint64], float, float]:
    if weights is None:
        return np.ones(n, np.uint64), 1.0 / kernels.FULL, 0.5 * n / kernels.FULL
    values = np.asarray(weights, float)
    if values.shape != (n,) or not np.all(np.isfinite(values)) or np.any(values < 0.0):
        raise ConfigError(f"weights are {n} numbers of at least 0, one a point")
    top = float(values.max(initial=0.0))
    if top == 0.0:
        raise ConfigError("all weights are 0")
    whole = np.rint(values * (WEIGHT_STEPS / top))
    rounding = float(0.5 * values.sum() / kernels.FULL + 0.5 * n * top / WEIGHT_STEPS)
    return whole.astype(np.uint64), top / (WEIGHT_STEPS * kernels.FULL), rounding


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


class Workspace:
    """Scratch arrays of one thread, grown as needed and used again."""

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[Any]] = {}

    def get(self, name: str, size: int, kind: type[np.generic]) -> NDArray[Any]:
        """An array of at least ``size``, its content unspecified."""
        array = self._arrays.get(name)
        if array is None or len(array) < size:
            array = np.empty(max(size, 16), kind)
            self._arrays[name] = array
        return array

    def grow(self, name: str, kept: int) -> NDArray[Any]:
        """Double an array, keeping its first ``kept`` values."""
        old = self._arrays[name]
        array = np.empty(2 * len(old), old.dtype)
        array[:kept] = old[:kept]
        self._arrays[name] = array
        return array


_LOCAL = threading.local()


def _workspace() -> Workspace:
    if not hasattr(_LOCAL, "workspace"):
        _LOCAL.workspace = Workspace()
    work: Workspace = _LOCAL.workspace
    return work


def first_level(lattice: Lattice, n: int, lowest: int) -> int:
    """The level that the search starts on: the finest whose nodes are all cheap to bound."""
    best = lattice.top
    for level in range(lattice.top, max(lowest, 1) - 1, -1):
        nodes = lattice.nodes[level]
        if float(nodes[2]) * n * min(12.0, float(nodes[1])) * (1.0 + nodes[0] / 8.0) > ROOT_COST:
            break
        best = level
    return best


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
    work = _workspace()
    top, nodes, size = lattice.top, lattice.nodes, lattice.size
    affine_levels = np.flatnonzero(tables.affine_place[:, 4] >= 0)
    first = first_level(lattice, n, int(affine_levels.max(initial=1)))
    roots = int(nodes[first].prod())
    fan = max(int((size[h] // size[h - 1]).prod()) for h in range(1, top + 1)) if top else 1
    prior, prior_at, has_prior = prior_table(config, lattice, problem.unit)
    slots = np.concatenate([[0], np.cumsum(nodes[:, 2])])[:-1].astype(np.int64)
    n_slots = int(nodes[:, 2].sum())
    classes = work.get("classes", (top + 1) * n, np.uint8)
    kernels.point_classes(
        n,
        problem.pu,
        problem.pv,
        lattice.step[0],
        lattice.step[1],
        lattice.half_angle,
        tables.class_of,
        classes,
    )
    angles = lattice.count[2]
    cu, cv = work.get("cu", angles * n, np.int32), work.get("cv", angles * n, np.int32)
    have, near_have = work.get("have", angles, np.uint8), work.get("near_have", n_slots, np.uint8)
    have[:angles] = 0
    near_have[:n_slots] = 0
    list_counts = work.get("list_counts", n_slots, np.int32)
    list_counts[:n_slots] = -1
    lists = work.get("lists", 4 * n_slots * n, np.int32)
    lists = lists[: 4 * n_slots * n].reshape(4, n_slots * n)
    near = work.get("near", int(nodes[affine_levels, 2].sum()) * n + 1, np.uint8)
    gu, gv = work.get("gu", n, np.int32), work.get("gv", n, np.int32)
    box = work.get("box", max(int(nodes[first, 0] * nodes[first, 1]), fan) + 4, np.int64)
    root = work.get("root", roots, np.int64)
    keys = work.get("keys", roots + (top + 2) * fan + 1024, np.int64)
    codes = work.get("codes", len(keys), np.int64)
    found = work.get("found", max(1024, 2 * fan), np.int64)
    values = work.get("values", len(found), np.int64)
    if len(codes) < len(keys):
        codes = work.get("codes", len(keys), np.int64)
    state = np.zeros(kernels.STATE_SIZE, np.int64)
    state[kernels.BEST], state[kernels.BEST_CODE] = NOTHING, 0
    if incumbent is not None:
        state[kernels.BEST], state[kernels.BEST_CODE] = _leaf_score(
            problem, incumbent, prior, prior_at, has_prior
        )
    limit = config.max_evaluations if config.max_evaluations is not None else 1 << 60
    options = np.array(
        [n, first, top, problem.chunk, limit, TIME_SLICE if deadline is not None else 1 << 60,
         collect_from is not None, collect_from or 0, has_prior], np.int64,
    )  # fmt: skip
    while True:
        ended = kernels.search(
            options, problem.pu, problem.pv, problem.weight, problem.start, tables.cosine, tables.sine, size,
            nodes, tables.lanes, tables.blocks, tables.block_place, tables.affine, tables.affine_place,
            tables.class_of, classes, slots, prior, prior_at, cu, cv, have, lists, list_counts, near,
            near_have, gu, gv, box, root, keys, codes, found, values, state,
        )  # fmt: skip
        if ended == kernels.HEAP_FULL:
            kept = int(state[kernels.HEAP])
            keys, codes = work.grow("keys", kept), work.grow("codes", kept)
        elif ended == kernels.FOUND_FULL:
            kept = int(state[kernels.FOUND])
            found, values = work.grow("found", kept), work.grow("values", kept)
        elif (
            ended != kernels.BUDGET
            or state[kernels.EVALUATIONS] >= limit
            or (deadline is not None and time.perf_counter() >= deadline)
        ):
            break
    count = int(state[kernels.FOUND])
    stop: Stop = {kernels.DONE: "proven", kernels.TOLERANCE: "tolerance"}.get(ended, "budget")
    return Outcome(
        int(state[kernels.BEST]), int(state[kernels.BOUND]), unpack(int(state[kernels.BEST_CODE])),
        int(state[kernels.EVALUATIONS]), stop, (found[:count].copy(), values[:count].copy()),
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
    cu, cv, out = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(1, np.int64)
    angle = slice(index[2], index[2] + 1)
    kernels.fill_cells(
        0, n, problem.pu, problem.pv, tables.cosine[angle], tables.sine[angle], problem.start, cu, cv
    )
    kernels.score_box(
        0, n, cu, cv, problem.weight, problem.chunk, tables.lanes, index[1], 1, index[0], 1, out
    )
    value = int(out[0])
    if has_prior:
        value += int(sum(prior[prior_at[0, axis] + index[axis]] for axis in range(3)))
    return value, (index[2] << (2 * kernels.SHIFT_NODE)) | (index[1] << kernels.SHIFT_NODE) | index[0]


def pose_of(problem: Problem, index: tuple[int, int, int], prior: Pose2D) -> Pose2D:
    """Motion of the model that a leaf stands for: the leaf moves the data, so it is inverted."""
    u, v, theta = problem.tables.lattice.motion(index)
    return prior @ Pose2D.about(problem.pivot, u, v, theta).inverse()


def leaf_of(problem: Problem, pose: Pose2D, prior: Pose2D) -> tuple[int, int, int] | None:
    """The leaf nearest to a motion of the model, or None outside the window."""
    motion = (prior.inverse() @ pose).inverse()
    shift = motion.apply(problem.pivot) - problem.pivot
    return problem.tables.lattice.nearest((float(shift[0]), float(shift[1]), motion.theta))
