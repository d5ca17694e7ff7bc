"""The per-station estimate on the reference scenario, against its truth."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation.station import estimate_station
from bimfit.geometry.slice import Slice


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
