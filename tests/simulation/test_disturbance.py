"""What spoils a scan: as much of it as asked for, where it is said to be, and nothing else changed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from bimfit.errors import ConfigError
from bimfit.simulation.disturbance import Disturbance
from bimfit.simulation.motion import random_truth
from bimfit.simulation.rangefinder import simulate_scan
from bimfit.simulation.scenario import Scenario


def _ranges(joint, what, seed=4):
    sections = joint(np.arange(20) * 0.01)
    base = Scenario(sigma=0.003)
    truth = random_truth(sections, base, seed)
    spoilt = dataclasses.replace(base, disturbance=what)
    return tuple(simulate_scan(sections, truth, s, seed).ranges.reshape(20, -1) for s in (base, spoilt))


@pytest.mark.parametrize("what", [Disturbance(glare=0.3), Disturbance(spikes=0.3)])
def test_about_the_share_asked_for_is_false_and_the_rest_untouched(joint, what):
    clean, spoilt = _ranges(joint, what)
    same = (clean == spoilt) | (np.isnan(clean) & np.isnan(spoilt))
    share = 1.0 - same[np.isfinite(clean)].mean()
    assert 0.27 < share < 0.36
    assert np.isnan(spoilt[np.isnan(clean)]).all()


def test_streaks_come_in_runs_off_the_surface(joint):
    clean, spoilt = _ranges(joint, Disturbance(glare=0.2))
    false = np.isfinite(clean) & (clean != spoilt)
    runs = np.diff(np.flatnonzero(np.diff(np.pad(false.astype(int), ((0, 0), (1, 1))).ravel()))).tolist()[::2]
    assert 3.0 < np.mean(runs) < 7.0
    off = np.abs(spoilt - clean)[false]
    assert np.percentile(off, 10) > 0.005
    assert off.max() < 0.1


def test_ghosts_are_the_joint_once_more_at_one_place(joint):
    clean, spoilt = _ranges(joint, Disturbance(ghosts=0.5))
    false = np.isfinite(clean) & np.isfinite(spoilt) & (clean != spoilt)
    off = (spoilt - clean)[false]
    assert np.std(off) < 0.015 < abs(np.median(off)) + 0.005


def test_a_burst_takes_a_whole_face_of_one_component(joint):
    clean, spoilt = _ranges(joint, Disturbance(bursts=1.0))
    for before, after in zip(clean, spoilt, strict=True):
        lost = np.flatnonzero(np.isfinite(before) & np.isnan(after))
        assert len(lost) >= 1
        assert np.ptp(lost) == len(lost) - 1


def test_mixed_pixels_lie_between(joint):
    clean, spoilt = _ranges(joint, Disturbance(mixed=1.0))
    changed = (clean != spoilt) & ~(np.isnan(clean) & np.isnan(spoilt))
    assert 0 < changed.sum(axis=1).max() <= 4
    assert np.isfinite(spoilt[changed]).all()


def test_shares_are_checked():
    with pytest.raises(ConfigError, match="glare must lie in"):
        Disturbance(glare=1.5)
