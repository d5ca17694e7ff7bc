"""Many slices by one compiled call: what a slice costs besides its search is paid once."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bimfit.config import Bound, SearchConfig
from bimfit.geometry.pose import Array, Pose2D
from bimfit.registration import _kernels as kernels
from bimfit.registration import grcsm
from bimfit.registration.fitness import INLIER_SIGMAS
from bimfit.registration.lattice import Lattice
from bimfit.registration.result import Stop
from bimfit.registration.table import BLUR_REACH, Tables, Target

_STOPS: dict[int, Stop] = {kernels.DONE: "proven", kernels.TOLERANCE: "tolerance", kernels.BUDGET: "budget"}


@dataclass(frozen=True)
class Found:
    """What a slice's search found, in the terms of the lattice.

    Attributes
    ----------
    kept : int
        Points that some pose of the window brings near the model; under three, nothing was searched.
    index : tuple of 3 int
        The best leaf (u, v, theta).
    pivot : tuple of 2 float
        What the data turned about, m.
    score, bound : int
        In steps of weight times table value.
    share, rmse : float
        Of the points within three blurs of the model: their share, and root mean square distance (m).
    """

    kept: int
    index: tuple[int, int, int]
    pivot: tuple[float, float]
    score: int
    bound: int
    evaluations: int
    stop: Stop
    share: float
    rmse: float
    lattice: Lattice


def search_slices(
    target: Target,
    slices: Sequence[Array],
    priors: Sequence[Pose2D],
    config: SearchConfig,
    bound: Bound,
    weights: NDArray[np.uint64],
    unit: float,
    incumbents: Sequence[Pose2D | None] | None = None,
    threads: int = 1,
) -> list[Found]:
    """Search every slice's window; the outcome does not depend on the number of threads.

    Parameters
    ----------
    slices : sequence of ndarray, shape (n, 2)
        Points, contiguous float64.
    weights : ndarray of uint64
        Steps a point, all slices' one after the other; empty for unit weights.
    unit : float
        Score of one step.
    incumbents : sequence of Pose2D or None, optional
        A pose to begin with, a slice.
    """
    count = len(slices)
    share = max(1, -(-count // (2 * threads))) if threads > 1 else count
    ends = [0, *itertools.accumulate(len(points) for points in slices)]
    parts = [(k, min(k + share, count)) for k in range(0, count, share)]

    def work(part: tuple[int, int]) -> list[Found]:
        a, b = part
        own = weights[ends[a] : ends[b]] if len(weights) else weights
        hints = None if incumbents is None else incumbents[a:b]
        return _search(target, slices[a:b], priors[a:b], config, bound, own, unit, hints)

    if len(parts) <= 1 or threads == 1:
        return [found for part in parts for found in work(part)]
    with ThreadPoolExecutor(threads) as pool:
        return [found for done in pool.map(work, parts) for found in done]


def _search(
    target: Target, slices: Sequence[Array], priors: Sequence[Pose2D], config: SearchConfig, bound: Bound,
    weights: NDArray[np.uint64], unit: float, incumbents: Sequence[Pose2D | None] | None,
) -> list[Found]:  # fmt: skip
    count, lattice = len(slices), grcsm.lattice_of(target, config, bound)
    points = slices[0] if count == 1 else np.concatenate(slices)
    ends = np.array(list(itertools.accumulate(map(len, slices))), np.int64)
    motions = np.array([_back(prior) for prior in priors])
    hints = np.empty((count, 3))
    hints.fill(np.nan)
    for i, pose in enumerate(incumbents or ()):
        if pose is not None:
            hints[i] = pose.u, pose.v, pose.theta
    ints, reals = np.zeros((count, 6), np.int64), np.zeros((count, 5))
    longest = max(map(len, slices))
    begin, reach = 0, 0.0
    prior, prior_at, has_prior = grcsm.prior_table(config, lattice, unit)
    limit = config.max_evaluations if config.max_evaluations is not None else 1 << 60
    while begin < count:
        tables = target.tables(lattice, bound, reach)
        plan, work = grcsm.workspace(tables, longest + kernels.PAD)
        options = np.array(
            [0, plan.first, lattice.top, 0, limit, 1 << 60, 0, 0, has_prior, 0, plan.lowest], np.int64
        )
        # only the slice that asked for them has the tables that reach farther
        end = begin + 1 if reach > 0.0 else count
        begin = kernels.match_run(
            begin, points, ends[:end], motions, weights, hints, _frame(target, tables, config), target.edges,
            options, tables.model, prior, prior_at, work.scratch, ints, reals,
        )  # fmt: skip
        reach = 0.0
        if begin < end:
            if ints[begin, kernels.HOW] == kernels.HEAP_FULL:
                work.grow("keys", "codes")
            if reals[begin, kernels.REACH] > target.tables(lattice, bound, 0.0).reach:
                reach = float(reals[begin, kernels.REACH])
    return [_found(a, b, lattice) for a, b in zip(ints.tolist(), reals.tolist(), strict=True)]


def _near(target: Target, lattice: Lattice) -> tuple[float, ...]:
    """Box of what can be met, how far a window shifts a point and swings a unit of radius, least points."""
    margin = BLUR_REACH * target.blur + lattice.step[0] + lattice.step[1]
    low_u, low_v, high_u, high_v = target.box
    shift = math.hypot(lattice.half[0], lattice.half[1])
    swing = 2.0 * math.sin(0.5 * min(lattice.half[2], math.pi))
    return (
        low_u - margin, low_v - margin, high_u + margin, high_v + margin, shift, swing,
        float(grcsm.MIN_POINTS),
    )  # fmt: skip


def _frame(target: Target, tables: Tables, config: SearchConfig) -> Array:
    """After :func:`_near`: reach, first motions u and v, the tables' corner, eps, inliers, first angle."""
    frame = tables.frames.get(config.eps)
    if frame is None:
        first, origin = tables.lattice.first, tables.origin
        frame = np.array(
            [
                *_near(target, tables.lattice), tables.reach, first[0], first[1], float(origin[0]),
                float(origin[1]), config.eps, INLIER_SIGMAS * target.blur, first[2],
            ]
        )  # fmt: skip
        tables.frames[config.eps] = frame
    return frame


def _back(prior: Pose2D) -> tuple[float, float, float, float]:
    """The prior's inverse: cosine, sine and shift."""
    c, s = math.cos(prior.theta), math.sin(prior.theta)
    return c, -s, -c * prior.u - s * prior.v, s * prior.u - c * prior.v


def _found(ints: list[int], reals: list[float], lattice: Lattice) -> Found:
    how, score, bound, leaf, work, kept = ints
    pivot_u, pivot_v, _, share, rmse = reals
    stop = _STOPS.get(how, "proven")
    return Found(kept, grcsm.unpack(leaf), (pivot_u, pivot_v), score, bound, work, stop, share, rmse, lattice)
