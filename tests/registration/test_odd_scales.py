"""The search against brute force where nobody tuned it: odd windows, steps, sizes and numbers of points."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, seed, settings
from hypothesis import strategies as st

from bimfit.config import SearchConfig
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.slice import Slice
from bimfit.registration.fitness import distances_to, fitness_of, own_returns
from bimfit.registration.matchers import MATCHERS, match
from bimfit.registration.table import Target

QUICK = settings(max_examples=40, deadline=None, derandomize=True)


def scene(rng, scale, count, away):
    """A bent surface about ``scale`` (m) wide, and points near it, all of them ``away`` from the origin."""
    corners = scale * np.cumsum(rng.uniform(-0.5, 0.5, (5, 2)), axis=0) + away
    edges = np.stack([corners[:-1], corners[1:]], axis=1)
    which, share = rng.integers(0, 4, count), rng.random((count, 1))
    points = edges[which, 0] * (1.0 - share) + edges[which, 1] * share
    moved = Pose2D.about(away, *rng.uniform(-0.05, 0.05, 2) * scale, float(rng.uniform(-0.1, 0.1)))
    return edges, moved.apply(points) + rng.normal(0.0, 0.01 * scale, (count, 2))


def same_as_brute(target, slice_, prior, config):
    found = match(target, slice_, prior, config)
    best = MATCHERS["brute"](target, slice_, prior, config)
    assert found.status.measured == best.status.measured
    if best.found:
        assert found.stop == "proven" and found.score == best.score == found.bound
        assert np.array_equal(found.parameters, best.parameters)


@pytest.mark.parametrize("bound", ["majorant", "overlap"])
@seed(21)
@QUICK
@given(
    st.integers(0, 2**32 - 1), st.sampled_from([0.0015, 0.02, 0.4, 6.0]), st.sampled_from([1, 3, 4, 40, 300]),
    st.integers(2, 4), st.booleans(), st.booleans(),
)  # fmt: skip
def test_any_scale_equals_brute_force(bound, seed_, scale, count, tests, far, narrow):
    """From a gap of 1.5 mm to profiles of metres, tolerances unequal, windows no multiple of them."""
    rng = np.random.default_rng(seed_)
    away = rng.uniform(-1.0, 1.0, 2) * (100.0 * scale if far else 0.0)
    edges, points = scene(rng, scale, count, away)
    window = rng.uniform(0.01, 0.2, 2) * scale
    steps = window / rng.uniform(2.0, 12.0, 2)
    turn = 0.0 if narrow else float(rng.uniform(0.02, 0.4))
    config = SearchConfig(
        window=(float(window[0]), float(window[1]), turn),
        tolerance=(float(steps[0]), float(steps[1]), float(rng.uniform(0.02, 0.1))),
        tests_per_level=tests, bound=bound,
    )  # fmt: skip
    target = Target.of(edges, float(rng.uniform(0.01, 0.1)) * scale)
    same_as_brute(target, Slice(0.0, points), Pose2D.about(away, 0.0, 0.0, float(rng.uniform(-3, 3))), config)
    same_as_brute(target, Slice(0.0, points), Pose2D(), config)


def test_twenty_thousand_points_equal_brute_force():
    """Sums of 16 bits spill many times over, and lanes are emptied on the way."""
    rng = np.random.default_rng(22)
    edges, points = scene(rng, 0.4, 20_000, np.zeros(2))
    config = SearchConfig(window=(0.02, 0.02, 0.1), tolerance=(0.002, 0.003, 0.02))
    target = Target.of(edges, 0.006)
    same_as_brute(target, Slice(0.0, points), Pose2D(), config)
    same_as_brute(target, Slice(0.0, points), Pose2D(), dataclasses.replace(config, bound="overlap"))


def test_points_far_from_all_others_change_no_answer():
    """A turn carries them by metres: their slack is as long as the table."""
    rng = np.random.default_rng(23)
    edges, points = scene(rng, 0.4, 60, np.zeros(2))
    far = np.concatenate([points, rng.uniform(-5.0, 5.0, (20, 2))])
    config = SearchConfig(window=(0.03, 0.03, 3.0), tolerance=(0.004, 0.004, 0.05))
    same_as_brute(Target.of(edges, 0.006), Slice(0.0, far), Pose2D(), config)


def test_returns_belong_to_the_nearest_component(scenes):
    parts = [Target.of(scenes.component_edges(k), 0.003) for k in range(2)]
    pose = Pose2D(0.004, -0.003, 0.05)
    points = pose.apply(np.concatenate([t.edges.mean(axis=1) for t in parts]))
    sizes = [len(t.edges) for t in parts]
    first, second = own_returns(parts, points, pose)
    assert np.array_equal(first, np.arange(sum(sizes)) < sizes[0]) and np.array_equal(second, ~first)
    off = pose.apply(pose.inverse().apply(points) + np.array([0.0, 0.002]))
    share, rmse = fitness_of(parts[0], off[: sizes[0]], pose)
    exact = distances_to(parts[0], off[: sizes[0]], pose)
    assert share == 1.0 and rmse == pytest.approx(np.sqrt(np.mean(exact**2)))
    nothing = Target.of(np.zeros((0, 2, 2)), 0.003)
    assert np.all(np.isinf(distances_to(nothing, points, pose)))


@pytest.mark.parametrize("name", ["icp-point", "icp-plane", "icp-plane-robust"])
def test_icp_is_held_to_the_window(scenes, name):
    """Points 30 mm off pull it beyond a window of 5 mm: that is said, and its start kept."""
    target = Target.of(scenes.boards_edges(), 0.012)
    t = np.linspace(0.02, 0.98, 40)[:, None]
    points = np.concatenate([a + t * (b - a) + np.array([0.0, 0.03]) for a, b in scenes.boards_edges()])
    config = SearchConfig(window=(0.005, 0.005, 0.05))
    found = MATCHERS[name](target, Slice(0.0, points), Pose2D(), config)
    assert found.status.name == "weak" and "window" in found.status.reason
    assert np.array_equal(found.parameters, np.zeros(3))
    wide = dataclasses.replace(config, window=(0.05, 0.05, 0.5))
    if name == "icp-point":  # nothing holds the others along the faces
        assert MATCHERS[name](target, Slice(0.0, points), Pose2D(), wide).pose.v > 0.02
