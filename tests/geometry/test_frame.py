"""Section frames: orthonormal, and motions lifted to the world come back as they were."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.pose import Pose2D, transform_points

seeds = st.integers(0, 2**31)
EAST = np.array([458657.0, 5438232.0, 112.0])


def random_frame(rng, origin=(0.0, 0.0, 0.0)):
    return SectionFrame.from_axes(origin + rng.normal(size=3), rng.normal(size=3), rng.normal(size=3))


def random_pose(rng):
    return Pose2D(*rng.normal(scale=0.05, size=2), rng.uniform(-math.pi, math.pi))


@given(seeds)
def test_axes_are_right_handed_and_u_is_kept(seed):
    rng = np.random.default_rng(seed)
    u, v = rng.normal(size=(2, 3))
    frame = SectionFrame.from_axes((1.0, 2.0, 3.0), u, v)
    np.testing.assert_allclose(frame.rotation.T @ frame.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(frame.u, frame.v), frame.n, atol=1e-12)
    np.testing.assert_allclose(np.cross(frame.u, u), 0.0, atol=1e-12)
    assert frame.v @ v > 0.0


def test_parallel_axes_are_refused():
    with pytest.raises(ValueError, match="span"):
        SectionFrame.from_axes((0, 0, 0), (1, 0, 0), (2, 0, 0))


@given(seeds)
def test_points_and_directions_round_trip(seed):
    rng = np.random.default_rng(seed)
    frame = random_frame(rng)
    p = rng.normal(size=(4, 3))
    np.testing.assert_allclose(frame.to_world(frame.to_section(p)), p, atol=1e-12)
    np.testing.assert_allclose(frame.direction_to_world(frame.direction_to_section(p)), p, atol=1e-12)
    np.testing.assert_allclose(transform_points(frame.T_world_section, frame.to_section(p)), p, atol=1e-12)
    flat = frame.to_world(p[:, :2])
    np.testing.assert_allclose(frame.to_section(flat), np.column_stack([p[:, :2], np.zeros(4)]), atol=1e-12)


@given(seeds)
def test_lift_and_drop_round_trip(seed):
    rng = np.random.default_rng(seed)
    frame, pose = random_frame(rng), random_pose(rng)
    back = frame.drop(frame.lift(pose))
    np.testing.assert_allclose(back.matrix, pose.matrix, atol=1e-12)


@given(seeds)
def test_lifted_motion_moves_world_points_as_the_pose_moves_section_points(seed):
    rng = np.random.default_rng(seed)
    frame, pose = random_frame(rng), random_pose(rng)
    p = rng.normal(size=(5, 3))
    moved = frame.to_section(transform_points(frame.lift(pose), frame.to_world(p)))
    np.testing.assert_allclose(moved, np.column_stack([pose.apply(p[:, :2]), p[:, 2]]), atol=1e-12)


@given(seeds)
def test_lift_holds_at_map_coordinates(seed):
    rng = np.random.default_rng(seed)
    frame, pose = random_frame(rng, EAST), random_pose(rng)
    back = frame.drop(frame.lift(pose))
    np.testing.assert_allclose(back.as_array()[:2], pose.as_array()[:2], atol=1e-8)
    assert back.theta == pytest.approx(pose.theta, abs=1e-12)


@given(seeds)
def test_moved_frame_carries_its_points_along(seed):
    rng = np.random.default_rng(seed)
    frame, pose = random_frame(rng), random_pose(rng)
    p = rng.normal(size=(3, 2))
    np.testing.assert_allclose(frame.moved(pose).to_world(p), frame.to_world(pose.apply(p)), atol=1e-12)


def test_drop_ignores_what_leaves_the_plane():
    frame = SectionFrame.from_axes((0.1, 0.2, 0.3), (0, 1, 0), (0, 0, 1))
    T = frame.lift(Pose2D(0.01, -0.02, 0.03))
    T[:3, 3] += 0.5 * frame.n
    np.testing.assert_allclose(frame.drop(T).as_array(), [0.01, -0.02, 0.03], atol=1e-12)
