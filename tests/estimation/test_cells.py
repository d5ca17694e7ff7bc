"""Errors that stations share because they see a corner between the same two beams."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.estimation.motion import estimate_joint

spec = importlib.util.spec_from_file_location("along", Path(__file__).with_name("test_motion.py"))
M = importlib.util.module_from_spec(spec)
sys.modules["along"] = M
spec.loader.exec_module(M)

PITCH = np.sqrt(12.0) * M.SD[0]


def _boxed(rng, drift):
    """Corners (2, N) that drift by so many beams a station, in beam steps, and the middles of their cells."""
    bearing = rng.uniform(0.0, 1.0, (2, 1)) + drift * np.arange(M.N)
    return bearing, np.floor(bearing) + 0.5


def _stations(rng, drift):
    bearing, middle = _boxed(rng, drift)
    truth = np.zeros((2, M.N, 3))
    truth[:, :, 0] = bearing * PITCH
    noise = rng.normal(0.0, M.SD, (2, M.N, 3))
    noise[:, :, 0] = (middle - bearing) * PITCH
    return [
        dataclasses.replace(
            e,
            components=tuple(
                dataclasses.replace(c, corner_step=float(middle[k, i])) for k, c in enumerate(e.components)
            ),
        )
        for i, e in enumerate(M._stations(M._Given(noise), truth))
    ]


@pytest.mark.parametrize(("drift", "exact"), [(0.0, True), (0.013, False), (0.24, True)])
def test_stations_by_themselves_err_together_as_their_cells_do(drift, exact):
    """The mean error along a joint, of many joints, against what one joint says of it.

    Where a joint drifts by no more than a cell in all, its stations cannot tell: then they claim less.
    """
    rng = np.random.default_rng(41)
    told = []
    gradients = np.zeros((M.N, 3))
    gradients[:, 0] = 1.0 / M.N
    for _ in range(4):
        stations = _stations(rng, drift)
        result = estimate_joint(stations, M._sections(), "independent")
        assert result.stations == tuple(stations)
        poses = [e.components[0].pose for e in stations]
        together = result.couplings[0].between(gradients, poses)
        assert np.all(np.diag(together) == 0.0)
        told.append(together.sum() + M.SD[0] ** 2 / M.N)
    drawn = [_boxed(rng, drift) for _ in range(400)]
    true = np.var([PITCH * (middle - bearing)[0].mean() for bearing, middle in drawn])
    if exact:
        assert np.mean(told) == pytest.approx(true, rel=0.2, abs=0.05 * M.SD[0] ** 2)
    else:
        assert true < np.mean(told) < 0.6 * M.SD[0] ** 2
