"""Joint paths: closed forms on lines, corners and arcs, and round trips."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bimfit.geometry.path import JointPath


def arc(radius, span, legs, centre=(0.0, 0.0, 0.0), shares=None):
    """A horizontal arc: u up, v outwards, so that n = u x v runs counter-clockwise seen from above."""
    angles = span * (np.linspace(0.0, 1.0, legs + 1) if shares is None else shares)
    points = np.asarray(centre) + radius * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    middle = 0.5 * (angles[1:] + angles[:-1])
    u = np.tile([0.0, 0.0, 1.0], (legs, 1))
    v = np.stack([np.cos(middle), np.sin(middle), 0.0 * middle], axis=1)
    return JointPath(points, u, v, closed=bool(np.isclose(span, 2 * np.pi)))


def ell():
    points = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0]])
    u = np.tile([0.0, 0.0, 1.0], (2, 1))
    v = np.array([[0.0, -1, 0], [1, 0, 0]])
    return JointPath(points, u, v)


PATHS = [
    JointPath.straight((1e6, 2e6, 10.0), (1e6 + 3.0, 2e6 + 4.0, 10.0), (0, 0, 1)),
    ell(),
    arc(3.0, np.pi / 3, 20),
    arc(0.5, 2 * np.pi, 36),
    arc(2.0, 1.0, 9, shares=np.array([0, 0.1, 0.15, 0.3, 0.4, 0.45, 0.6, 0.75, 0.9, 1.0])),
]


def axes(frame):
    return np.stack([frame.u, frame.v, frame.n])


@pytest.mark.parametrize("path", PATHS)
@settings(max_examples=40, deadline=None, derandomize=True)
@given(share=st.floats(0.0, 1.0), off=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)))
def test_a_point_of_a_section_projects_to_its_station(path, share, off):
    s = share * path.length
    corner = np.abs(path.stops[1:-1] - s).min(initial=np.inf)
    if not path.curved and corner < 0.15:
        return  # at a sharp corner a point belongs to either leg
    if not path.closed and path.curved:
        s = np.clip(s, 0.05, path.length - 0.05)
    frame = path.rough_frame(s)
    found, distance = path.project(frame.to_world(off)[None])
    error = abs(found[0] - s)
    if path.closed:
        error = min(error, path.length - error)
    assert error < 2e-6
    # the chord, not the arc, is the spine: where s is right the distance is exact
    assert distance[0] == pytest.approx(np.hypot(*off), abs=2e-6)


@pytest.mark.parametrize("path", PATHS)
@settings(max_examples=40, deadline=None, derandomize=True)
@given(share=st.floats(0.0, 1.0))
def test_frames_are_right_handed_and_on_the_spine(path, share):
    frame = path.rough_frame(share * path.length)
    np.testing.assert_allclose(axes(frame) @ axes(frame).T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(frame.u, frame.v), frame.n, atol=1e-12)
    assert path.project(frame.origin[None])[1][0] < 1e-6


@pytest.mark.parametrize("path", PATHS)
@settings(max_examples=40, deadline=None, derandomize=True)
@given(share=st.floats(0.001, 0.999))
def test_flipping_keeps_length_and_place_and_turns_the_mouth(path, share):
    other = path.flipped()
    assert other.length == pytest.approx(path.length, rel=1e-15)
    if np.abs(path.stops - share * path.length).min() < 1e-6:
        return
    here, there = path.rough_frame(share * path.length), other.rough_frame((1.0 - share) * path.length)
    np.testing.assert_allclose(there.origin, here.origin, atol=1e-8)
    np.testing.assert_allclose(axes(there), axes(here) * [[1], [-1], [-1]], atol=1e-8)
    np.testing.assert_allclose(other.flipped().points, path.points)


@pytest.mark.parametrize("path", PATHS)
def test_swapping_turns_across_and_along(path):
    here, there = path.rough_frame(0.3 * path.length), path.swapped().rough_frame(0.7 * path.length)
    np.testing.assert_allclose(axes(there), axes(here) * [[-1], [1], [-1]], atol=1e-8)


@pytest.mark.parametrize("legs", [3, 6, 20, 60])
def test_sections_of_an_arc_are_radial(legs):
    path = arc(3.0, np.pi / 3 if legs > 3 else 0.5, legs)
    worst = 0.0
    for s in np.linspace(0.0, path.length, 97):
        frame = path.rough_frame(s)
        radial = frame.origin / np.linalg.norm(frame.origin)
        worst = max(worst, np.arccos(min(1.0, frame.v @ radial)))
    # a facet's own axes would be off by half its turn at its ends
    assert worst < 0.02 * (path.leg_lengths[0] / 3.0)


def test_uneven_facets_of_an_arc_are_radial_too():
    path = PATHS[4]
    for s in path.stops[1:-1]:
        frame = path.rough_frame(s)
        assert np.arccos(min(1.0, frame.v @ (frame.origin / 2.0))) < 2e-5  # chords stand for arcs


def test_corner_keeps_each_legs_axes():
    path = ell()
    np.testing.assert_array_equal(path.rough_frame(1.999).n, [1, 0, 0])
    np.testing.assert_array_equal(path.rough_frame(2.001).n, [0, 1, 0])
    assert not path.curved


def test_straight_leg_into_an_arc_stays_straight():
    a = arc(1.0, 1.0, 10)
    start = a.points[0] - [0.0, 2.0, 0.0]
    points = np.vstack([start, a.points])
    path = JointPath(points, np.vstack([a.u[:1], a.u]), np.vstack([[[1.0, 0, 0]], a.v]))
    for s in (0.0, 1.0, 1.9, 2.0):
        np.testing.assert_allclose(path.rough_frame(s).n, [0, 1, 0], atol=1e-12)


def test_projection_agrees_with_a_dense_search():
    rng = np.random.default_rng(3)
    path = ell()
    points = rng.uniform(-1, 3, (200, 3))
    s = np.linspace(0.0, path.length, 30001)
    spine = np.array([path.rough_frame(x).origin for x in s[::100]])
    dense = np.concatenate([np.linspace(a, b, 100, endpoint=False) for a, b in itertools.pairwise(spine)])
    dense = np.vstack([dense, spine[-1:]])
    distance = np.linalg.norm(points[:, None] - dense[None], axis=2)
    found, d = path.project(points)
    np.testing.assert_allclose(d, distance.min(axis=1), atol=1e-4)
    np.testing.assert_allclose(
        distance[np.arange(200), np.argmin(np.abs(s[None] - found[:, None]), axis=1)], d, atol=2e-4
    )


def test_ends_are_taken_beyond_them_and_a_ring_goes_round():
    line = PATHS[0]
    np.testing.assert_array_equal(line.rough_frame(-1.0).origin, line.points[0])
    np.testing.assert_allclose(line.rough_frame(9.0).origin, line.points[-1])
    ring = PATHS[3]
    np.testing.assert_allclose(
        ring.rough_frame(ring.length + 0.1).origin, ring.rough_frame(0.1).origin, atol=1e-12
    )


def test_map_coordinates_lose_nothing():
    path = PATHS[0]
    s, d = path.project(path.points[0] + 0.5 * (path.points[1] - path.points[0]) + [0, 0, 0.001])
    assert s[0] == pytest.approx(2.5, abs=1e-8)
    assert d[0] == pytest.approx(0.001, abs=1e-8)


def test_many_points_at_once_equal_one_at_a_time():
    rng = np.random.default_rng(5)
    path = PATHS[2]
    points = path.points[rng.integers(0, 21, 70000)] + rng.normal(0, 0.05, (70000, 3))
    s, d = path.project(points)
    for i in (0, 1, 32767, 32768, 69999):
        one = path.project(points[i : i + 1])
        assert (one[0][0], one[1][0]) == (s[i], d[i])


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: JointPath(np.zeros((1, 3)), np.zeros((0, 3)), np.zeros((0, 3))),
        lambda: JointPath(np.zeros((2, 3)), np.eye(3)[:1], np.eye(3)[1:2]),
        lambda: JointPath(np.array([[0.0, 0, 0], [0, 0, -1]]), np.eye(3)[:1], np.eye(3)[1:2]),
        lambda: JointPath(np.array([[0.0, 0, 0], [0, 0, 1]]), np.eye(3)[:1], np.eye(3)[1:2], closed=True),
    ],
)
def test_what_is_no_path_is_refused(wrong):
    with pytest.raises(ValueError):
        wrong()
