"""Where a rangefinder is while it is carried along a joint: x ahead, y left, z up, as the device counts."""

from __future__ import annotations

import numpy as np

from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array
from bimfit.simulation.rangefinder import aim


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
