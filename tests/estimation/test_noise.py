"""Sensor noise from residuals: the figures a scan was simulated with come back."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation.noise import estimate_noise
from bimfit.estimation.station import estimate_station

spec = importlib.util.spec_from_file_location("noise_scenario", Path(__file__).with_name("scenario.py"))
S = importlib.util.module_from_spec(spec)
sys.modules["noise_scenario"] = S
spec.loader.exec_module(S)


def _joint(sensor, n=25, **scan):
    sec = S.butt()
    rng = np.random.default_rng(21)
    truth = S.reference_truth(rng, sec, n=n)
    out = []
    for a, b, c in zip(truth.a, truth.b, truth.common, strict=True):
        slice_ = S.scan(rng, [sec.components[0].moved(a), sec.components[1].moved(b)], **scan)
        out.append(estimate_station(sec, slice_, S.search_like(rng, c), sensor, FitConfig()))
    return out


@pytest.mark.parametrize(
    ("scan", "sigma", "rho", "miss", "outlier"),
    [
        ({}, 0.003, 0.0, 0.01, 0.01),
        ({"sigma": 0.0045}, 0.0045, 0.0, 0.01, 0.01),
        ({"sigma": 0.001}, 0.001, 0.0, 0.01, 0.01),
        ({"rho": 0.5}, 0.003, 0.5, 0.01, 0.01),
        ({"misses": 0.05, "outliers": 0.05}, 0.003, 0.0, 0.05, 0.05),
    ],
)
def test_what_was_simulated_comes_back(scan, sigma, rho, miss, outlier):
    noise = estimate_noise(_joint(SensorConfig(), **scan), SensorConfig())
    assert noise.sigma == pytest.approx(sigma, rel=0.06)
    assert noise.correlation == pytest.approx(rho, abs=0.08)
    assert noise.miss_share == pytest.approx(miss, abs=0.012)
    assert noise.outlier_share == pytest.approx(outlier, abs=0.012)
    assert (noise.sensor.sigma, noise.sensor.correlation) == (noise.sigma, noise.correlation)
    assert noise.sensor.pooled().sigma == pytest.approx(
        noise.sigma * np.sqrt((1 + noise.correlation) / (1 - noise.correlation))
    )


def test_one_station_says_what_it_can():
    for sigma in (0.0015, 0.003, 0.006):
        noise = estimate_noise(_joint(SensorConfig(), n=1, sigma=sigma), SensorConfig())
        assert noise.sigma == pytest.approx(sigma, rel=0.2)
        assert noise.correlation == 0.0


def test_too_few_residuals_change_nothing():
    sensor = SensorConfig(sigma=0.004)
    assert estimate_noise([], sensor).sensor == sensor


def test_streaks_among_the_inliers_do_not_pass_for_noise():
    """A fifth of the returns lie 2 to 6 sigmas off: the core's sigma comes back, and no runaway follows."""
    sensor = SensorConfig(outlier_share=0.1, outlier_run=4.0)
    sec = S.butt()
    rng = np.random.default_rng(8)
    truth = S.reference_truth(rng, sec, n=30)
    out = []
    for a, b, c in zip(truth.a, truth.b, truth.common, strict=True):
        slice_ = S.scan(rng, [sec.components[0].moved(a), sec.components[1].moved(b)])
        false = rng.random(len(slice_.beams.ranges)) < 0.2
        off = rng.choice([-1.0, 1.0], len(false)) * rng.uniform(0.006, 0.018, len(false))
        beams = slice_.beams
        beams = dataclasses.replace(beams, ranges=beams.ranges + np.where(false, off, 0.0))
        slice_ = dataclasses.replace(slice_, beams=beams, points=beams.points)
        out.append(estimate_station(sec, slice_, S.search_like(rng, c), sensor, FitConfig()))
    noise = estimate_noise(out, sensor)
    assert noise.sigma == pytest.approx(0.003, rel=0.15)
    assert 0.12 < noise.outlier_share < 0.25
