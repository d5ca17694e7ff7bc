"""The matcher suite: time, evaluations and failures of every matcher on the same slices, one thread."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bimfit.config import SearchConfig
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Slice
from bimfit.registration.matchers import MATCHERS, match_many
from bimfit.registration.result import MatchResult
from bimfit.registration.table import Tables, Target

Job = tuple[Target, Slice, Pose2D]
SAME = 1e-9  # scores closer than this are equal


@dataclass(frozen=True)
class BenchRow:
    """One line of the published table.

    Attributes
    ----------
    suite, name : str
        What was measured.
    slices : int
        Over how many matches.
    median_ms, p95_ms : float
        Wall time of a match, all of it but building tables.
    evaluations : float
        Median number of bounds and scores.
    proven : float
        Share of matches with a proven optimum.
    missed : float
        Share whose score is under that of the proven search; NaN where there is nothing to compare.
    off_10mm : float
        Share more than 10 mm from the truth; NaN where no truth is known.
    vs_icp : float
        Median time over that of point-to-point ICP on the same slices in the same run.
    """

    suite: str
    name: str
    slices: int
    median_ms: float
    p95_ms: float
    evaluations: float = float("nan")
    proven: float = float("nan")
    missed: float = float("nan")
    off_10mm: float = float("nan")
    vs_icp: float = float("nan")


def time_matches(name: str, jobs: Sequence[Job], config: SearchConfig) -> tuple[list[MatchResult], Array]:
    """Run one matcher over jobs: results and wall times (s). Tables are built before."""
    method = MATCHERS[name]
    for first in {id(job[0]): job for job in jobs}.values():
        method(*first, config)
    results, seconds = [], []
    for target, slice_, prior in jobs:
        started = time.perf_counter()
        results.append(method(target, slice_, prior, config))
        seconds.append(time.perf_counter() - started)
    return results, np.array(seconds)


def bench_methods(
    target: Target,
    slices: Sequence[Slice],
    config: SearchConfig,
    methods: Sequence[str] = ("grcsm", "overlap", "mrcsm", "block", "icp-point", "icp-plane", "brute"),
    *,
    starts: Sequence[Pose2D] | None = None,
    truth: Sequence[Pose2D] | None = None,
    most: dict[str, int] | None = None,
) -> list[BenchRow]:
    """Every method over the same slices.

    Parameters
    ----------
    target : Target
    slices : sequence of Slice
    config : SearchConfig
    methods : sequence of str
        Names in ``MATCHERS``; ``grcsm`` is what the others' misses are counted against.
    starts : sequence of Pose2D, optional
        Where ICP starts, one a slice (the search's prior is the designed pose); default: the designed pose.
    truth : sequence of Pose2D, optional
        As-built poses of the model, compared at the section's origin.
    most : dict of str to int, optional
        Fewer slices for slow methods, such as ``{"brute": 5}``.
    """
    rows = []
    reference: list[MatchResult] | None = None
    for name in methods:
        count = min(len(slices), (most or {}).get(name, len(slices)))
        from_start = starts is not None and "icp" in name
        priors = list(starts)[:count] if from_start and starts is not None else [Pose2D()] * count
        jobs = [(target, s, p) for s, p in zip(slices[:count], priors, strict=True)]
        results, seconds = time_matches(name, jobs, config)
        if name == "grcsm":
            reference = results
        missed = float("nan")
        if reference is not None and name in ("grcsm", "overlap", "block", "brute"):
            pairs = zip(results, reference[:count], strict=True)
            missed = float(np.mean([r.score < best.score - SAME for r, best in pairs]))
        rows.append(_row("matcher", name, results, seconds, missed, truth))
    icp = [row.median_ms for row in rows if row.name == "icp-point"]
    return [dataclasses.replace(row, vs_icp=row.median_ms / icp[0]) for row in rows] if icp else rows


def bench_growth(
    target: Target,
    slices: Sequence[Slice],
    config: SearchConfig,
    *,
    windows: Sequence[float] = (0.03, 0.1215, 0.243),
    angles: Sequence[float] = (0.1047, 0.7854, 3.1416),
    tolerances: Sequence[float] = (0.001, 0.0005, 0.00025),
    points: Sequence[int] = (50, 171, 500, 2000),
    seed: int = 0,
) -> list[BenchRow]:
    """How the proven search grows with the window, the angle, the tolerance and the number of points.

    Points are resampled from each slice with replacement, with half a millimetre of seeded noise.
    """
    w, t = config.window, config.tolerance
    cases = [(f"window +-{x * 1e3:g} mm", dataclasses.replace(config, window=(x, x, w[2]))) for x in windows]
    cases += [
        (f"angle +-{np.degrees(x):.0f} deg", dataclasses.replace(config, window=(*w[:2], min(x, np.pi))))
        for x in angles
    ]
    cases += [
        (f"tolerance {x * 1e3:g} mm", dataclasses.replace(config, tolerance=(x, x, t[2]))) for x in tolerances
    ]
    rows = [_growth_row(name, target, slices, setting) for name, setting in cases]
    rng = np.random.default_rng(seed)
    for count in points:
        many = []
        for s in slices:
            drawn = s.points[np.sort(rng.integers(0, len(s.points), count))]
            many.append(dataclasses.replace(s, points=drawn + rng.normal(0.0, 5e-4, drawn.shape), beams=None))
        rows.append(_growth_row(f"{count} points", target, many, config))
    return rows


@dataclass(frozen=True)
class Exactness:
    """The proven search against every pose of the window, over the same slices.

    ``scores_differ`` and ``poses_differ`` count slices; times are medians, ms.
    """

    slices: int
    scores_differ: int
    poses_differ: int
    search_ms: float
    brute_ms: float


def bench_exactness(target: Target, slices: Sequence[Slice], config: SearchConfig) -> Exactness:
    """Compare with brute force, score and pose."""
    jobs = [(target, s, Pose2D()) for s in slices]
    found, fast = time_matches("grcsm", jobs, config)
    best, slow = time_matches("brute", jobs, config)
    pairs = list(zip(found, best, strict=True))
    return Exactness(
        len(slices), sum(a.score != b.score for a, b in pairs),
        sum(not np.array_equal(a.parameters, b.parameters) for a, b in pairs),
        float(np.median(fast) * 1e3), float(np.median(slow) * 1e3),
    )  # fmt: skip


@dataclass(frozen=True)
class Threading:
    """How many times faster threads were than one, and how many processors the machine let them have."""

    ratio: float
    processors: float


def bench_threads(
    target: Target, slices: Sequence[Slice], config: SearchConfig, threads: int = 2
) -> Threading:
    """How many times faster threads go through the slices than one thread does (``match_many``).

    Where the processors given are fewer than the threads, the machine is busy and the ratio says little.
    """
    priors = [Pose2D()] * len(slices)
    match_many(target, slices, priors, config, threads=threads)

    def run(workers: int) -> tuple[float, float]:
        started, used = time.perf_counter(), time.process_time()
        match_many(target, slices, priors, config, threads=workers)
        wall = time.perf_counter() - started
        return wall, (time.process_time() - used) / wall

    # in turns, so that both meet the same load
    pairs = [(run(1), run(threads)) for _ in range(5)]
    wall, processors = min(b for _, b in pairs)
    return Threading(min(a for a, _ in pairs)[0] / wall, processors)


def table_figures(target: Target) -> list[dict[str, object]]:
    """Memory and building time of every set of tables that a target holds."""
    return [
        {
            "bound": t.bound, "levels": t.lattice.levels, "tests": t.lattice.tests,
            "cells": t.leaf.shape, "mebibytes": t.nbytes / 2**20, "build_seconds": t.seconds,
        }
        for t in target.kept.values() if isinstance(t, Tables)
    ]  # fmt: skip


def _growth_row(name: str, target: Target, slices: Sequence[Slice], config: SearchConfig) -> BenchRow:
    results, seconds = time_matches("grcsm", [(target, s, Pose2D()) for s in slices], config)
    return _row("growth", name, results, seconds, float("nan"), None)


def _row(
    suite: str,
    name: str,
    results: Sequence[MatchResult],
    seconds: Array,
    missed: float,
    truth: Sequence[Pose2D] | None,
) -> BenchRow:
    off = float("nan")
    if truth is not None:
        errors = [
            np.hypot(r.parameters[0] - p.u, r.parameters[1] - p.v) if r.found else np.inf
            for r, p in zip(results, truth[: len(results)], strict=True)
        ]
        off = float(np.mean(np.array(errors) > 0.01))
    return BenchRow(
        suite, name, len(results), float(np.median(seconds) * 1e3), float(np.percentile(seconds, 95) * 1e3),
        float(np.median([r.evaluations for r in results])),
        float(np.mean([r.stop == "proven" for r in results])), missed, off,
    )  # fmt: skip
