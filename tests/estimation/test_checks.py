"""Refusals: what is not the joint gets no confident number; what is, keeps its own."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation._kernels_residuals import excused, longest_run
from bimfit.estimation.station import estimate_station
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile
from bimfit.geometry.slice import Slice

spec = importlib.util.spec_from_file_location("checks_scenario", Path(__file__).with_name("scenario.py"))
S = importlib.util.module_from_spec(spec)
sys.modules["checks_scenario"] = S
spec.loader.exec_module(S)

FIT = FitConfig()


def _box(x0, x1, z0, z1):
    return Profile.polygon([(x0, z0), (x1, z0), (x1, z1), (x0, z1)])


def _scene(kind, rng):
    """What the sensor sees, and where a search might have put the joint."""
    sec = S.butt()
    common = Pose2D(*rng.uniform(-0.015, 0.015, 2), rng.uniform(-0.08, 0.08))
    a, b = sec.components[0].moved(common), sec.components[1].moved(common)
    if kind == "missing":
        return common, [a]
    if kind == "wall":
        return common, [_box(-0.5, 0.5, -0.03, 0.0).moved(common)]
    if kind == "pipe":
        t = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
        radius = rng.uniform(0.03, 0.08)
        return common, [Profile.polygon(np.stack([radius * np.cos(t), radius * np.sin(t) - 0.03], axis=1))]
    if kind == "wide":
        return common, [a.moved(Pose2D(-0.020, 0.0, 0.0)), b.moved(Pose2D(0.020, 0.0, 0.0))]
    assert kind == "clutter"
    spots = zip(
        rng.uniform(-0.15, 0.12, 8), rng.uniform(0.01, 0.04, 8), rng.uniform(-0.1, 0.08, 8), strict=True
    )
    return common, [_box(x, x + w, z - 0.03, z) for x, w, z in spots]


@pytest.mark.parametrize("kind", ["missing", "wall", "pipe", "wide", "clutter"])
@pytest.mark.parametrize("share", [0.0, 0.03])
def test_what_is_not_the_joint_is_never_ok(kind, share):
    sensor = SensorConfig(outlier_share=max(share, 0.01), miss_share=max(share, 0.01))
    verdicts = []
    for seed in range(12):
        rng = np.random.default_rng(500 + seed)
        common, bodies = _scene(kind, rng)
        slice_ = S.scan(rng, bodies, outliers=share, misses=share)
        start = S.search_like(rng, common) @ Pose2D(rng.uniform(-0.02, 0.02), 0.0, 0.0)
        verdicts.append(estimate_station(S.butt(), slice_, start, sensor, FIT).status)
    assert all(v.reason for v in verdicts)
    assert sum(v.name == "ok" for v in verdicts) <= (0 if kind != "wall" or not share else 1)


@pytest.mark.parametrize("share", [0.0, 0.05])
def test_good_stations_are_kept(share):
    sec = S.butt()
    sensor = SensorConfig(outlier_share=max(share, 0.01), miss_share=max(share, 0.01))
    rng = np.random.default_rng(77)
    truth = S.reference_truth(rng, sec, n=60)
    names = []
    for a, b, c in zip(truth.a, truth.b, truth.common, strict=True):
        bodies = [sec.components[0].moved(a), sec.components[1].moved(b)]
        slice_ = S.scan(rng, bodies, outliers=share, misses=share)
        names.append(estimate_station(sec, slice_, S.search_like(rng, c), sensor, FIT).status.name)
    assert names.count("ok") >= 58


def test_a_floor_behind_the_joint_counts_like_nothing():
    """The same noise with and without a floor under the gap gives the same answer within its sigma."""
    sec = S.butt()
    a, b = Pose2D(0.003, 0.001, 0.01), Pose2D(-0.002, -0.002, -0.01)
    bodies = [sec.components[0].moved(a), sec.components[1].moved(b)]
    without = estimate_station(sec, S.scan(np.random.default_rng(4), bodies), Pose2D(), SensorConfig(), FIT)
    with_floor = estimate_station(
        sec, S.scan(np.random.default_rng(4), bodies, floor=-0.1), Pose2D(), SensorConfig(), FIT
    )
    for one, two, truth in zip(without.components, with_floor.components, (a, b), strict=True):
        sd = np.sqrt(np.diag(one.covariance))
        assert np.all(np.abs(one.pose.as_array() - two.pose.as_array()) < sd)
        assert np.all(np.abs(two.pose.as_array() - truth.as_array()) < 4.0 * sd)


def test_a_plain_cloud_gives_what_its_beams_give_in_any_order():
    sec = S.butt()
    rng = np.random.default_rng(9)
    slice_ = S.scan(rng, sec.components)
    beams = estimate_station(sec, slice_, Pose2D(), SensorConfig(), FIT)
    for view in (slice_.viewpoint, None):
        cloud = Slice(0.0, slice_.points[rng.permutation(len(slice_.points))], None, view)
        result = estimate_station(sec, cloud, Pose2D(), SensorConfig(), FIT)
        assert result.virtual
        assert result.status.name == "ok"
        for one, two in zip(beams.components, result.components, strict=True):
            sd = np.sqrt(np.diag(one.covariance))
            assert np.all(np.abs(one.pose.as_array() - two.pose.as_array()) < 1.5 * sd)


def test_points_at_random_are_weak_across_the_gap_and_say_so():
    sec = S.butt()
    good = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        points = S.scan(rng, sec.components).points
        cloud = Slice(0.0, points[rng.choice(len(points), 44, replace=False)], None, None)
        result = estimate_station(sec, cloud, Pose2D(), SensorConfig(), FIT)
        assert result.status.name in ("weak", "ambiguous", "rejected")
        for c in result.components:
            if c.pose is not None and c.status.measured:
                good += 1
                corner = np.array([0.0125, 0.0])
                arm = c.pose.turn(corner)
                J = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
                sd = np.sqrt(np.diag(J @ c.covariance @ J.T))
                assert np.all(np.abs(c.pose.apply(corner) - corner) < 4.0 * sd)
    assert good >= 8


def test_a_clipped_profile_is_not_dragged_to_its_clipped_end():
    """The boards go on for a metre; the profile ends 0.1 m from the joint, marked artificial."""
    h = 0.0125
    long_a, long_b = _box(-1.0, -h, -0.025, 0.0), _box(h, 1.0, -0.025, 0.0)
    sec = S.butt(width=0.1 - h)
    parts = []
    for component in sec.components:
        ends = np.abs(component.edges[:, :, 0]).min(axis=1) > 0.099
        parts.append(dataclasses.replace(component, artificial=(ends,)))
        assert ends.sum() == 1
    sec = dataclasses.replace(sec, components=(parts[0], parts[1]))
    rng = np.random.default_rng(3)
    a, b = Pose2D(0.004, 0.0, 0.0), Pose2D(-0.003, 0.0, 0.0)
    result = estimate_station(
        sec, S.scan(rng, [long_a.moved(a), long_b.moved(b)]), Pose2D(), SensorConfig(), FIT
    )
    assert result.status.name == "ok"
    for c, truth in zip(result.components, (a, b), strict=True):
        assert abs(c.pose.u - truth.u) < 0.0015


@pytest.mark.parametrize("seed", [8, 29])
def test_beams_that_graze_a_deep_gap_do_not_reject_it(seed):
    """Along a side 2.7 m deep a turn by a milliradian moves ranges by decimetres."""
    sec = S.butt(gap=0.030, depth=2.7)
    rng = np.random.default_rng(900 + seed)
    truth = S.reference_truth(rng, sec, n=2, own=0.004, own_angle=1.0)
    common, bodies = (
        truth.common[0],
        [sec.components[0].moved(truth.a[0]), sec.components[1].moved(truth.b[0])],
    )
    look = common.turn((rng.uniform(-0.1, 0.1), -1.0))
    slice_ = S.scan(rng, bodies, eye=tuple(common.apply((0.0, 0.25))), look=look)
    result = estimate_station(sec, slice_, S.search_like(rng, common), SensorConfig(), FIT)
    assert result.status.measured
    poses = [c.pose for c in result.components]
    error = S.gap_pose(sec, *poses) - S.gap_pose(sec, truth.a[0], truth.b[0])
    assert np.hypot(error[0], error[1]) < 2e-3


def test_a_grazing_return_is_excused_only_as_far_as_its_pose_is_uncertain():
    rho, sd = np.full(4, 0.5), np.array([0.02, 0.02, 0.001, 0.02])
    cosine = np.array([-0.05, -0.05, -0.05, -0.9])
    r = np.array([0.55, 0.65, 0.55, 0.55])
    found = [excused(*row, 0.003) for row in zip(r, rho, sd, cosine, strict=True)]
    assert found == [True, False, False, False]


def test_longest_run():
    assert longest_run(np.array([False, True, True, False, True])) == 2
    assert longest_run(np.zeros(3, bool)) == 0
    assert longest_run(np.ones(4, bool)) == 4


def test_a_component_that_a_dozen_returns_support_is_weak_and_says_so():
    sec = S.butt()
    slice_ = S.scan(np.random.default_rng(4), sec.components, step=8.0 * S.STEP, half=10, sigma=0.001)
    result = estimate_station(sec, slice_, Pose2D(), SensorConfig(sigma=0.001), FIT)
    assert all(6 <= c.n_inliers <= 12 for c in result.components)
    assert all(c.status.name == "weak" and "too few" in c.status.reason for c in result.components)
    assert result.status.name == "weak"
