"""Stations that disagree with the motion along the joint: neither lost beams nor a joint that jumps."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.estimation.disagreement import _with_lost_beams
from bimfit.estimation.motion import estimate_joint

spec = importlib.util.spec_from_file_location("along", Path(__file__).with_name("test_motion.py"))
M = importlib.util.module_from_spec(spec)
sys.modules["along"] = M
spec.loader.exec_module(M)


def _kinked(seed):
    rng = np.random.default_rng(seed)
    return rng, M._truth("kinked", rng)


def test_a_joint_that_jumps_from_one_station_to_the_next_is_followed():
    flagged = 0
    for seed in range(4):
        rng, truth = _kinked(seed)
        truth[:, 40:] += np.array([14e-3, -11e-3, 0.05])
        result = estimate_joint(M._stations(rng, truth), M._sections(), "auto")
        flagged += sum(e.status.name != "ok" for e in result.stations[35:46])
        assert np.abs(M._errors(result, truth)[:, 36:45, :2]).max() < 1.5e-3
    assert flagged <= 1


@pytest.mark.parametrize(
    ("off", "components", "flagged"),
    [(8e-3, (0,), True), (8e-3, (1,), True), (8e-3, (0, 1), False), (85e-3, (0, 1), True)],
)
def test_a_station_that_stands_alone_is_believed_if_both_components_say_so_and_it_is_no_other_gap(
    off, components, flagged
):
    found, said = 0, []
    for seed in range(5):
        rng, truth = _kinked(seed)
        at = 3 + 8 * int(rng.integers(2, 8))
        for which in components:
            truth[which, at, 0] += off
        result = estimate_joint(M._stations(rng, truth), M._sections(), "auto")
        found += result.stations[at].status.name != "ok"
        said += re.findall(r"(\S+) mm away", result.stations[at].status.reason)
    assert found == 5 if flagged else found <= 2
    if flagged:  # in words by how much, though the motion bends to follow it
        assert np.allclose([float(mm) * 1e-3 for mm in said], off, atol=2.5e-3)


def test_a_lost_beam_costs_its_odds_and_no_more():
    spread = np.diag([1e-3, 1e-3, 1e-2]) ** 2
    gap_side, other = np.array([3.2e-3, 0.0, 0.0]), np.array([0.0, 3.2e-3, 0.0])
    price = 2.0 * np.log(0.9 / 0.1)
    assert _with_lost_beams(gap_side, spread, 1.6e-3, 0.1) == pytest.approx(
        min(3.2**2, 2.0 * price, 1.6**2 + price)
    )
    for e, step in ((other, 1.6e-3), (-gap_side, 1.6e-3), (gap_side, 0.0)):
        assert _with_lost_beams(e, spread, step, 0.1) == pytest.approx(3.2**2)
    assert _with_lost_beams(2.0 * gap_side, spread, 1.6e-3, 0.1) < 0.5 * 6.4**2


def test_estimates_do_not_change_with_what_is_flagged():
    rng, truth = _kinked(3)
    stations = M._stations(rng, truth)
    lost = [dataclasses.replace(e, sensor=dataclasses.replace(e.sensor, miss_share=0.3)) for e in stations]
    one, two = (estimate_joint(e, M._sections(), "auto") for e in (stations, lost))
    assert np.array_equal(M._errors(one, truth), M._errors(two, truth))
