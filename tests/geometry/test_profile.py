"""Profiles: area and normals against shapely, invariance under motions."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile, signed_area

seeds = st.integers(0, 2**31)


def star(rng, centre=(0.0, 0.0), least=0.5, greatest=1.0):
    """A random simple polygon, in either winding."""
    count = rng.integers(3, 12)
    bearing = (np.arange(count) + rng.uniform(0, 0.45, count)) * 2 * math.pi / count
    radius = rng.uniform(least, greatest, count)
    loop = np.column_stack([radius * np.cos(bearing), radius * np.sin(bearing)]) + centre
    return loop[:: rng.choice([-1, 1])]


@given(seeds)
def test_area_is_shapelys(seed):
    rng = np.random.default_rng(seed)
    outer = star(rng) * 0.2
    assert abs(signed_area(outer)) == pytest.approx(shapely.Polygon(outer).area, abs=1e-15)
    assert Profile.polygon(outer).area == pytest.approx(shapely.Polygon(outer).area, abs=1e-15)


def test_area_with_hole_and_repeated_end():
    square = [(0, 0), (0, 2), (2, 2), (2, 0), (0, 0)]
    hole = [(0.5, 0.5), (1.5, 0.5), (1.5, 1.5), (0.5, 1.5)]
    profile = Profile.polygon(square, holes=[hole])
    assert profile.area == pytest.approx(3.0)
    assert [len(loop) for loop in profile.loops] == [4, 4]
    assert signed_area(profile.loops[0]) == pytest.approx(4.0)
    assert signed_area(profile.loops[1]) == pytest.approx(-1.0)


@given(seeds)
def test_normals_point_out_of_the_material(seed):
    rng = np.random.default_rng(seed)
    outer = star(rng, least=0.6)
    hole = star(rng, least=0.01, greatest=0.05)
    profile = Profile.polygon(outer, holes=[hole])
    solid = shapely.Polygon(outer, [hole])
    assert shapely.Polygon(outer).contains(shapely.Polygon(hole))
    middle = profile.edges.mean(axis=1)
    np.testing.assert_allclose(np.linalg.norm(profile.normals, axis=1), 1.0, atol=1e-12)
    size = np.linalg.norm(profile.edges[:, 1] - profile.edges[:, 0], axis=1)
    clear = size > 1e-3
    step = 1e-9 * profile.normals[clear]
    outside = shapely.contains_xy(solid, *(middle[clear] + step).T)
    inside = shapely.contains_xy(solid, *(middle[clear] - step).T)
    assert not outside.any()
    assert inside.all()


@given(seeds)
def test_motion_keeps_the_area_and_turns_the_normals(seed):
    rng = np.random.default_rng(seed)
    profile = Profile((Profile.polygon(star(rng)).loops), 0.1, ())
    pose = Pose2D(*rng.normal(size=2), rng.uniform(-3, 3))
    moved = profile.moved(pose)
    assert moved.area == pytest.approx(profile.area, abs=1e-12)
    assert moved.guessed_length == 0.1
    np.testing.assert_allclose(moved.normals, pose.turn(profile.normals), atol=1e-6)


def test_surface_follows_the_marks():
    square = Profile.polygon([(0, 0), (1, 0), (1, 1), (0, 1)])
    assert square.surface.tolist() == [True] * 4
    marked = Profile(square.loops, 0.0, (np.array([False, True, False, False]),))
    assert marked.surface.tolist() == [True, False, True, True]
    assert marked.moved(Pose2D(1, 2, 3)).surface.tolist() == [True, False, True, True]


def test_empty_profile():
    empty = Profile(())
    assert empty.empty
    assert empty.area == 0.0
    assert empty.edges.shape == (0, 2, 2)
    assert empty.surface.shape == (0,)


@pytest.mark.parametrize("bad", [[(0, 0), (1, 1)], [(0, 0, 0), (1, 0, 0), (0, 1, 0)]])
def test_what_is_no_loop_is_refused(bad):
    with pytest.raises(ValueError, match="three"):
        Profile.polygon(bad)
