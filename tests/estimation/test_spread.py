"""How far each beam deviates: against the inverse covariance itself, and against what was simulated."""

from __future__ import annotations

import numpy as np
import pytest

from bimfit.config import SensorConfig
from bimfit.estimation import _kernels_beams
from bimfit.estimation.likelihood import BeamModel, BeamSet
from bimfit.estimation.ownership import beam_table
from bimfit.estimation.spread import run_weights, with_spread
from bimfit.geometry.slice import Beams


@pytest.mark.parametrize("rho", [0.1, 0.5, 0.8])
def test_run_weights_are_the_row_sums_of_the_inverse_covariance(rho):
    rng = np.random.default_rng(3)
    r = np.where(rng.random(60) < 0.3, -1.0, 0.3)
    start = np.array([0, 20, 20, 60])
    weights = run_weights(r, start, rho)
    for s, t in ((0, 20), (20, 60)):
        hit = s + np.flatnonzero(r[s:t] > 0.0)
        covariance = rho ** np.abs(hit[:, None] - hit[None, :]).astype(float)
        assert weights[hit] == pytest.approx(np.linalg.solve(covariance, np.ones(len(hit))))
    assert (weights[r < 0.0] == 1.0).all()
    many = run_weights(np.ones(9), np.array([0, 9]), rho)
    assert many[4] == pytest.approx(SensorConfig(correlation=rho).independent_share)


def test_independent_beams_that_deviate_alike_are_left_as_they_are():
    angle = np.linspace(-1.0, 1.0, 9)
    d = np.column_stack([np.sin(angle), -np.cos(angle)])
    beams = BeamSet.of(Beams(np.zeros((9, 2)), d, np.full(9, 0.4)))
    assert with_spread(beams, SensorConfig(), 0.4, None) is beams
    sensor = SensorConfig(sigma=0.001, sigma_per_metre=0.01, sigma_beyond=0.1)
    grown = with_spread(beams, sensor, 0.4, np.array([*np.linspace(0.2, 0.9, 8), np.inf]))
    at = [sensor.at(r).sigma / sensor.at(0.4).sigma for r in (*np.linspace(0.2, 0.9, 8), 0.4)]
    assert grown.spread == pytest.approx(at)
    assert np.array_equal(grown.spread, grown.scale)
    both = with_spread(
        beams, SensorConfig(sigma=0.001, sigma_per_metre=0.01, correlation=0.5), 0.4, np.full(9, 0.4)
    )
    # whatever an end counts more than the pooled sigma says
    assert both.spread == pytest.approx(1.0)
    assert both.scale[1:-1] == pytest.approx(1.0)
    assert both.scale[[0, -1]] == pytest.approx(np.sqrt(0.5))
    kept = beam_table(both, BeamModel.of(SensorConfig(sigma=0.002)), 1.0).take(np.arange(9) > 3)
    assert len(kept) == 5
    assert np.allclose(kept.rows[_kernels_beams.INVERSE, :5] * both.scale[4:], 500.0)
    assert np.all(kept.rows[:, 5:] == 0.0)
