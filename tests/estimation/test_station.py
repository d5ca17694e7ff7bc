"""The per-station estimate on the reference scenario, against its truth."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation.station import estimate_station
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.slice import Beams, Slice


def _scenario():
    name = "estimation_scenario"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name("scenario.py"))
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
    return sys.modules[name]


S = _scenario()


def test_reference_joint_is_estimated_to_half_a_millimetre():
    sec = S.butt()
    rng = np.random.default_rng(11)
    truth = S.reference_truth(rng, sec)
    errors, angles, standard = [], [], []
    for a, b, common in zip(truth.a, truth.b, truth.common, strict=True):
        slice_ = S.scan(rng, [sec.components[0].moved(a), sec.components[1].moved(b)])
        result = estimate_station(sec, slice_, S.search_like(rng, common), SensorConfig(), FitConfig())
        assert result.status.name == "ok"
        pose_a, pose_b = (c.pose for c in result.components)
        error = S.gap_pose(sec, pose_a, pose_b) - S.gap_pose(sec, a, b)
        errors.append(np.hypot(error[0], error[1]))
        angles.append(abs(error[2]))
        for k, t in ((0, a), (1, b)):
            c = result.components[k]
            arm = c.pose.turn(sec.gap.mouth[k])
            J = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]])
            C = J @ c.covariance @ J.T
            shift = c.pose.apply(sec.gap.mouth[k]) - t.apply(sec.gap.mouth[k])
            standard.append(np.array([*shift, c.pose.theta - t.theta]) / np.sqrt(np.diag(C)))
    assert np.mean(errors) < 0.55e-3
    assert np.max(errors) < 2.0e-3
    assert np.degrees(np.mean(angles)) < 2.0
    size = np.sqrt(np.mean(np.square(standard), axis=0))
    assert np.all((size > 0.8) & (size < 1.2))


def test_empty_slice_and_failed_search_are_values():
    sec = S.butt()
    empty = Slice(0.0, np.zeros((0, 2)))
    result = estimate_station(sec, empty, None, SensorConfig(), FitConfig())
    assert result.status.name == "no_data"
    assert all(c.pose is None and c.covariance is None for c in result.components)
    rng = np.random.default_rng(0)
    slice_ = S.scan(rng, sec.components)
    assert estimate_station(sec, slice_, None, SensorConfig(), FitConfig()).status.name == "rejected"


def _degenerate(kind, beams, rng):
    """Beams that no sensor should deliver, and some do."""
    o, d, r = beams.origins.copy(), beams.directions.copy(), beams.ranges.copy()
    n = len(r)
    if kind == "random":
        r = rng.uniform(0.0, 5.0, n)
    elif kind == "few":
        r[:] = np.nan
        r[rng.integers(n, size=rng.integers(1, 9))] = 0.25
    elif kind == "missing":
        r[:] = np.nan
    elif kind == "duplicated":
        o, d, r = np.repeat(o[80:82], 40, axis=0), np.repeat(d[80:82], 40, axis=0), np.full(80, 0.25)
    elif kind == "nan":
        o[3], d[7] = np.nan, np.nan
    elif kind == "inside":
        o[:] = (0.05, -0.01)
        r = rng.uniform(0.001, 0.1, n)
    elif kind == "zero":
        r[:] = 0.0
    elif kind == "far":
        r += 1e4
    return Beams(o, d, r)


@pytest.mark.parametrize("kind", ["random", "few", "missing", "duplicated", "nan", "inside", "zero", "far"])
def test_degenerate_slices_are_values_with_a_reason_and_never_ok(kind):
    designs = (S.butt(), S.groove(), S.butt(gap=0.001), S.butt(gap=0.030, depth=2.7))
    for seed in range(12):
        rng = np.random.default_rng(seed)
        sec = designs[seed % 4]
        beams = _degenerate(kind, S.scan(rng, sec.components).beams, rng)
        known = beams if rng.random() < 0.7 else None
        start, other = Pose2D(*rng.normal(0.0, 0.02, 3)), Pose2D(*rng.normal(0.0, 0.02, 3))
        result = estimate_station(
            sec, Slice(0.0, beams.points, known), start, SensorConfig(), FitConfig(),
            component_matches=(other, None),
        )  # fmt: skip
        assert kind == "nan" or (result.status.name != "ok" and result.status.reason)
        for c in result.components:
            assert c.pose is None or np.isfinite(c.pose.as_array()).all()
            assert c.covariance is None or np.isfinite(c.covariance).all()


def test_a_beam_that_is_not_a_number_costs_no_other():
    sec = S.butt()
    slice_ = S.scan(np.random.default_rng(2), sec.components)
    beams = _degenerate("nan", slice_.beams, None)
    result = estimate_station(sec, Slice(0.0, beams.points, beams), Pose2D(), SensorConfig(), FitConfig())
    assert result.status.name == "ok"
    assert all(abs(c.pose.u) < 2e-3 and abs(c.pose.v) < 2e-3 for c in result.components)


def test_a_singular_matrix_is_a_rejection(monkeypatch):
    def singular(*_args, **_named):
        raise np.linalg.LinAlgError("Matrix is not positive definite.")

    monkeypatch.setattr("bimfit.estimation.components.component_posterior", singular)
    sec = S.butt()
    slice_ = S.scan(np.random.default_rng(2), sec.components)
    result = estimate_station(sec, slice_, Pose2D(), SensorConfig(), FitConfig())
    assert result.status.name == "rejected"
    assert "not positive definite" in result.status.reason


def test_a_coarse_fan_is_uncertain_by_its_cell_and_not_ambiguous():
    """Beams 10 mm apart: the edge lies between two, which is one place, sd at most 10 / sqrt(12) mm."""
    sec, rng = S.butt(gap=0.050, depth=0.03), np.random.default_rng(5)
    step = np.radians(0.4)
    cell, widest, names = 1.5 * step, 0.0, []
    for _ in range(12):
        shift = rng.uniform(-0.3, 0.3) * cell
        pose = Pose2D(shift, 0.002, 0.0)
        slice_ = S.scan(
            rng, [p.moved(pose) for p in sec.components], eye=(0.0, 1.5), half=45, step=step, sigma=0.002
        )
        result = estimate_station(sec, slice_, pose, SensorConfig(sigma=0.002), FitConfig())
        assert result.status.name != "ambiguous", result.status
        names.append(result.status.name)
        for c in result.components:
            sd = np.sqrt(c.covariance[0, 0])
            assert abs(c.pose.u - shift) < min(cell, 4.0 * sd)
            assert sd < 1.6 * cell / np.sqrt(12)
            widest = max(widest, sd)
    assert widest > 0.5 * cell / np.sqrt(12)
    assert names.count("ok") >= 11


@pytest.mark.parametrize("astray", [-0.1, 0.08])
def test_a_search_that_went_astray_along_long_faces_is_brought_home(astray):
    """Faces longer than the scan is wide leave hits flat along them: the gap's missing beams must tell."""
    sec, rng = S.butt(width=0.6), np.random.default_rng(3)
    a, b = Pose2D(0.004, 0.002, 0.01), Pose2D(-0.003, 0.001, -0.02)
    slice_ = S.scan(rng, [sec.components[0].moved(a), sec.components[1].moved(b)])
    result = estimate_station(sec, slice_, Pose2D(astray, 0.0015, 0.0), SensorConfig(), FitConfig())
    assert result.status.name == "ok", result.status
    for c, truth, corner in zip(result.components, (a, b), sec.gap.mouth, strict=True):
        assert np.hypot(*(c.pose.apply(corner) - truth.apply(corner))) < 0.002
