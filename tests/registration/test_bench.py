"""The bench's rows say what happened."""

import math

import numpy as np

from bimfit.config import SearchConfig
from bimfit.geometry.pose import Pose2D
from bimfit.registration.bench import (
    bench_exactness,
    bench_growth,
    bench_methods,
    bench_threads,
    table_figures,
)
from bimfit.registration.table import Target

SMALL = SearchConfig(window=(0.02, 0.015, math.radians(6)), tolerance=(0.002, 0.002, math.radians(0.6)))


def test_rows_agree_with_one_another(scenes):
    made = scenes.make_slices(4, seed=1, each=(0, 0, 0), common=(0.01, 0.01, 0.05))
    slices, truth = [m[0] for m in made], [m[1] for m in made]
    target = Target.of(scenes.boards_edges(), 0.006)
    starts = [Pose2D(1.0, 0.0, 0.0)] * 4  # a metre off: ICP has nothing to match
    methods = ("grcsm", "overlap", "block", "icp-point", "brute")
    made_rows = bench_methods(target, slices, SMALL, methods, starts=starts, truth=truth, most={"brute": 2})
    rows = {r.name: r for r in made_rows}
    assert all(rows[name].missed == 0.0 for name in ("grcsm", "overlap", "brute"))
    assert 0.0 <= rows["block"].missed <= 1.0 and rows["block"].proven == 0.0
    assert rows["brute"].slices == 2 and rows["brute"].evaluations == 27**3
    assert rows["icp-point"].off_10mm == 1.0 and rows["grcsm"].off_10mm == 0.0
    assert all(r.median_ms <= r.p95_ms for r in rows.values())
    assert rows["icp-point"].vs_icp == 1.0 and rows["grcsm"].vs_icp > 0.0
    exact = bench_exactness(target, slices, SMALL)
    assert (exact.slices, exact.scores_differ, exact.poses_differ) == (4, 0, 0)
    figures = table_figures(target)
    assert {f["bound"] for f in figures} == {"majorant", "overlap", "block"}
    assert all(f["mebibytes"] > 0 for f in figures)


def test_growth_and_threads_run_over_the_same_slices(scenes):
    slices = [m[0] for m in scenes.make_slices(3, seed=2)]
    target = Target.of(scenes.boards_edges(), 0.006)
    rows = bench_growth(
        target, slices, SMALL, windows=(0.01, 0.02), angles=(0.05,), tolerances=(0.002,), points=(50, 300)
    )
    assert [r.name for r in rows] == [
        "window +-10 mm", "window +-20 mm", "angle +-3 deg", "tolerance 2 mm", "50 points", "300 points",
    ]  # fmt: skip
    assert all(r.proven == 1.0 for r in rows)
    both = bench_threads(target, slices, SMALL, 2)
    assert np.isfinite(both.ratio) and both.processors > 0.0
