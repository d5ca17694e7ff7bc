"""Every matcher on the reference scene: truth, brute force, budgets, modes, threads, failures as values."""

import dataclasses
import math
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from bimfit.config import SearchConfig
from bimfit.errors import ConfigError
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.slice import Slice
from bimfit.registration.fitness import fitness_of
from bimfit.registration.lattice import Lattice
from bimfit.registration.matchers import MATCHERS, match, match_many, matcher
from bimfit.registration.table import Target

SMALL = SearchConfig(window=(0.02, 0.015, math.radians(6)), tolerance=(0.002, 0.002, math.radians(0.6)))
PLANAR = ("grcsm", "overlap", "mrcsm", "brute")


@pytest.fixture(scope="module")
def target(scenes):
    return Target.of(scenes.boards_edges(), 0.006)


def same(a, b):
    skip = ("seconds", "modes")
    for field in dataclasses.fields(a):
        if field.name not in skip:
            assert np.array_equal(
                getattr(a, field.name), getattr(b, field.name), equal_nan=field.name == "parameters"
            )


@pytest.mark.parametrize("s", [2, 3, 4, 5])
@pytest.mark.parametrize("bound", ["majorant", "overlap"])
def test_the_search_finds_what_brute_force_finds(target, scenes, s, bound):
    config = dataclasses.replace(SMALL, tests_per_level=s, bound=bound)
    for slice_, *_ in scenes.make_slices(4, seed=s):
        found, best = (
            match(target, slice_, Pose2D(), config),
            MATCHERS["brute"](target, slice_, Pose2D(), config),
        )
        assert found.score == best.score
        assert np.array_equal(found.parameters, best.parameters)
        assert found.stop == "proven" and found.gap == 0.0


def test_axes_may_differ_in_tests_and_levels(target, scenes):
    config = dataclasses.replace(SMALL, axis_tests=(3, 2, 4), axis_levels=(3, 2, 1))
    ((slice_, *_),) = scenes.make_slices(1, seed=9)
    found, best = match(target, slice_, Pose2D(), config), MATCHERS["brute"](target, slice_, Pose2D(), config)
    assert found.levels == (3, 2, 1) and best.evaluations == 27 * 4 * 4
    assert found.score == best.score and np.array_equal(found.parameters, best.parameters)


@pytest.mark.parametrize("window", [(0.02, 0.02, 0.0), (0.0, 0.0, 0.2), (0.0, 0.03, 0.0), (0.0, 0.0, 0.0)])
def test_an_axis_may_be_left_out(target, scenes, window):
    config = dataclasses.replace(SMALL, window=window)
    ((slice_, *_),) = scenes.make_slices(1, seed=2)
    found, best = match(target, slice_, Pose2D(), config), MATCHERS["brute"](target, slice_, Pose2D(), config)
    assert found.score == best.score and np.array_equal(found.parameters, best.parameters)


@pytest.mark.parametrize("name", [*PLANAR, "block", "icp-point", "icp-plane", "icp-plane-robust", "g-icp"])
def test_a_clean_scan_is_carried_back(scenes, name):
    """Points sampled on the moved model: applying the pose to the model must put it on them."""
    edges = scenes.boards_edges()
    truth = Pose2D(0.012, -0.009, math.radians(3.0))
    t = np.linspace(0.02, 0.98, 40)[:, None]
    points = np.concatenate([truth.apply(a + t * (b - a)) for a, b in edges])
    prior = Pose2D(0.008, -0.004, math.radians(1.0))
    found = MATCHERS[name](Target.of(edges, 0.003), Slice(0.0, points), prior, SMALL)
    assert found.status.name == "ok"
    # compare where the joint is, not where the turned origin happens to be
    reach = 2.5e-3 if name not in ("block", "icp-point") else 6e-3
    assert np.allclose(
        found.pose.apply([[-0.0125, 0.0], [0.0125, 0.0]]),
        truth.apply([[-0.0125, 0], [0.0125, 0]]),
        atol=reach,
    )
    assert found.pose.theta == pytest.approx(truth.theta, abs=math.radians(0.7))
    assert found.fitness > 0.95 and found.inlier_rmse < 0.003


def test_the_full_window_is_proven_and_near_the_truth(target, scenes):
    for slice_, whole, _ in scenes.make_slices(6, seed=5, each=(0, 0, 0)):
        found = match(target, slice_, Pose2D(), SearchConfig())
        assert found.stop == "proven" and found.levels == (5, 5, 5)
        assert np.linalg.norm(found.parameters[:2] - (whole.u, whole.v)) < 0.008
        assert found.evaluations < 243**3 / 100
        old = MATCHERS["block"](target, slice_, Pose2D(), SearchConfig())
        assert old.stop == "unproven" and old.score <= found.score


def test_prior_pose_and_data_may_move_together(target, scenes):
    """The window rides on the prior: the same data and prior carried elsewhere give the same score."""
    ((slice_, *_),) = scenes.make_slices(1, seed=6)
    away = Pose2D(3.0, -2.0, math.radians(140))
    here = match(target, slice_, Pose2D(), SMALL)
    there = match(target, Slice(0.0, away.apply(slice_.points)), away, SMALL)
    assert there.score == pytest.approx(here.score, abs=0.02 * here.score)  # cells may flip in the last bit
    assert np.allclose((away.inverse() @ there.pose).as_array(), here.parameters, atol=2.1e-3)


def test_far_points_cost_nothing_and_change_nothing(target, scenes):
    ((slice_, *_),) = scenes.make_slices(1, seed=7)
    far = np.array([[4.0, 1.0], [-3.0, 5.0], [np.nan, 0.0]])
    same_pose = match(target, Slice(0.0, np.concatenate([slice_.points, far])), Pose2D(), SMALL)
    assert np.array_equal(same_pose.parameters, match(target, slice_, Pose2D(), SMALL).parameters)


def test_weights_count_as_repeats(target, scenes):
    ((slice_, *_),) = scenes.make_slices(1, seed=8)
    n = len(slice_.points)
    twice = np.where(np.arange(n) % 3 == 0, 2.0, 1.0)
    repeated = Slice(0.0, np.repeat(slice_.points, twice.astype(int), axis=0))
    found = match(target, slice_, Pose2D(), SMALL, weights=twice)
    assert np.array_equal(found.parameters, match(target, repeated, Pose2D(), SMALL).parameters)
    assert found.score == pytest.approx(
        match(target, repeated, Pose2D(), SMALL).score, abs=found.quantisation
    )
    with pytest.raises(ConfigError):
        match(target, slice_, Pose2D(), SMALL, weights=np.ones(n + 1))


def test_an_incumbent_saves_work_and_changes_nothing(target, scenes):
    ((slice_, *_),) = scenes.make_slices(1, seed=9)
    cold = match(target, slice_, Pose2D(), SearchConfig())
    warm = match(target, slice_, Pose2D(), SearchConfig(), incumbent=cold.pose)
    assert np.array_equal(warm.parameters, cold.parameters) and warm.score == cold.score
    assert warm.evaluations <= cold.evaluations
    outside = match(target, slice_, Pose2D(), SearchConfig(), incumbent=Pose2D(5.0, 0.0, 0.0))
    assert np.array_equal(outside.parameters, cold.parameters)


def test_budgets_and_eps_leave_a_true_gap(target, scenes):
    ((slice_, *_),) = scenes.make_slices(1, seed=10)
    best = match(target, slice_, Pose2D(), SearchConfig()).score
    for limit in (1, 20_000, 25_000):
        cut = match(target, slice_, Pose2D(), SearchConfig(max_evaluations=limit))
        assert cut.score <= best <= cut.bound
    near = match(target, slice_, Pose2D(), SearchConfig(eps=0.05))
    assert near.stop in ("tolerance", "proven") and best <= near.bound <= 1.05 * near.score + 1e-9
    late = match(target, slice_, Pose2D(), SearchConfig(time_budget=1e-9, bound="overlap"))
    assert late.stop == "budget" and late.bound > late.score
    long = match(target, slice_, Pose2D(), SearchConfig(time_budget=60.0))
    assert long.stop == "proven" and long.score == best


@pytest.mark.parametrize("blur", [0.003, 0.006])
def test_the_full_window_equals_brute_force(scenes, blur):
    """All 14 million poses of the paper's window; the bench shows it over many slices."""
    sharp = Target.of(scenes.boards_edges(), blur)
    for slice_, *_ in scenes.make_slices(2, seed=13):
        found = match(sharp, slice_, Pose2D(), SearchConfig())
        best = MATCHERS["brute"](sharp, slice_, Pose2D(), SearchConfig())
        assert found.score == best.score and np.array_equal(found.parameters, best.parameters)


def test_many_slices_at_once_are_as_one_by_one(scenes):
    """A target of its own: tables must grow when a later slice reaches farther than the first did."""
    slices = [s for s, *_ in scenes.make_slices(6, seed=14)]
    near = np.abs(slices[0].points[:, 0]) < 0.03
    slices[0] = dataclasses.replace(slices[0], points=slices[0].points[near])
    holes = slices[1].points.copy()
    holes[::4] = np.nan
    slices[1] = dataclasses.replace(slices[1], points=holes)
    slices[2:2] = [Slice(0.0, np.zeros((0, 2))), Slice(0.0, np.full((30, 2), 50.0))]
    priors = [Pose2D(0.001 * k, 0.0, 0.01 * k) for k in range(len(slices))]
    fresh = Target.of(scenes.boards_edges(), 0.006)
    alone = [match(fresh, s, p, SearchConfig()) for s, p in zip(slices, priors, strict=True)]
    assert [r.status.name for r in alone] == ["ok", "ok", "no_data", "no_data", "ok", "ok", "ok", "ok"]
    for threads in (1, 2, 3):
        other = Target.of(scenes.boards_edges(), 0.006)
        many = match_many(other, slices, priors, SearchConfig(), threads=threads)
        for a, b in zip(alone, many, strict=True):
            assert np.array_equal(a.parameters, b.parameters, equal_nan=True)
            assert (a.score == b.score or not a.found) and a.status == b.status and a.stop == b.stop
    weights = [1.0 + np.arange(len(s.points)) % 2 for s in slices]
    heavy = match_many(fresh, slices, priors, SearchConfig(), weights=weights, threads=2)
    for s, p, w, b in zip(slices, priors, weights, heavy, strict=True):
        a = match(fresh, s, p, SearchConfig(), weights=w)
        assert np.array_equal(a.parameters, b.parameters, equal_nan=True)


def test_the_pose_is_the_leafs_motion_undone(target, scenes):
    """The compiled pose against composed motions, with a prior that turns and shifts."""
    from bimfit.registration import grcsm

    lattice, prior, pivot = Lattice.of(SMALL), Pose2D(0.3, -0.2, 2.9), (0.05, -0.04)
    for index in ((0, 0, 0), (20, 3, 26), (13, 13, 13)):
        expected = prior @ Pose2D.about(pivot, *lattice.motion(index)).inverse()
        found = grcsm.pose_of(lattice, pivot, index, prior)
        assert np.allclose(found.as_array(), expected.as_array(), atol=1e-12)
    ((slice_, *_),) = scenes.make_slices(1, seed=15)
    found = match(target, slice_, Pose2D(), SMALL)
    assert (found.fitness, found.inlier_rmse) == pytest.approx(fitness_of(target, slice_.points, found.pose))


def test_rivals_are_reported_and_not_averaged():
    """Two equal faces 30 mm apart: the data fit either."""
    faces = np.array([[[-0.1, 0.0], [0.1, 0.0]], [[-0.1, 0.03], [0.1, 0.03]]])
    points = np.stack([np.linspace(-0.05, 0.05, 50), np.full(50, 0.015)], axis=1)
    config = SearchConfig(window=(0.0, 0.03, 0.0), delta=0.02)
    found = match(Target.of(faces, 0.003), Slice(0.0, points), Pose2D(), config)
    assert found.status.name == "ambiguous" and len(found.modes) == 1
    heights = sorted([found.pose.v, found.modes[0].pose.v])
    assert heights == pytest.approx([-0.015, 0.015], abs=1.1e-3)
    assert found.modes[0].score == pytest.approx(found.score, rel=0.02)
    one = match(Target.of(faces[:1], 0.003), Slice(0.0, points), Pose2D(), config)
    assert one.status.name == "ok" and one.modes == ()


def test_threads_give_the_same_bits(target, scenes):
    slices = [s for s, *_ in scenes.make_slices(12, seed=11)]
    alone = [match(target, s, Pose2D(), SearchConfig()) for s in slices]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda s: match(target, s, Pose2D(), SearchConfig()), slices))
    for a, b in zip(alone, together, strict=True):
        same(a, b)


@pytest.mark.parametrize("name", sorted(MATCHERS))
def test_a_failure_is_a_value(target, name):
    method = MATCHERS[name]
    for points in (np.zeros((0, 2)), np.zeros((2, 2)), np.full((30, 2), 50.0)):
        found = method(target, Slice(0.0, points), Pose2D(), SMALL)
        assert not found.found and found.status.reason
    empty = method(Target.of(np.zeros((0, 2, 2)), 0.003), Slice(0.0, np.zeros((9, 2))), Pose2D(), SMALL)
    assert empty.status.name == "no_data"


def test_wrong_input_is_named():
    with pytest.raises(ConfigError, match="choose from"):
        matcher("icp")
    with pytest.raises(ConfigError):
        Target.of(np.zeros((1, 2, 2)), 0.0)
    with pytest.raises(ConfigError):
        Target.of([[[0.0, math.nan], [1.0, 0.0]]], 0.003)
    with pytest.raises(ConfigError, match="poses"):
        match(
            Target.of([[[0.0, 0.0], [1.0, 0.0]]], 0.003), Slice(0.0, np.zeros((5, 2))), Pose2D(),
            SearchConfig(tolerance=(1e-9, 1e-3, 1e-2)),
        )  # fmt: skip


def test_tables_are_built_once_and_are_small(target, scenes):
    for slice_, *_ in scenes.make_slices(3, seed=12):
        match(target, slice_, Pose2D(), SearchConfig())
    kept = [
        t
        for t in target.kept.values()
        if getattr(t, "bound", "") == "majorant" and t.lattice.count == (243,) * 3
    ]
    assert len(kept) == 1 and kept[0].nbytes <= 16 * 2**20


PROBE = """
import math, numpy as np
from bimfit.config import SearchConfig
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.slice import Slice
from bimfit.registration.fitness import fitness_of
from bimfit.registration.lattice import Lattice
from bimfit.registration.matchers import MATCHERS
from bimfit.registration.table import Target
edges = np.array([[[-0.02, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, -0.01]]])
points = np.array([[-0.015, 0.003], [-0.01, 0.0032], [-0.004, 0.0035], [0.002, 0.001], [0.0022, -0.004]])
config = SearchConfig(window=(0.008, 0.008, 0.1), tolerance=(0.002, 0.002, 0.05), tests_per_level=2)
for name in ("grcsm", "overlap", "block", "brute"):
    r = MATCHERS[name](Target.of(edges, 0.003), Slice(0.0, points), Pose2D(), config)
    print(name, r.score.hex(), *[float(x).hex() for x in r.parameters], r.evaluations)
"""


def run_probe(**environment):
    root = str(Path(__file__).parents[2])
    done = subprocess.run(
        [sys.executable, "-c", PROBE], env=os.environ | environment | {"PYTHONPATH": root}, cwd=root,
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_kernels_mean_the_same_uncompiled():
    assert run_probe(NUMBA_DISABLE_JIT="1") == run_probe()


def test_an_installation_that_cannot_be_written_works():
    nowhere = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator", "NUMBA_CACHE_DIR": "/proc/nowhere"}
    root = str(Path(__file__).parents[2])
    code = (
        "import numpy as np; from bimfit.registration import _kernels as k; "
        "out = np.zeros(2); e = np.zeros((1, 2, 2)); "
        "print(k.fitness(np.array([[3.0, 4.0]]), np.array([1.0, 0.0, 0.0, 0.0]), e, 6.0)); "
        "print(k.fitness.stats.cache_path)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | nowhere | {"PYTHONPATH": root}, cwd=root,
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["(1,", "25.0)", "None"]
