"""The sensor model: noise that grows with range, correlated neighbours, several sweeps of one station."""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.config import FitConfig, SensorConfig
from bimfit.errors import ConfigError
from bimfit.estimation.context import typical_range
from bimfit.estimation.noise import estimate_noise
from bimfit.estimation.station import estimate_station
from bimfit.geometry.slice import Slice
from bimfit.simulation.rangefinder import measured
from bimfit.simulation.scenario import Scenario

spec = importlib.util.spec_from_file_location("sensor_scenario", Path(__file__).with_name("scenario.py"))
S = importlib.util.module_from_spec(spec)
sys.modules["sensor_scenario"] = S
spec.loader.exec_module(S)


def _estimated(sensor, n=60, seed=5, **scan):
    """Estimates, standardised errors (k, 3) and standard deviations (k, 3) of the mouth corners' motion."""
    sec = S.butt()
    rng = np.random.default_rng(seed)
    truth = S.reference_truth(rng, sec, n=n)
    estimates, z, sd = [], [], []
    for a, b, common in zip(truth.a, truth.b, truth.common, strict=True):
        slice_ = S.scan(rng, [sec.components[0].moved(a), sec.components[1].moved(b)], **scan)
        e = estimate_station(sec, slice_, S.search_like(rng, common), sensor, FitConfig())
        estimates.append(e)
        for k, t in ((0, a), (1, b)):
            c = e.components[k]
            corner = sec.gap.mouth[k]
            arm = c.pose.turn(corner)
            J = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]])
            spread = np.sqrt(np.diag(J @ c.covariance @ J.T))
            error = np.array([*(c.pose.apply(corner) - t.apply(corner)), c.pose.theta - t.theta])
            z.append(error / spread)
            sd.append(spread)
    return estimates, np.array(z), np.array(sd)


def _honest(z):
    assert np.all(np.abs(np.sqrt(np.mean(z**2, axis=0)) - 1.0) < 0.2)
    assert np.all(np.mean(np.abs(z) < 1.96, axis=0) > 0.89)


def test_several_sweeps_of_one_station_narrow_it_as_they_should():
    one, z1, sd1 = _estimated(SensorConfig())
    four, z4, sd4 = _estimated(SensorConfig(), sweeps=4)
    assert {e.status.name for e in four} == {e.status.name for e in one} == {"ok"}
    _honest(z1)
    _honest(z4)
    # what the ranges fix goes with the root of the sweeps; the edge, seen at the same bearings, with less
    assert np.median(sd4[:, 1:] / sd1[:, 1:]) == pytest.approx(0.5, abs=0.05)
    assert 0.4 < np.median(sd4[:, 0] / sd1[:, 0]) < 1.0


def test_noise_that_grows_with_range_is_taken_into_account():
    eye = (0.0, 0.6)
    sensor = SensorConfig(sigma=0.001, sigma_per_metre=0.005)
    there = 0.001 + 0.005 * 0.62
    estimates, z, sd = _estimated(sensor, eye=eye, sigma=there)
    _honest(z)
    assert estimates[0].sensor.sigma == pytest.approx(there, rel=0.05)
    _, _, constant = _estimated(SensorConfig(sigma=there), eye=eye, sigma=there)
    assert np.median(sd / constant) == pytest.approx(1.0, abs=0.05)
    # a sensor twice as noisy as assumed, at every range: both terms double
    noisy, _, _ = _estimated(SensorConfig(sigma=0.0005, sigma_per_metre=0.0025), eye=eye, sigma=there)
    found = estimate_noise(noisy, SensorConfig(sigma=0.0005, sigma_per_metre=0.0025)).sensor
    assert found.sigma == pytest.approx(0.001, rel=0.12)
    assert found.sigma_per_metre == pytest.approx(0.005, rel=0.12)


def test_correlated_neighbours_leave_the_intervals_honest():
    first, _, _ = _estimated(SensorConfig(), rho=0.5)
    noise = estimate_noise(first, SensorConfig())
    assert noise.correlation == pytest.approx(0.5, abs=0.06)
    _, z, _ = _estimated(noise.sensor, rho=0.5)
    assert np.all(np.mean(np.abs(z) < 1.96, axis=0) > 0.88)


def test_the_rule_of_a_rangefinder_and_its_simulation():
    urg = SensorConfig(sigma=0.03, sigma_per_metre=0.03, sigma_beyond=1.0)
    assert [urg.at(r).sigma for r in (0.2, 1.0, 2.0, 4.0)] == pytest.approx([0.03, 0.03, 0.06, 0.12])
    assert urg.at(2.0).at(3.0) == urg.at(2.0)
    scenario = Scenario(sigma=0.03, sigma_per_metre=0.03, sigma_beyond=1.0)
    for distance in (0.5, 2.0, 4.0):
        r = measured(np.full(20000, distance), scenario, np.random.default_rng(2))
        assert np.nanstd(r) == pytest.approx(urg.at(distance).sigma, rel=0.03)
    assert np.isnan(measured(np.full(5, np.inf), scenario, np.random.default_rng(2))).all()
    for wrong in (-0.1, math.inf, math.nan):
        with pytest.raises(ConfigError, match="sigma_per_metre"):
            SensorConfig(sigma_per_metre=wrong)


def test_the_typical_range_of_a_cloud_is_from_its_eye():
    points = np.array([[0.0, -1.0], [0.0, -2.0], [0.0, -3.0]])
    assert typical_range(Slice(0.0, points, None, np.zeros(2))) == 2.0
    assert typical_range(Slice(0.0, points)) == 1.0
