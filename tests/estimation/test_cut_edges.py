"""Edges cut off at the mouth: the shape that is tried, and what a slice says of it."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation.components import Reshaper, reshaped
from bimfit.estimation.context import station_context
from bimfit.estimation.cut_edges import cut_off, odds_of_cut_edges
from bimfit.estimation.station import estimate_station
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile

spec = importlib.util.spec_from_file_location("cut_scenario", Path(__file__).with_name("scenario.py"))
S = importlib.util.module_from_spec(spec)
sys.modules["cut_scenario"] = S
spec.loader.exec_module(S)


@pytest.mark.parametrize("which", [0, 1])
def test_a_cut_takes_a_triangle_at_the_mouth_and_keeps_what_is_artificial(which):
    sec = S.butt()
    side = (sec.gap.side_a, sec.gap.side_b)[which]
    ends = np.abs(sec.components[which].edges[:, :, 0]).min(axis=1) > 0.1
    profile = dataclasses.replace(sec.components[which], artificial=(ends,))
    cut = cut_off(profile, side, 0.006, 0.020)
    assert profile.area - cut.area == pytest.approx(0.5 * 0.006 * 0.020)
    top = cut.loops[0][:, 0][np.isclose(cut.loops[0][:, 1], 0.0)]
    assert np.abs(top).min() == pytest.approx(0.0125 + 0.006)
    assert (~cut.surface).sum() == ends.sum() == 1
    assert np.array_equal(cut.edges[~cut.surface], profile.edges[ends])
    assert cut_off(profile, side + 0.001, 0.006, 0.020) is None


def test_a_slice_tells_a_bevel_from_a_square_edge():
    sec = S.butt()
    odds = {}
    for kind in ("square", "bevel"):
        bodies = list(sec.components)
        if kind == "bevel":
            bodies = [
                Profile.polygon([(s * 0.0125, 0.0), (s * 0.2, 0.0), (s * 0.2, -0.025), (s * 0.005, -0.025)])
                for s in (-1.0, 1.0)
            ]
        odds[kind] = []
        for seed in range(6):
            slice_ = S.scan(np.random.default_rng(seed), bodies)
            e = estimate_station(sec, slice_, Pose2D(), SensorConfig(), FitConfig())
            assert e.status.name == ("ok" if kind == "square" else "rejected")

            def tried(which, shapes, begin, slice_=slice_, e=e):
                return reshaped(sec, slice_, e, which, shapes, SensorConfig(), FitConfig())

            odds[kind].append(odds_of_cut_edges(sec, tried))
    assert max(odds["square"]) < 4.0
    assert np.median(odds["bevel"]) > 10.0
    assert odds_of_cut_edges(sec, lambda which, shapes, begin: [None] * len(shapes)) == -np.inf


@pytest.mark.parametrize("kind", ["square", "bevel"])
def test_a_glance_leads_to_the_verdict_of_the_whole_integrals(kind):
    sec, odds = S.butt(), []
    cut = [
        cut_off(c, s, 0.006, 0.020)
        for c, s in zip(sec.components, (sec.gap.side_a, sec.gap.side_b), strict=True)
    ]
    for seed in range(10):
        slice_ = S.scan(np.random.default_rng(seed), sec.components if kind == "square" else cut)
        e = estimate_station(sec, slice_, Pose2D(), SensorConfig(), FitConfig())
        context = station_context(sec, slice_, e.combined, SensorConfig(), FitConfig())
        tries = Reshaper(context, e, e.combined, context.window)
        odds.append([odds_of_cut_edges(sec, way) for way in (tries.glances, tries.posteriors)])
    glance, full = np.transpose(odds)
    if kind == "square":
        assert np.abs(np.median(glance - full)) < 1.0
        assert full.max() < 4.0
    # what the whole integrals would refuse is never let pass at a glance
    assert np.all(glance[full > 4.0] > 1.0)
    assert kind == "square" or np.mean(full > 4.0) > 0.8
