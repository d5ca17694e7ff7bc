"""The certified search in space: bounds, brute force, budgets, flat directions, conventions."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bimfit.errors import ConfigError, ModelError, ScanError
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import rigid_inverse, transform_points
from bimfit.registration.grcsm_3d import match_3d
from bimfit.registration.problem_3d import make_problem
from bimfit.registration.rigid_3d import T_model_scan, T_scan_model, about, matrix_of, parameters_of
from bimfit.registration.surface_3d import visible_surface
from bimfit.registration.table_3d import Target3D

EYE = np.array([0.35, -0.4, 0.5])
STEP = (0.001, 0.001, 0.001, 0.00175, 0.00175, 0.00175)


def box(low, high) -> TriangleMesh:
    import trimesh

    mesh = trimesh.creation.box(bounds=[low, high])
    return TriangleMesh.of(mesh.vertices, mesh.faces)


def bracket() -> TriangleMesh:
    parts = (box([0, 0, 0], [0.16, 0.09, 0.02]), box([0, 0, 0.02], [0.03, 0.09, 0.12]))
    offsets = (0, len(parts[0].vertices))
    return TriangleMesh.of(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + k for p, k in zip(parts, offsets, strict=True)]),
    )


@pytest.fixture(scope="module")
def target() -> Target3D:
    return Target3D.of(bracket(), 0.006, viewpoint=EYE)


def cloud(seed: int, count: int, truth: np.ndarray, sigma: float = 0.002) -> np.ndarray:
    rng = np.random.default_rng(seed)
    seen = visible_surface(bracket(), 0.002, EYE).points
    points = seen[rng.choice(len(seen), count, replace=False)]
    return transform_points(truth, points + rng.normal(0.0, sigma, points.shape))


def motion(rng, shift: float, turn: float) -> np.ndarray:
    return about([0.08, 0.045, 0.05], rng.uniform(-shift, shift, 3), rng.uniform(-turn, turn, 3))


def error(T, truth) -> tuple[float, float]:
    """Shift at the bracket's middle (m) and angle (rad) between two motions."""
    E = rigid_inverse(truth) @ T
    middle = np.array([0.08, 0.045, 0.05])
    return float(np.linalg.norm(transform_points(E, middle) - middle)), float(
        np.linalg.norm(parameters_of(E)[3:])
    )


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    size=st.integers(0, 6),
    angle=st.integers(0, 6),
    weighted=st.booleans(),
    prior=st.booleans(),
)
def test_no_pose_of_a_box_beats_its_bound(
    target, seed: int, size: int, angle: int, weighted: bool, prior: bool
) -> None:
    """At every level, on the lattice and between, for points on the surface and beside it."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([cloud(seed, 40, motion(rng, 0.02, 0.1)), rng.uniform(-0.05, 0.2, (10, 3))])
    weights = rng.uniform(0.0, 2.0, len(points)) if weighted else None
    spread = (*rng.uniform(0.005, 0.1, 3), *rng.uniform(0.02, 0.5, 2), np.inf) if prior else None
    problem = make_problem(
        target, points, None, (0.1,) * 3 + (0.3,) * 3, STEP, weights=weights, prior_sigma=spread
    )
    low = rng.integers(-60, 30, 6).astype(float)
    high = low + np.concatenate([rng.integers(0, 2**size + 1, 3), rng.integers(0, 2**angle + 1, 3)])
    bound = problem.bound(low, high)
    inside = rng.uniform(low, high, (60, 6))
    corners = np.where(rng.random((40, 6)) < 0.5, low, high)
    best = max(problem.score(problem.pose(at)) for at in np.concatenate([inside, corners, np.rint(inside)]))
    assert bound >= best - 1e-9
    assert bound <= problem.total + 1e-9


def test_bound_of_one_pose_is_close_to_its_score(target) -> None:
    """A bound that never failed by being useless would pass the test above."""
    problem = make_problem(target, cloud(1, 300, np.eye(4)), None, (0.1,) * 6, STEP)
    score = problem.score(problem.pose(np.zeros(6)))
    assert score > 0.7 * problem.total
    assert problem.bound(np.zeros(6), np.zeros(6)) < 1.02 * score
    assert problem.bound(-np.ones(6), np.ones(6)) < 1.08 * score


@pytest.mark.parametrize(
    ("window", "seed"),
    [
        ((0.003, 0.003, 0.002, 0.0035, 0.0, 0.0018), 0),
        ((0.004, 0.0, 0.004, 0.0, 0.007, 0.0), 1),
        ((0.006, 0.006, 0.006, 0.0, 0.0, 0.0), 2),
        ((0.0, 0.0, 0.0, 0.01, 0.01, 0.01), 3),
        ((0.008, 0.008, 0.0, 0.0, 0.0, 0.03), 4),
        ((0.0, 0.0, 0.0, 0.0, 0.0, 0.06), 5),
    ],
)
def test_equals_brute_force(target, window, seed: int) -> None:
    """Same score as every pose of the lattice tried one by one: planar, turning only, shifting only."""
    rng = np.random.default_rng(seed)
    w = np.array(window)
    truth = about([0.08, 0.045, 0.05], *(rng.uniform(-0.7, 0.7, 6) * w).reshape(2, 3))
    points = np.concatenate([cloud(seed, 150, truth), rng.uniform(-0.05, 0.2, (30, 3))])
    result = match_3d(target, points, None, window, STEP, eps=0.0, refine=False)
    problem = make_problem(target, points, None, window, STEP)
    lattice = itertools.product(*(np.arange(-r, r + 1) for r in problem.reach))
    scored = [(problem.score(problem.pose(at)), at) for at in lattice]
    best, at = max(scored)
    assert result.stop == "proven"
    assert result.score == pytest.approx(best, abs=1e-9)
    assert result.bound == result.score
    np.testing.assert_allclose(T_model_scan(result), problem.T_model_scan(problem.pose(at)), atol=1e-9)


def test_finds_motions_that_icp_would_lose(target) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth = motion(rng, 0.027, 0.03)
        points = np.concatenate([cloud(seed, 400, truth), rng.uniform(-0.1, 0.25, (80, 3))])
        result = match_3d(target, points)
        shift, angle = error(T_scan_model(result), truth)
        assert result.status.name == "ok", result.status
        assert result.stop in ("tolerance", "proven")
        assert result.gap <= 0.02 * result.score + 1e-9
        assert shift < 0.0015
        assert angle < 0.012
        assert result.fitness > 0.7


def test_prior_is_a_motion_of_the_model_and_the_window_follows_it(target) -> None:
    """The same data seen from far away give the same answer, moved along."""
    rng = np.random.default_rng(4)
    small = motion(rng, 0.008, 0.01)
    away = matrix_of([4.0, -3.0, 2.0, 0.3, 2.0, -0.7])
    points = cloud(4, 300, small)
    window = (0.01, 0.01, 0.01, 0.0175, 0.0175, 0.0175)
    near = match_3d(target, points, None, window, STEP)
    far = match_3d(target, transform_points(away, points), away, window, STEP)
    again = match_3d(target, transform_points(away, points), parameters_of(away), window, STEP)
    np.testing.assert_allclose(T_scan_model(far), away @ T_scan_model(near), atol=1e-4)
    np.testing.assert_allclose(far.parameters, again.parameters, atol=1e-9)
    assert error(T_scan_model(near), small)[0] < 0.0015


def test_budgets_leave_a_true_gap(target) -> None:
    points = cloud(6, 300, motion(np.random.default_rng(6), 0.02, 0.02))
    short = match_3d(target, points, eps=0.0, max_evaluations=1500, refine=False)
    full = match_3d(target, points, eps=0.01, refine=False)
    assert short.stop == "budget"
    assert short.evaluations <= 1600
    assert short.gap > 0.0
    assert short.bound >= full.score - 1e-9
    assert full.bound >= short.score - 1e-9
    timed = match_3d(target, points, eps=0.0, time_budget=0.0, refine=False)
    assert timed.stop == "budget"
    assert timed.found


def test_same_bits_twice(target) -> None:
    points = cloud(7, 200, motion(np.random.default_rng(7), 0.01, 0.02))
    one, two = (match_3d(target, points) for _ in range(2))
    assert np.array_equal(one.parameters, two.parameters)
    assert (one.score, one.bound, one.evaluations) == (two.score, two.bound, two.evaluations)


def test_weights_silence_points(target) -> None:
    """A second, shifted copy of weight 0 changes nothing."""
    points = cloud(8, 200, np.eye(4))
    both = np.concatenate([points, points + np.array([0.02, 0.0, 0.01])])
    weights = np.repeat([1.0, 0.0], len(points))
    window = (0.005,) * 3 + (0.0,) * 3
    pivot = (0.08, 0.045, 0.05)
    plain = match_3d(target, points, None, window, STEP, eps=0.0, pivot=pivot, refine=False)
    weighted = match_3d(target, both, None, window, STEP, eps=0.0, pivot=pivot, weights=weights, refine=False)
    assert weighted.score == pytest.approx(plain.score, abs=1e-9)
    np.testing.assert_allclose(weighted.parameters, plain.parameters, atol=1e-12)


def test_a_single_face_leaves_three_directions_open_by_name() -> None:
    rng = np.random.default_rng(9)
    plate = Target3D.of(
        box([-0.16, -0.16, -0.02], [0.16, 0.16, 0.0]), 0.006, viewpoint=(0, 0, 1), spacing=0.003
    )
    points = np.column_stack([rng.uniform(-0.08, 0.08, (400, 2)), rng.normal(0.0, 0.0005, 400)])
    truth = about([0, 0, 0], [0, 0, 0.012], [0.015, -0.01, 0])
    result = match_3d(plate, transform_points(truth, points))
    assert result.status.name == "weak"
    for name in ("shift along x", "shift along y", "turn about z"):
        assert name in result.status.reason
    # What the face fixes is right, and what it leaves open stays at the prior.
    np.testing.assert_allclose(result.parameters[2:5], [0.012, 0.015, -0.01], atol=0.002)
    np.testing.assert_allclose(result.parameters[[0, 1]], 0.0, atol=0.002)
    assert abs(result.parameters[5]) < 0.002


def test_rival_poses_are_reported_and_lie_apart() -> None:
    """Two equal bars: a scan of one of them fits both."""
    bar = box([0, 0, 0], [0.08, 0.02, 0.02])
    both = TriangleMesh.of(
        np.concatenate([bar.vertices, bar.vertices + np.array([0, 0.06, 0])]),
        np.concatenate([bar.faces, bar.faces + 8]),
    )
    seen = visible_surface(bar, 0.003, (0.2, -0.3, 0.4)).points + np.array([0.0, 0.03, 0.0])
    pair = Target3D.of(both, 0.004, viewpoint=(0.2, -0.3, 0.4))
    window = (0.01, 0.04, 0.01, 0.0, 0.0, 0.0)
    result = match_3d(pair, seen, None, window, STEP, eps=0.0, delta=0.15, refine=False)
    assert result.status.name == "ambiguous"
    assert len(result.modes) == 1
    shifts = sorted([result.parameters[1], result.modes[0].parameters[1]])
    np.testing.assert_allclose(shifts, [-0.03, 0.03], atol=0.0021)
    assert result.modes[0].score <= result.score


def test_edge_of_the_window_and_wrong_place_are_told(target) -> None:
    points = cloud(10, 200, about([0, 0, 0], [0.012, 0, 0], [0, 0, 0]))
    edge = match_3d(target, points, None, (0.004, 0.004, 0.004, 0, 0, 0), STEP)
    assert edge.status.name == "weak"
    assert "edge of the window: shift along x" in edge.status.reason
    lost = match_3d(target, points + np.array([5.0, 0, 0]), None, (0.004,) * 3 + (0,) * 3, STEP)
    assert lost.status.name == "rejected"
    none = match_3d(target, np.zeros((0, 3)))
    assert none.status.name == "no_data"
    assert not none.found


def test_tables_are_kept_and_found_again(tmp_path, target) -> None:
    surface = visible_surface(box([0, 0, 0], [0.05, 0.04, 0.03]), 0.004)
    built = Target3D.of(surface, 0.006, cache=tmp_path)
    (kept,) = tmp_path.iterdir()
    loaded = Target3D.of(surface, 0.006, cache=tmp_path)
    for name in ("bricks", "records", "shapes", "starts", "pads"):
        assert np.array_equal(getattr(built.tables, name), getattr(loaded.tables, name))
    assert np.array_equal(built.field, loaded.field)
    kept.write_bytes(b"damaged")
    again = Target3D.of(surface, 0.006, cache=tmp_path)
    assert np.array_equal(again.tables.records, built.tables.records)


def test_field_is_the_blurred_distance_to_the_surface(target) -> None:
    """Over a face, away from its edges, the field is a Gaussian of the height, lowered to 0 at 2.5 blurs."""
    from bimfit.registration import _kernels_3d as kernels

    floor = np.exp(-0.5 * 2.5**2)
    for height in (0.0, 0.004, 0.009, 0.016):
        p = (np.array([0.1, 0.045, 0.02 + height]) - target.origin) / target.spacing
        expected = max(0.0, (np.exp(-0.5 * (height / 0.006) ** 2) - floor) / (1.0 - floor))
        assert kernels.read(target.field, *p) == pytest.approx(expected, abs=0.03)


def test_a_cloud_serves_as_the_model() -> None:
    points = visible_surface(bracket(), 0.003, EYE).points
    truth = motion(np.random.default_rng(12), 0.01, 0.015)
    result = match_3d(Target3D.of(points, 0.006), cloud(12, 300, truth))
    assert error(T_scan_model(result), truth)[0] < 0.002


def test_bad_input_is_named(target) -> None:
    good = cloud(13, 50, np.eye(4))
    with pytest.raises(ScanError, match="finite"):
        match_3d(target, np.full((4, 3), np.nan))
    with pytest.raises(ConfigError, match="window"):
        match_3d(target, good, None, (1.0, 2.0))
    with pytest.raises(ConfigError, match="tolerance"):
        match_3d(target, good, None, (0.1,) * 6, (0.0,) * 6)
    with pytest.raises(ConfigError, match="rigid"):
        match_3d(target, good, 2.0 * np.eye(4))
    with pytest.raises(ConfigError, match="weights"):
        match_3d(target, good, weights=np.full(50, -1.0))
    with pytest.raises(ConfigError, match="positive"):
        Target3D.of(bracket(), 0.0)
    with pytest.raises(ModelError, match="too large"):
        Target3D.of(box([0, 0, 0], [9, 9, 9]), 0.006, spacing=0.001)
    with pytest.raises(ModelError, match="surface"):
        Target3D.of(TriangleMesh.of([[0, 0, 0]], np.zeros((0, 3))))


def test_memory_is_kept_to_by_a_coarser_lattice() -> None:
    small = Target3D.of(bracket(), 0.006, viewpoint=EYE, max_bytes=4 * 2**20)
    assert small.spacing > 0.0021
    assert small.nbytes < 4.4 * 2**20
    truth = about([0.08, 0.045, 0.05], [0.01, -0.015, 0.004], [0.01, 0.02, -0.02])
    assert error(T_scan_model(match_3d(small, cloud(3, 300, truth))), truth)[0] < 0.0015


def test_bench_gives_a_row_a_method() -> None:
    from bimfit.registration.bench_3d import EYE as ABOVE
    from bimfit.registration.bench_3d import bench_matcher_3d, gap_scene

    scene = gap_scene()
    assert scene.volume == pytest.approx(2 * 0.2 * 0.025 * 0.5)
    window = (0.004, 0.005)
    coarse = Target3D.of(scene, 0.006, viewpoint=ABOVE, spacing=0.005)
    rows = bench_matcher_3d(
        1, (window,), points=300, methods=("grcsm-3d", "icp-plane", "g-icp"), target=coarse
    )
    names = [row.method for row in rows]
    assert names[:2] == ["grcsm-3d", "icp-plane"]
    assert rows[0].failures == 0
    assert rows[0].proven == 1
    assert rows[0].mean_mm < 5.0
    assert all(row.starts == 1 and row.median_ms > 0.0 for row in rows)


@pytest.mark.parametrize(
    "window",
    [(0.006, 0.0, 0.006, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.01, 0.01), (0.005, 0.0, 0.0, 0.0, 0.0, 0.03)],
)
def test_a_prior_is_added_exactly(target, window) -> None:
    """The score is the surface's, less half a point for each squared sigma; proven against brute force."""
    points = cloud(20, 120, about([0.08, 0.045, 0.05], [0.003, 0.0, -0.002], [0.0, 0.006, 0.01]))
    spread = np.array([0.002, 0.002, 0.003, 0.01, 0.004, np.inf])
    plain = make_problem(target, points, None, window, STEP)
    lattice = list(itertools.product(*(np.arange(-r, r + 1) for r in plain.reach)))
    poses = np.array([plain.pose(at) for at in lattice])
    metres = poses * np.array([target.spacing] * 3 + [1.0] * 3)
    expected = np.array([plain.score(pose) for pose in poses]) - 0.5 * 12.0 * ((metres / spread) ** 2).sum(
        axis=1
    )
    result = match_3d(target, points, None, window, STEP, eps=0.0, prior_sigma=spread, prior_weight=12.0)
    assert result.stop == "proven"
    assert result.score == pytest.approx(expected.max(), abs=1e-9)
    best = poses[int(np.argmax(expected))]
    np.testing.assert_allclose(T_model_scan(result), plain.T_model_scan(best), atol=1e-9)


def test_a_prior_holds_what_the_data_leave_open() -> None:
    rng = np.random.default_rng(21)
    plate = Target3D.of(
        box([-0.16, -0.16, -0.02], [0.16, 0.16, 0.0]), 0.008, viewpoint=(0, 0, 1), spacing=0.004
    )
    points = np.column_stack([rng.uniform(-0.08, 0.08, (200, 2)), rng.normal(0.005, 0.0005, 200)])
    window, spread = (0.01, 0.01, 0.01, 0.0, 0.0, 0.02), (0.001, 0.001, np.inf, np.inf, np.inf, 0.002)
    open_ = match_3d(plate, points, None, window, STEP)
    assert {name for name, _ in open_.flat} == {"shift along x", "shift along y", "turn about z"}
    for _, vector in open_.flat:
        assert np.linalg.norm(vector) == pytest.approx(1.0)
    held = match_3d(plate, points, None, window, STEP, prior_sigma=spread, prior_weight=50.0)
    assert held.status.name == "ok"
    assert not held.flat
    np.testing.assert_allclose(held.parameters[[0, 1, 5]], 0.0, atol=1e-6)
    assert held.parameters[2] == pytest.approx(0.005, abs=0.001)


def test_a_warm_start_proves_the_same_sooner(target) -> None:
    truth = motion(np.random.default_rng(22), 0.02, 0.03)
    points = cloud(22, 300, truth)
    cold = match_3d(target, points, eps=0.02, refine=False)
    warm = match_3d(target, points, eps=0.02, incumbent=T_scan_model(cold), refine=False)
    assert warm.score >= cold.score - 1e-9
    assert warm.gap <= 0.02 * warm.score + 1e-9
    again = match_3d(target, points, eps=0.02, incumbent=cold.parameters, max_evaluations=60, refine=False)
    assert again.score >= cold.score - 1e-9
    outside = match_3d(target, points, eps=0.02, incumbent=matrix_of([9.0, 0, 0, 0, 0, 0]), refine=False)
    assert outside.score == pytest.approx(cold.score, rel=0.02)
    for bad in (2.0 * np.eye(4), np.zeros(5)):
        with pytest.raises(ConfigError, match="incumbent"):
            match_3d(target, points, incumbent=bad)
    with pytest.raises(ConfigError, match="prior_sigma"):
        match_3d(target, points, prior_sigma=(0.0,) * 6)
