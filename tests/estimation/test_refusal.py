"""What only the gap's inside, the neighbourhood or the whole joint can tell."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import shapely

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation import _kernels_inside as kernels
from bimfit.estimation.company import with_company
from bimfit.estimation.departure import departure
from bimfit.estimation.inside import returns_inside
from bimfit.estimation.likelihood import BeamSet
from bimfit.estimation.lookalikes import gap_places, with_lookalikes
from bimfit.estimation.station import estimate_station
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile
from bimfit.geometry.status import Status
from bimfit.simulation.impostors import bowed, box

spec = importlib.util.spec_from_file_location("refusal_scenario", Path(__file__).with_name("scenario.py"))
S = importlib.util.module_from_spec(spec)
sys.modules["refusal_scenario"] = S
spec.loader.exec_module(S)

FIT, SENSOR = FitConfig(), SensorConfig()


def test_within_agrees_with_shapely():
    rng = np.random.default_rng(1)
    for _ in range(20):
        angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, 9))
        ring = rng.uniform(0.2, 1.0, (9, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points = rng.uniform(-1.0, 1.0, (200, 2))
        oracle = shapely.contains_xy(shapely.Polygon(ring), points)
        assert np.array_equal([kernels.within(x, y, ring) for x, y in points], oracle)


def test_distance_to_a_chain_agrees_with_shapely():
    rng = np.random.default_rng(2)
    chain, points = rng.normal(size=(5, 2)), rng.normal(size=(50, 2))
    oracle = shapely.distance(shapely.LineString(chain), shapely.points(points))
    assert np.allclose([kernels.distance(x, y, chain) for x, y in points], oracle)


def test_returns_from_inside_are_counted_and_those_from_the_floor_are_not():
    sec = S.butt()
    pose = Pose2D()
    for depth, expected in ((-0.015, True), (-0.2, False)):
        floor = box(-0.005, 0.005, depth - 0.002, depth)
        slice_ = S.scan(np.random.default_rng(3), [*sec.components, floor], sigma=1e-4)
        beams = BeamSet.of(slice_.beams)
        count = returns_inside(sec, beams, (pose, pose), (0.0005, 0.0005), 1e-4)
        between = np.abs(slice_.points[:, 0]) < 0.0055
        assert count == (between.sum() if expected else 0)
        if expected:
            assert count > 3


def test_a_wall_behind_the_boards_is_not_inside_and_a_filler_between_them_is():
    sec, pose = S.butt(), Pose2D()
    counts = {}
    for depth in (-0.015, -0.025, -0.030):
        wall = box(-0.3, 0.3, depth - 0.01, depth) if depth < -0.02 else box(-0.012, 0.012, -0.025, depth)
        slices = [S.scan(np.random.default_rng(k), [*sec.components, wall]) for k in range(40)]
        found = [returns_inside(sec, BeamSet.of(s.beams), (pose, pose), (5e-4, 5e-4), 0.003) for s in slices]
        counts[depth] = sum(n > 0 for n in found)
        e = estimate_station(sec, slices[0], pose, SENSOR, FIT)
        assert (e.status.name == "ok") == (depth < -0.02)
    assert counts[-0.015] == 40
    assert counts[-0.025] <= 2
    assert counts[-0.030] <= 1


def _joint(shape, stations=83, seed=5):
    sec = S.butt()
    rng = np.random.default_rng(seed)
    truth = S.reference_truth(rng, sec, n=stations)
    bodies = [shape(c) for c in sec.components]
    out = []
    for a, b, common in zip(truth.a, truth.b, truth.common, strict=True):
        slice_ = S.scan(rng, [bodies[0].moved(a), bodies[1].moved(b)])
        out.append(estimate_station(sec, slice_, S.search_like(rng, common), SENSOR, FIT))
    return out, [sec] * stations


def test_a_bow_that_no_slice_shows_is_found_along_the_joint_and_a_straight_board_is_not():
    straight, sections = _joint(lambda c: c)
    assert all(abs(departure(straight, sections, k).bow) < 4.0 for k in (0, 1))
    assert {e.status.name for e in with_company(straight, sections)} == {"ok"}
    bent, sections = _joint(lambda c: bowed(c, 0.002))
    assert sum(e.status.name == "ok" for e in bent) > 75
    found = [departure(bent, sections, k) for k in (0, 1)]
    # the oracle: a parabola 2 mm high over 0.2 m, less the best line over what is seen of it
    for d in found:
        x = np.abs(d.places[:, 0]) - 0.1125
        rise = 0.002 * (1.0 - (x / 0.1) ** 2)
        oracle = rise - np.polyval(np.polyfit(x, rise, 1), x)
        assert np.all(np.abs(d.offset - oracle) < 4.0 * d.sd)
    judged = with_company(bent, sections)
    assert {e.status.name for e in judged} <= {"weak", "rejected"}
    assert "pooled along the joint" in judged[40].status.reason


def test_a_bow_agrees_with_dense_least_squares():
    stations, sections = _joint(lambda c: bowed(c, 0.003), stations=9)
    found = departure(stations, sections, 0, bins=5)
    # the oracle: one unknown a bin, and a shift and a turn a station
    x, y, which = [], [], []
    for k, (station, section) in enumerate(zip(stations, sections, strict=True)):
        c = station.components[0]
        feet = c.pose.inverse().apply(c.residuals.feet)
        (left, _), (right, top) = section.components[0].bounds
        own = np.abs(feet[:, 1] - top) < 1e-9
        own &= (feet[:, 0] > left + 0.006) & (feet[:, 0] < right - 0.006)
        ray = c.residuals.places[own] - c.residuals.feet[own]
        cosine = np.abs(ray @ c.pose.turn((0.0, 1.0))) / np.hypot(*ray.T)
        x, y = [*x, *feet[own, 0]], [*y, *np.column_stack([-c.residuals.residuals[own], cosine])]
        which += [k] * int(own.sum())
    x, (z, cosine), which = np.array(x), np.array(y).T, np.array(which)
    order = np.argsort(x)
    group = np.empty(len(x), int)
    for g, piece in enumerate(np.array_split(order, 5)):
        group[piece] = g
    one = (which[:, None] == np.arange(9)) / 1.0
    nuisance = np.column_stack([one, one * x[:, None]])
    middle = np.array([x[group == g].mean() for g in range(5)])
    parabola = ((middle - middle.mean()) ** 2)[group]
    steps = (group[:, None] == np.arange(5)) / 1.0

    def left(*columns):
        design = np.column_stack([nuisance, *columns]) / cosine[:, None]
        fit, *_ = np.linalg.lstsq(design, z, rcond=None)
        return float(((z - design @ fit) ** 2).sum()), np.linalg.matrix_rank(design)

    without, with_bend, (full, rank) = left()[0], left(parabola)[0], left(steps)
    assert np.isclose(abs(found.bow), np.sqrt((without - with_bend) * (len(x) - rank) / full), rtol=0.05)


def test_a_station_amid_rejected_ones_is_not_believed():
    good, sections = _joint(lambda c: c, stations=14)
    bad = [dataclasses.replace(e, status=Status("rejected", "x")) for e in good]
    mixed = [*bad[:7], good[7], *bad[8:]]
    judged = with_company(mixed, sections)
    assert judged[7].status.name == "weak"
    assert "around it" in judged[7].status.reason
    few = [*bad[:3], *good[3:]]
    assert all(e.status.name == "ok" for e in with_company(few, sections)[5:])


@pytest.mark.parametrize(("shift", "status"), [(0.010, "ok"), (0.040, "ambiguous")])
def test_equal_boards_beside_are_told_apart_by_the_design_or_not_at_all(shift, status):
    sec = S.butt(width=0.06)
    common = Pose2D(shift, 0.0, 0.0)
    row = [box(x, x + 0.06, -0.025, 0.0) for x in (-0.1575, -0.0725, 0.0125, 0.0975)]
    slice_ = S.scan(np.random.default_rng(8), [Profile.polygon(b.loops[0]).moved(common) for b in row])
    places = gap_places(sec, BeamSet.of(slice_.beams), common)
    assert np.allclose(sorted(p.u - shift for p in places), [-0.085, 0.085], atol=0.002)
    right = estimate_station(sec, slice_, common, SENSOR, FIT)
    assert right.status.name == status
    wrong = estimate_station(sec, slice_, common @ Pose2D(-0.085), SENSOR, FIT)
    assert wrong.status.name == status
    for result in (right, wrong):  # whichever was searched, the one nearer to the design is reported
        middle = 0.5 * (
            result.components[0].pose.apply(sec.gap.mouth[0])
            + result.components[1].pose.apply(sec.gap.mouth[1])
        )
        assert abs(middle[0] - shift) < 0.002
    assert with_lookalikes(right, [], 0.025, 0.02) is right


def test_a_station_far_from_where_those_around_it_agree_is_ambiguous():
    sec = S.butt()
    station = estimate_station(sec, S.scan(np.random.default_rng(2), sec.components), Pose2D(), SENSOR, FIT)
    assert station.status.name == "ok"
    drift = [Pose2D(0.002 * k, 0.001 * k) for k in range(14)]
    joint = [dataclasses.replace(station, s=0.01 * k, combined=pose) for k, pose in enumerate(drift)]
    before = with_company(joint, [sec] * 14)
    assert all(e.status.name != "ambiguous" for e in before)
    joint[6] = dataclasses.replace(joint[6], combined=Pose2D(0.062, 0.006))
    judged = with_company(joint, [sec] * 14)
    assert judged[6].status.name == "ambiguous"
    assert "50 mm from where the stations around it" in judged[6].status.reason
    assert [e.status for e in judged if e is not judged[6]] == [
        e.status for e in before if e is not before[6]
    ]
