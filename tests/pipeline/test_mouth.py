"""Mouths of joints with corners: where they are, and which stations of the spine lie under them."""

import dataclasses
import json
import math

import numpy as np
import pytest

from bimfit.bim.joint import Joint
from bimfit.cli.main import main
from bimfit.geometry.path import JointPath
from bimfit.pipeline.mouth import mouth_paths, spine_stations
from bimfit.simulation.accuracy import estimates_of, gap_errors
from bimfit.simulation.truth import read_truth

DEPTH = 0.06


def joint(points, v, depth=DEPTH, closed=False):
    points, v = np.asarray(points, float), np.asarray(v, float)
    n = np.diff(points, axis=0)
    u = np.cross(v, n / np.linalg.norm(n, axis=1, keepdims=True))
    path = JointPath(points, u, v, closed)
    return Joint("a", ("A", "B"), "square-butt", 0.01, path.length, depth, path, True, "open")


# up the z axis, then along y; the gap is across x and the mouth on the inside or the outside of the corner
L_POINTS = [(0, 0, 0), (0, 0, 0.2), (0, 0.3, 0.2)]
INSIDE, OUTSIDE = [(0, 1, 0), (0, 0, -1)], [(0, -1, 0), (0, 0, 1)]


def test_inside_a_corner_the_mouth_is_shorter_and_its_stations_keep_their_height():
    one = joint(L_POINTS, INSIDE)
    mouth = mouth_paths(one)[0]
    np.testing.assert_allclose(mouth.points, [(0, 0.03, 0), (0, 0.03, 0.17), (0, 0.3, 0.17)], atol=1e-12)
    along = np.array([0.0, 0.1, 0.17 - 1e-9, 0.17 + 1e-9, 0.17 + 0.1, mouth.length])
    s = spine_stations(one.path, mouth, along)
    np.testing.assert_allclose(s, [0.0, 0.1, 0.17, 0.23, 0.33, 0.5], atol=1e-6)
    # what holds: the plane of the station goes through the mouth's point
    for station, where in zip(s, along, strict=True):
        frame = one.path.rough_frame(station)
        assert abs((mouth.rough_frame(where).origin - frame.origin) @ frame.n) < 1e-6


def test_outside_a_corner_there_are_points_without_a_section():
    one = joint(L_POINTS, OUTSIDE)
    mouth = mouth_paths(one)[0]
    np.testing.assert_allclose(mouth.points[1], (0, -0.03, 0.23), atol=1e-12)
    along = np.array([0.1, 0.199, 0.215, 0.245, 0.261, 0.3])
    np.testing.assert_allclose(spine_stations(one.path, mouth, along), [0.1, 0.199, 0.201, 0.24], atol=1e-9)


def test_a_turn_within_the_surface_and_a_straight_joint_keep_their_stations():
    ring = joint([(0, 0, 0), (1, 0, 0), (1, 0.5, 0), (0, 0.5, 0), (0, 0, 0)], [(0, 0, 1)] * 4, closed=True)
    mouth = mouth_paths(ring)[0]
    np.testing.assert_allclose(mouth.points, np.add(ring.path.points, (0, 0, 0.03)), atol=1e-12)
    along = np.linspace(0.01, 2.99, 31)
    np.testing.assert_allclose(spine_stations(ring.path, mouth, along), along, atol=1e-12)
    straight = joint([(0, 0, 0), (0, 2, 0)], [(0, 0, 1)])
    np.testing.assert_allclose(
        spine_stations(straight.path, mouth_paths(straight)[0], along[:20]), along[:20], atol=1e-12
    )


def test_a_curve_keeps_the_shares_of_its_facets():
    angle = np.linspace(0.0, math.pi / 2, 10)
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(10)], axis=1)
    middle = 0.5 * (out[1:] + out[:-1])
    one = joint(out, middle / np.linalg.norm(middle, axis=1, keepdims=True), depth=0.2)
    mouth = mouth_paths(one)[0]
    assert mouth.length == pytest.approx(1.1 * one.path.length, rel=0.015)
    assert spine_stations(one.path, mouth, np.array([0.5 * mouth.length]))[0] == pytest.approx(
        0.5 * one.path.length
    )
    # tighter than the joint is deep: the spine stands for its mouth
    deep = dataclasses.replace(one, depth=3.0)
    assert mouth_paths(deep)[1].length == one.path.length


def test_beside_a_corner_no_station_is_wrong_unseen(shared, tmp_path):
    """A joint of 195 and 63 mm round a corner of 100 degrees, seen from its inside."""
    path, pair = str(shared / "ifc" / "MULTICOM-banden.ifc"), "89vsk"
    scan, truth = str(tmp_path / "s.npz"), str(tmp_path / "t.json")
    assert main(["simulate", path, "--joint", pair, "--seed", "12", "-o", scan, "--truth", truth]) == 0
    assert main(["fit", path, scan, "--joint", pair, "-o", str(tmp_path / "o"), "--no-pictures"]) in (0, 1)
    result = json.loads((tmp_path / "o" / "results.json").read_text())["joints"][0]
    errors = gap_errors(estimates_of(result), read_truth(truth)[0])
    ok = np.array([station["status"] == "ok" for station in result["stations"]])
    assert ok.sum() >= 14
    assert errors.position[ok].max() < 0.003
