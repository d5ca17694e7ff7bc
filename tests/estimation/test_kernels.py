"""The kernels against independent oracles: shapely, closed forms, a dense lattice, and their own Python."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import scipy
import shapely

from bimfit.config import SensorConfig
from bimfit.estimation import _kernels_beams
from bimfit.estimation import _kernels_likelihood as kernels
from bimfit.estimation.likelihood import BeamModel, BeamSet, edge_rows, predict_ranges
from bimfit.estimation.ownership import beam_table
from bimfit.estimation.posterior import Window, component_posterior
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile
from bimfit.geometry.slice import Beams

STEP = 0.352 * np.pi / 180
BOARD = Profile.polygon([(0.0125, 0.0), (0.0125, -0.025), (0.2125, -0.025), (0.2125, 0.0)])
NOTCHED = Profile.polygon(
    [(-0.2, -0.03), (-0.01, -0.03), (-0.01, -0.01), (-0.05, -0.02), (-0.06, 0.0), (-0.12, 0.01), (-0.2, 0.0)]
)


def _fan(eye, half=85, step=STEP, look=-np.pi / 2, ranges=None):
    angle = look + step * np.arange(-half, half + 1)
    d = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    r = np.full(len(d), np.nan) if ranges is None else ranges
    return Beams(np.broadcast_to(np.asarray(eye, float), d.shape).copy(), d, r)


def _shapely_ranges(profile, beams):
    body = shapely.Polygon(profile.loops[0], profile.loops[1:])
    out = np.full(len(beams.ranges), np.inf)
    for k, (o, d) in enumerate(zip(beams.origins, beams.directions, strict=True)):
        hit = shapely.LineString([o, o + 5.0 * d]).intersection(body)
        if not hit.is_empty:
            out[k] = shapely.Point(o).distance(hit)
    return out


@pytest.mark.parametrize("profile", [BOARD, NOTCHED, BOARD.moved(Pose2D(0.01, -0.02, 0.3))])
@pytest.mark.parametrize("eye", [(0.0, 0.25), (-0.3, 0.1), (0.05, -0.3)])
def test_predicted_ranges_are_the_first_intersections(profile, eye):
    look = math.atan2(-eye[1], -eye[0])
    beams = _fan(eye, look=look)
    set_ = BeamSet.of(beams)
    rho, face = predict_ranges(edge_rows(profile), set_)
    exact = _shapely_ranges(profile, beams)[set_.order]
    assert np.array_equal(np.isfinite(rho), np.isfinite(exact))
    seen = np.isfinite(rho)
    assert seen.any()
    assert np.allclose(rho[seen], exact[seen], atol=1e-9)
    assert np.array_equal(face >= 0, seen)


def test_all_round_scans_and_several_origins_are_predicted_too():
    ring = Profile.polygon(
        [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)],
        holes=[[(-0.4, -0.4), (0.4, -0.4), (0.4, 0.4), (-0.4, 0.4)]],
    )
    rng = np.random.default_rng(2)
    angle = rng.uniform(-np.pi, np.pi, 400)
    d = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    o = np.array([(0.0, 0.0), (0.2, -0.1), (-0.3, 0.3)])[rng.integers(0, 3, 400)]
    beams = Beams(o, d, np.full(400, np.nan))
    set_ = BeamSet.of(beams)
    rho, _ = predict_ranges(edge_rows(ring), set_)
    assert len(set_.eye) == 3
    assert np.allclose(rho, _shapely_ranges(ring, beams)[set_.order], atol=1e-9)


def test_pseudo_angle_sorts_like_atan2():
    a = np.sort(np.random.default_rng(0).uniform(-np.pi, np.pi, 500))
    p = np.array([_kernels_beams.pseudo_angle(math.cos(x), math.sin(x)) for x in a])
    assert np.all(np.diff(p) > 0)
    assert p.min() >= -2.0
    assert p.max() <= 2.0


HOME = Pose2D()


def _seen(pose=HOME, sigma=0.003, seed=1, profile=BOARD):
    """A board from 0.25 m above, right half of the fan, as the posterior takes it."""
    beams = _fan((0.0, 0.25))
    rng = np.random.default_rng(seed)
    rho = _shapely_ranges(profile.moved(pose), beams)
    r = np.where(np.isfinite(rho), rho + rng.normal(0.0, sigma, len(rho)), np.nan)
    right = beams.directions[:, 0] > 0.0
    set_ = BeamSet.of(Beams(beams.origins[right], beams.directions[right], r[right]))
    model = BeamModel.of(SensorConfig(sigma=sigma))
    return set_, model, beam_table(set_, model, 1.0)


def _with(table, **rows):
    """The table with rows of its own: the cost of covering, the limit."""
    out = table.rows.copy()
    for name, values in rows.items():
        out[getattr(_kernels_beams, name.upper()), : len(table)] = values
    return dataclasses.replace(table, rows=out)


def test_information_of_a_flat_face_is_the_closed_form():
    """METHOD section 5: g = [cos a / cos b, sin a / cos b, rho tan b], I = sum g g^T / sigma^2."""
    set_, model, _ = _seen(sigma=1e-4)
    rho, face = predict_ranges(edge_rows(BOARD), set_)
    top = (face == 3) & (set_.r > 0.0)
    phi = np.arctan2(set_.d[1], set_.d[0])[top]
    alpha = -np.pi / 2  # the face's normal, towards the material as the beam goes
    beta = alpha - phi
    g = np.stack(
        [np.cos(alpha) / np.cos(beta), np.sin(alpha) / np.cos(beta), rho[top] * np.tan(beta)], axis=1
    )
    expected = g.T @ g / model.sigma**2
    H, b = np.empty((3, 3)), np.empty(3)
    # rotation about the sensor, as the closed form has it
    local = set_.moved_origin(np.array([0.0, 0.25]))
    rows = edge_rows(BOARD, Pose2D(0.0, -0.25, 0.0))
    exact = dataclasses.replace(local, r=np.where(top, rho, -1e9))
    kernels.normal_equations(
        rows, np.zeros(3), 1.0, beam_table(exact, model, 1.0).rows, local.start, local.eye, 1.0, 1 << 40, 0.0,
        *kernels.scratch(rows, local.eye), H, b,
    )  # fmt: skip
    assert np.allclose(np.abs(H), np.abs(expected), rtol=1e-3, atol=1e-3 * np.abs(expected).max())
    assert np.allclose(np.diag(H), np.diag(expected), rtol=1e-3)


@pytest.mark.parametrize("ends", [(-1.5, 1.5), (-1.5, 0.1), (-0.1, 1.5)])
def test_of_a_face_that_some_beams_graze_the_others_count(ends):
    """METHOD section 4, step 5: hits with |n.d| under 0.3 stay out, and no others."""
    (low, high), sigma = ends, 1e-4
    rows = edge_rows(Profile.polygon([(low, -0.25), (low, -0.3), (high, -0.3), (high, -0.25)]))
    beams = _fan((0.0, 0.0), half=40, step=math.radians(2.0))
    set_ = BeamSet.of(beams)
    rho, _ = predict_ranges(rows, set_)
    hit = np.isfinite(rho)
    dx, dy = set_.d
    for fewest, counted in ((1 << 40, hit & (-dy >= 0.3)), (2, hit)):
        alpha, phi = -np.pi / 2, np.arctan2(dy, dx)[counted]
        g = np.stack(
            [np.zeros_like(phi), 1.0 / np.cos(alpha - phi), rho[counted] * np.tan(alpha - phi)], axis=1
        )
        model = BeamModel.of(SensorConfig(sigma=sigma))
        table = beam_table(dataclasses.replace(set_, r=np.where(hit, rho, -1e9)), model, 1.0)
        H, b = np.empty((3, 3)), np.empty(3)
        kernels.normal_equations(
            rows, np.zeros(3), 1.0, table.rows, set_.start, set_.eye, 1.0, fewest, 0.0,
            *kernels.scratch(rows, set_.eye), H, b,
        )  # fmt: skip
        assert 0 < counted.sum() < (hit.sum() if fewest > 2 else hit.sum() + 1)
        assert np.allclose(
            np.abs(H), np.abs(g.T @ g) / model.sigma**2, rtol=1e-3, atol=1e-3 * np.abs(H).max()
        )


def _lattice(rows, pivot, table, window, around, half, n=41):
    """Mean and covariance by brute force over a dense lattice of (u, v, theta) about the pivot."""
    grid = [np.linspace(m - h, m + h, n) for m, h in zip(around, half, strict=True)]
    X = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 3)
    eye = table.eye.copy()
    eye[:, :2] -= pivot
    moved = rows.copy()
    moved[:, 0:2] -= pivot
    moved[:, 2:4] -= pivot
    after = (
        table.rows,
        table.start,
        eye,
        table.margin,
        0.05 * table.spacing,
        *kernels.scratch(moved, eye),
    )
    value = np.array([kernels.log_likelihood(moved, x, *after) for x in X])
    value -= 0.5 * np.sum((X / (window.shift, window.shift, window.angle)) ** 2, axis=1)
    w = np.exp(value - value.max())
    w /= w.sum()
    mean = w @ X
    return mean, (X - mean).T @ ((X - mean) * w[:, None])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_quadrature_agrees_with_a_dense_lattice(seed):
    truth = Pose2D.about((0.0125, 0.0), 0.002, -0.003, math.radians(1.5))
    _, _, table = _seen(truth, seed=seed)
    window = Window()
    rows = edge_rows(BOARD)
    result = component_posterior(rows, Pose2D(), table, window)
    sd = np.sqrt(np.diag(result.pivot_covariance))
    delta = np.array([*(result.pose.apply(result.pivot) - result.pivot), result.pose.theta])
    mean, cov = _lattice(rows, result.pivot, table, window, delta, 4.5 * sd + (4e-4, 0.0, 0.0))
    assert np.all(np.abs(mean - delta) < 0.15 * sd)
    assert np.allclose(np.sqrt(np.diag(cov)), sd, rtol=0.12)


def test_posterior_does_not_depend_on_where_the_frame_is():
    set_, model, table = _seen(Pose2D(0.001, 0.002, 0.01))
    one = component_posterior(edge_rows(BOARD), Pose2D(), table, Window())
    shift = np.array([3.0, -7.0])
    far = set_.moved_origin(-shift)
    rows = edge_rows(BOARD.moved(Pose2D(*shift, 0.0)))
    two = component_posterior(rows, Pose2D(), beam_table(far, model, 1.0), Window())
    corner = np.array([0.0125, 0.0])
    assert np.allclose(two.pose.apply(corner + shift) - shift, one.pose.apply(corner), atol=1e-8)
    J = np.eye(3)
    arm = two.pose.turn(shift)
    J[0, 2], J[1, 2] = -arm[1], arm[0]
    assert np.allclose(J @ two.covariance @ J.T, one.covariance, rtol=1e-4, atol=1e-12)


def test_kernels_do_what_their_python_does():
    set_, model, table = _seen(Pose2D(0.001, 0.002, 0.01))
    rows = edge_rows(BOARD)
    n = len(set_)
    rho, face = np.full(n, np.inf), np.full(n, -1, np.int64)
    args = (rows, math.cos(0.02), math.sin(0.02), 1e-3, -2e-3, set_.rays, set_.start, set_.eye)
    _kernels_beams.predict(*args, rho, face)
    slow, slow_face = np.full(n, np.inf), np.full(n, -1, np.int64)
    _kernels_beams.predict.py_func(*args, slow, slow_face)
    assert np.array_equal(face, slow_face)
    assert np.allclose(rho[face >= 0], slow[face >= 0], rtol=1e-12)
    common = (rows, np.array([1e-3, -2e-3, 0.02]), table.rows, set_.start, set_.eye, table.margin)
    space = kernels.scratch(rows, set_.eye)
    fast = kernels.log_likelihood(*common, 3e-4, *space)
    assert fast == pytest.approx(kernels.log_likelihood.py_func(*common, 3e-4, *space), rel=1e-12)
    covered = face >= 0
    d2 = ((set_.r - rho) / model.sigma) ** 2
    a = model.amplitude * np.exp(-0.5 * d2)
    naive = np.sum(np.where(covered, np.log1p(a) + table.rows[_kernels_beams.OFF, :n], 0.0))
    flat = kernels.log_likelihood(*common, 0.0, *space)
    assert flat == pytest.approx(naive, abs=1e-3)


def test_the_likelihood_of_one_return_is_the_softplus_of_its_odds():
    t = np.r_[-np.inf, np.linspace(-60.0, 60.0, 4001)]
    assert np.allclose([kernels._gain(x) for x in t], np.logaddexp(0.0, t), atol=2e-5)
    assert np.allclose([kernels._weight(x) for x in t], scipy.special.expit(t), atol=1e-6)


@pytest.mark.parametrize("eye", [(0.0, 0.25), (-0.3, 0.1), (-0.03, 0.05)])
def test_stretches_of_beams_meet_the_edges_that_are_predicted_beam_by_beam(eye):
    """A notched profile hides its own edges; the sums over stretches are those over single beams."""
    rng = np.random.default_rng(5)
    set_ = BeamSet.of(_fan(eye, half=250, look=math.atan2(-eye[1], -0.1 - eye[0]), step=STEP))
    rows, model = edge_rows(NOTCHED), BeamModel.of(SensorConfig(sigma=0.003))
    rho, face = predict_ranges(rows, set_)
    assert len(np.unique(face)) > 3
    seen = dataclasses.replace(set_, r=np.where(face >= 0, rho, 0.5) + rng.normal(0.0, 0.003, len(set_)))
    limit = np.where(rng.random(len(set_)) < 0.1, 0.01, np.inf)
    off = rng.normal(0.0, 1.0, len(set_))
    table = _with(beam_table(seen, model, 1.0), off=off, deep=0.0, limit=limit)
    total = kernels.log_likelihood(
        rows, np.zeros(3), table.rows, seen.start, seen.eye, table.margin, 0.0,
        *kernels.scratch(rows, seen.eye),
    )  # fmt: skip
    covered = (face >= 0) & (rho < limit)
    odds = math.log(model.amplitude) - 0.5 * ((seen.r - rho)[covered] / model.sigma) ** 2
    assert total == pytest.approx(np.sum(np.logaddexp(0.0, odds) + off[covered]), abs=1e-2)


def test_a_return_from_behind_counts_only_where_something_should_have_stopped_it():
    set_, model, _ = _seen()
    rows = edge_rows(BOARD)
    rho, face = predict_ranges(rows, set_)
    covered = face >= 0
    behind = np.where(np.isfinite(rho), rho + 0.1, 0.6)
    table = beam_table(dataclasses.replace(set_, r=behind), model, 0.012)
    B = _with(table, off=0.0, deep=model.past).rows
    total = kernels.log_likelihood(
        rows,
        np.zeros(3),
        B,
        set_.start,
        set_.eye,
        table.margin,
        0.0,
        *kernels.scratch(rows, set_.eye),
    )
    assert total == pytest.approx(model.past * covered.sum(), rel=1e-9)
