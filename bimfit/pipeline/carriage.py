"""Where a rangefinder is while it is carried along a joint: x ahead, y left, z up, as the device counts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bimfit.errors import ConfigError
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array
from bimfit.scan.trajectory import Trajectory
from bimfit.simulation.rangefinder import aim

_CALENDAR = 1e8
"""Times below this are no seconds since 1970."""


def held_over(section: JointSection, height: float, *, mirrored: bool = False) -> Array:
    """T_world_sensor (4, 4) of a sensor held at ``height`` (m) over the designed mouth, looking into it.

    Its plane is the section's, and it is turned so that its z axis points along the joint, and bearings
    grow from A towards B; ``mirrored``, it is turned about the direction it looks in, the other way up.
    """
    out = aim(section, height)
    axes = np.array([-out, [out[1], -out[0]]])
    ahead, left = section.frame.direction_to_world(axes)
    T = np.eye(4)
    sense = -1.0 if mirrored else 1.0
    T[:3, :3] = np.column_stack([ahead, sense * left, sense * section.frame.n])
    T[:3, 3] = section.frame.to_world(height * out)
    return T


def advanced(T_world_sensor: Array, distances: Array) -> Array:
    """Poses (n, 4, 4) of a sensor that went so far (n,), m, along its own z axis."""
    poses = np.repeat(T_world_sensor[None], len(distances), axis=0)
    poses[:, :3, 3] += np.asarray(distances)[:, None] * T_world_sensor[:3, 2]
    return poses


@dataclass(frozen=True)
class Mount:
    """How a sensor is carried.

    Attributes
    ----------
    speed : float or None
        Along the joint, m/s; of no meaning with a trajectory.
    start : float
        Where along the joint the sensor is when the first sweep looks ahead, m.
    height : float
        Of the sensor over the designed mouth, m.
    pose : ndarray, shape (4, 4), or None
        T_world_sensor when the first sweep looks ahead, where it is known; the sensor then goes along its z
        axis, and ``start`` and ``height`` do not matter. With a trajectory, T_body_sensor.
    trajectory : Trajectory or None
        T_world_body by the sweeps' own clock; one that ends before 1973 by its own times counts from the
        moment when the first sweep looks ahead.
    flip : bool
        Look into the joint's other mouth.
    mirrored : bool
        Bearings grow from B towards A, as of a sensor that is mounted the other way up.
    """

    speed: float | None = None
    start: float = 0.0
    height: float = 0.25
    pose: Array | None = None
    trajectory: Trajectory | None = None
    flip: bool = False
    mirrored: bool = False

    def __post_init__(self) -> None:
        if self.speed is not None and not math.isfinite(self.speed):
            raise ConfigError(f"--speed must be a number, got {self.speed}")
        if self.speed is not None and self.trajectory is not None:
            raise ConfigError("--speed and --trajectory exclude one another", remedy="give one of them")
        if not self.height > 0.0:
            raise ConfigError(f"--height must be more than 0, got {self.height:g} m")

    def poses(self, times: Array, begun: float) -> Array | None:
        """T_world_sensor (n, 4, 4) at times (n,), s; the first sweep looked ahead at ``begun``.

        None outside the trajectory.
        """
        pose = np.eye(4) if self.pose is None else self.pose
        if self.trajectory is None:
            return advanced(pose, (self.speed or 0.0) * (times - begun))
        t = times - self._origin(begun)
        known = self.trajectory.times
        if t.min() < known[0] or t.max() > known[-1]:
            return None
        return np.asarray(self.trajectory.poses(t) @ pose)

    def ended(self, times: Array, begun: float) -> bool:
        """Whether times lie behind the trajectory."""
        return self.trajectory is not None and bool(
            times.max() - self._origin(begun) > self.trajectory.times[-1]
        )

    def somewhere(self) -> Array | None:
        """Where the sensor is at some time (3,), m; None where only the joint itself says that."""
        pose = np.eye(4) if self.pose is None else self.pose
        if self.trajectory is not None:
            middle = self.trajectory.times[len(self.trajectory.times) // 2]
            return np.asarray((self.trajectory.poses([middle])[0] @ pose)[:3, 3])
        return None if self.pose is None else np.asarray(pose[:3, 3])

    def _origin(self, begun: float) -> float:
        assert self.trajectory is not None
        return begun if self.trajectory.times[-1] < _CALENDAR else 0.0
