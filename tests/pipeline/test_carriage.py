"""How a sensor is carried: over the joint, from a pose on, along a trajectory."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bimfit.bim.stations import design_sections
from bimfit.config import JointConfig
from bimfit.errors import ConfigError
from bimfit.geometry.line_scan import LineScan
from bimfit.pipeline.carriage import Mount, advanced, held_over
from bimfit.pipeline.survey import model_joints
from bimfit.scan.trajectory import Trajectory
from bimfit.simulation.motion import random_truth
from bimfit.simulation.rangefinder import simulate_scan
from bimfit.simulation.scenario import Scenario


@pytest.fixture(scope="module")
def section(samples):
    model, (joint, *_) = model_joints(samples / "square-butt-ifc4.ifc", JointConfig())
    return design_sections(model, joint, [0.4])[0]


def own_sweep(bearings, ranges):
    """Beams in a sensor's own coordinates: x ahead, y left."""
    directions = np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(len(bearings))])
    return LineScan.of(np.zeros(len(bearings)), np.zeros((len(bearings), 3)), directions, ranges)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_sensor_held_over_the_joint_sees_what_the_virtual_one_does(section, mirrored):
    scenario = Scenario(sensor_height=0.3, sigma=0.0)
    seen = simulate_scan((section,), random_truth((section,), scenario, 1), scenario, 1)
    bearings = scenario.bearings * (-1.0 if mirrored else 1.0)
    T = held_over(section, 0.3, mirrored=mirrored)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    own = own_sweep(bearings, seen.ranges).transformed(T)
    np.testing.assert_allclose(own.origins, seen.origins, atol=1e-12)
    np.testing.assert_allclose(own.directions, seen.directions, atol=1e-12)


def test_it_goes_along_its_own_z_axis():
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    T[:3, 3] = [458657.0, 5438232.0, 3.0]
    poses = Mount(speed=0.05, pose=T).poses(np.array([10.0, 12.0]), begun=10.0)
    np.testing.assert_allclose(poses[0], T)
    np.testing.assert_allclose(poses[1], T @ [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]])
    np.testing.assert_allclose(advanced(T, [0.0, 0.1]), poses)


def way(times):
    n = len(times)
    turns = Rotation.from_rotvec([[0.0, 0.0, 0.1 * k] for k in range(n)])
    return Trajectory(
        np.array(times), np.column_stack([np.arange(n), np.zeros(n), np.ones(n)]), turns.as_quat()
    )


def test_a_trajectory_counts_by_the_calendar_or_from_the_first_sweep():
    arm = np.eye(4)
    arm[:3, 3] = [0.0, 0.5, 0.0]
    now = 1.7e9
    for times, begun in (([now, now + 1.0, now + 2.0], now + 0.5), ([0.0, 1.0, 2.0], now)):
        mount = Mount(trajectory=way(times), pose=arm)
        at = times[0] + (now if times[0] == 0.0 else 0.0)
        poses = mount.poses(at + np.array([0.0, 1.5]), begun)
        np.testing.assert_allclose(
            poses[0], [[1, 0, 0, 0], [0, 1, 0, 0.5], [0, 0, 1, 1], [0, 0, 0, 1]], atol=1e-12
        )
        turn = Rotation.from_rotvec([0.0, 0.0, 0.15]).as_matrix()
        np.testing.assert_allclose(poses[1][:3, 3], [1.5, 0.0, 1.0] + turn @ [0.0, 0.5, 0.0], atol=1e-6)
        early, late = at + np.array([-0.1, 0.1]), at + np.array([1.9, 2.1])
        assert mount.poses(early, begun) is None and not mount.ended(early, begun)
        assert mount.poses(late, begun) is None and mount.ended(late, begun)
    assert mount.somewhere() == pytest.approx([1.0 - 0.5 * np.sin(0.1), 0.5 * np.cos(0.1), 1.0])


def test_mounts_that_cannot_be():
    with pytest.raises(ConfigError, match="exclude one another"):
        Mount(speed=0.05, trajectory=way([0.0, 1.0]))
    with pytest.raises(ConfigError, match="--height"):
        Mount(height=-0.1)
    with pytest.raises(ConfigError, match="--speed"):
        Mount(speed=float("nan"))
    assert Mount().somewhere() is None
