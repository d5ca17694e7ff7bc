"""Faces that a pose depends on, and what missing returns say."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.config import FitConfig, SensorConfig
from bimfit.errors import ConfigError
from bimfit.estimation.station import estimate_station
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.slice import Beams

spec = importlib.util.spec_from_file_location("support_scenario", Path(__file__).with_name("scenario.py"))
S = importlib.util.module_from_spec(spec)
sys.modules["support_scenario"] = S
spec.loader.exec_module(S)

FIT = FitConfig()


def _bodies(sec):
    a, b = Pose2D(0.001, 0.0005, 0.005), Pose2D(-0.001, 0.0, -0.004)
    return (a, b), [sec.components[0].moved(a), sec.components[1].moved(b)]


def _with(slice_, ranges):
    beams = Beams(slice_.beams.origins, slice_.beams.directions, ranges)
    return dataclasses.replace(slice_, beams=beams, points=beams.points)


def _on_bevel(slice_, sec, bodies):
    """Beams that meet A's bevel, by asking where they end."""
    beams = slice_.beams
    true = S.ray_ranges(bodies, beams.origins, beams.directions)
    with np.errstate(invalid="ignore"):
        ends = beams.origins + beams.directions * true[:, None]
    a, b = bodies[0].edges[4]
    n = np.array([b[1] - a[1], a[0] - b[0]]) / np.hypot(*(b - a))
    return np.abs((ends - a) @ n) < 1e-6


def test_a_face_in_the_gap_without_returns_makes_the_station_weak_and_is_named():
    sec = S.groove(root=0.0005)
    _, bodies = _bodies(sec)
    found = []
    for seed in range(6):
        slice_ = S.scan(np.random.default_rng(seed), bodies)
        lost = _on_bevel(slice_, sec, bodies)
        assert lost.sum() >= 6
        whole = estimate_station(sec, slice_, Pose2D(), SensorConfig(), FIT)
        assert whole.status.name == "ok"
        e = estimate_station(
            sec, _with(slice_, np.where(lost, np.nan, slice_.beams.ranges)), Pose2D(), SensorConfig(), FIT
        )
        assert e.status.name != "ok"
        assert "component A" in e.status.reason
        found.append(e.status.reason)
    assert any("its face in the gap, without which nothing fixes it across" in reason for reason in found)


def test_what_the_sensor_loses_anyway_is_no_reason():
    """A third of all returns lost at random, and known to be: bevels of nine beams keep their stations."""
    sec = S.groove(root=0.0005)
    _, bodies = _bodies(sec)
    sensor = SensorConfig(miss_share=0.3)
    names = [
        estimate_station(
            sec, S.scan(np.random.default_rng(seed), bodies, misses=0.3), Pose2D(), sensor, FIT
        ).status.name
        for seed in range(40)
    ]
    assert names.count("ok") >= 39


@pytest.mark.parametrize("make", [S.butt, S.groove])
def test_where_missing_means_nothing_it_changes_nothing(make):
    """Beams without a return may as well not be there; every figure is the same to the last bit."""
    sec = make()
    _, bodies = _bodies(sec)
    sensor = SensorConfig(missing="unknown")
    slice_ = S.scan(np.random.default_rng(3), bodies, misses=0.2)
    beams = slice_.beams
    keep = np.isfinite(beams.ranges)
    fewer = dataclasses.replace(
        slice_, beams=Beams(beams.origins[keep], beams.directions[keep], beams.ranges[keep])
    )
    one, two = (estimate_station(sec, s, Pose2D(), sensor, FIT) for s in (slice_, fewer))
    assert one.status == two.status
    for c, d in zip(one.components, two.components, strict=True):
        np.testing.assert_array_equal(c.pose.as_array(), d.pose.as_array())
        np.testing.assert_array_equal(c.covariance, d.covariance)


def test_a_square_gap_that_only_missing_returns_show_is_weak_where_they_mean_nothing():
    sec = S.butt(depth=0.003)  # no beam ends on the faces in the gap
    truth, bodies = _bodies(sec)
    slice_ = S.scan(np.random.default_rng(5), bodies)
    gap = estimate_station(sec, slice_, Pose2D(), SensorConfig(), FIT)
    unknown = estimate_station(sec, slice_, Pose2D(), SensorConfig(missing="unknown"), FIT)
    assert gap.status.name == "ok"
    assert unknown.status.name == "weak"
    for g, n, t in zip(gap.components, unknown.components, truth, strict=True):
        assert abs(g.pose.u - t.u) < 0.002
        # out of the mouth and in rotation nothing is lost; across the gap nearly everything
        assert n.covariance[0, 0] > 4.0 * g.covariance[0, 0]
        assert np.abs(n.pose.v - t.v) < 4.0 * np.sqrt(n.covariance[1, 1])


def test_a_floor_behind_shows_the_gap_where_missing_means_nothing():
    sec = S.butt()
    truth, bodies = _bodies(sec)
    slice_ = S.scan(np.random.default_rng(6), bodies, floor=-0.15)
    e = estimate_station(sec, slice_, Pose2D(), SensorConfig(missing="unknown"), FIT)
    assert e.status.name == "ok"
    for c, t, mouth in zip(e.components, truth, sec.gap.mouth, strict=True):
        assert np.hypot(*(c.pose.apply(mouth) - t.apply(mouth))) < 0.003


def test_settings_of_missing_returns_are_checked():
    with pytest.raises(ConfigError, match="missing is one of gap, unknown"):
        SensorConfig(missing="nothing")
    with pytest.raises(ConfigError, match="outlier_run"):
        SensorConfig(outlier_run=0.5)
