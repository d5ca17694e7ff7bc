"""Stations whose own returns do not do: what their neighbours, and their other component, say of them.

A joint may bend at any station, so a motion model's own covariance is not enough: how much the motion really
changes from station to station is read off the joint itself and added.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bimfit.estimation.result import ComponentEstimate, StationEstimate
from bimfit.estimation.trend import Sites, Trend
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.status import Status

FLAG = 16.3
"""Squared distance from the model beyond which a station disagrees: one in a thousand does by chance."""
_FEW = 3
_BETWEEN, _BEYOND = 3.0, 1.0
"""How many spacings from measured neighbours a station may be: between two of them, and past the last."""
_SURE = 0.002
_AGREES = 0.005
SHAKES = 0.015
"""A component this far from where the joint has it was not carried there by a sensor that shakes, m."""


def at_corner(pose: Pose2D, corner: Array) -> Array:
    """Jacobian of the corner's motion by (u, v, theta) of the pose, shape (3, 3)."""
    arm = pose.turn(corner)
    return np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]])


def at_corners(gradients: Array, poses: Sequence[Pose2D | None], corner: Array) -> Array:
    """Gradients (n, 3) by (u, v, theta) of the corner's motion, of those by the poses'; 0 without a pose."""
    rows = np.zeros((len(gradients), 3))
    for i, pose in enumerate(poses):
        if pose is not None:
            rows[i] = np.linalg.solve(at_corner(pose, corner[i]).T, gradients[i])
    return rows


def borrow(
    stations: Sequence[StationEstimate],
    sections: Sequence[JointSection],
    parts: tuple[Sites, Sites],
    fits: tuple[Trend, Trend],
    agreeing: np.ndarray[tuple[int], np.dtype[np.bool_]],
) -> dict[int, StationEstimate]:
    """Stations that are not measured, but near enough to those that are.

    Where one component is measured, the other is carried along with it, for a sensor that shakes moves both.
    Where neither is, both are as the model says, unless the station's combined pose contradicts it.

    Parameters
    ----------
    agreeing : ndarray of bool, shape (n,)
        Stations that are measured and do not disagree with the model.

    Returns
    -------
    dict of int to StationEstimate
        ``weak`` each; empty where less than half of the joint, or fewer than three stations, are measured.
    """
    n, s = len(stations), parts[0].s
    good = sum(e.status.name == "ok" for e in stations)
    if n < _FEW or good < _FEW or 2 * int(agreeing.sum()) < n:
        return {}
    spacing = float(np.median(np.diff(s))) * (1.0 + 1e-3)
    out = {}
    for i, (station, section) in enumerate(zip(stations, sections, strict=True)):
        own = [c.status.measured and c.pose is not None for c in station.components]
        if station.status.measured or any(c.empty for c in section.components):
            continue
        if all(own):  # refused as a whole: what its components say does not count either
            own = [False, False]
        left, right = s[:i][agreeing[:i]], s[i + 1 :][agreeing[i + 1 :]]
        before = float(s[i] - left[-1]) / spacing if len(left) else math.inf
        after = float(right[0] - s[i]) / spacing if len(right) else math.inf
        far, close = max(before, after), min(before, after)
        if far <= _BETWEEN or (math.isinf(far) and close <= _BEYOND):
            changes = _changes(fits, s, agreeing, own, between=math.isfinite(far)) * max(close, 1.0) ** 2
            made = _made(station, section, parts, fits, i, own, changes)
            if made is not None:
                out[i] = made
    return out


def _changes(
    fits: tuple[Trend, Trend],
    s: Array,
    agreeing: np.ndarray[tuple[int], np.dtype[np.bool_]],
    own: Sequence[bool],
    *,
    between: bool,
) -> Array:
    """Mean square of what a station's motion adds to its neighbours', shape (3,): u, v and theta."""
    a, b = (t.value[agreeing] for t in fits)
    x = a - b if any(own) else 0.5 * (a + b)
    step = 0.5 * (x[2:] - 2.0 * x[1:-1] + x[:-2]) if between else np.diff(x, axis=0)
    return np.asarray(np.mean(step**2, axis=0))


def _made(
    station: StationEstimate,
    section: JointSection,
    parts: tuple[Sites, Sites],
    fits: tuple[Trend, Trend],
    i: int,
    own: Sequence[bool],
    changes: Array,
) -> StationEstimate | None:
    """The station with borrowed poses; None where they are too uncertain or contradicted."""
    corners = section.gap.mouth
    model = [
        Pose2D.about(corner, *(float(x) for x in t.value[i])) for t, corner in zip(fits, corners, strict=True)
    ]
    poses: list[Pose2D] = list(model)
    spreads: list[Array] = [np.asarray(t.covariance[i] + np.diag(changes)) for t in fits]
    variance = 0.25 * sum(float(np.trace(V[:2, :2])) for V in spreads)
    has = own.index(True) if any(own) else None
    if has is not None and parts[has].known[i] and fits[has].distance[i] <= FLAG:
        # the one that is measured agrees with the model: nothing shook here
        spreads[has] = fits[has].covariance[i]
        variance = 0.25 * sum(float(np.trace(V[:2, :2])) for V in spreads)
    elif has is not None:
        c = station.components[has]
        assert c.pose is not None and c.covariance is not None
        off = c.pose.apply(corners[has]) - model[has].apply(corners[has])
        if float(np.hypot(*off)) > SHAKES:
            return None
        J = at_corner(c.pose, corners[has])
        poses[has], spreads[has] = c.pose, np.asarray(J @ c.covariance @ J.T)
        # the middle of the gap goes with the component that is known, and by half with the other
        variance = float(np.trace(spreads[has][:2, :2])) + 0.25 * float(np.trace(spreads[1 - has][:2, :2]))
        poses[1 - has] = c.pose @ model[has].inverse() @ model[1 - has]
        across = poses[1 - has].apply(corners[1 - has]) - c.pose.apply(corners[has])
        K = np.array([[1.0, 0.0, -across[1]], [0.0, 1.0, across[0]], [0.0, 0.0, 1.0]])
        spreads[1 - has] = spreads[1 - has] + K @ spreads[has] @ K.T
    middle = 0.5 * (poses[0].apply(corners[0]) + poses[1].apply(corners[1]))
    if variance > _SURE**2:
        return None
    if station.combined is not None and not any(own):
        placed = station.combined.apply(0.5 * (corners[0] + corners[1]))
        if float(np.hypot(*(middle - placed))) > _AGREES:
            return None
    source = "the other component and its neighbours" if any(own) else "its neighbours"
    status = Status("weak", f"its own returns do not fix it ({station.status.reason}); taken from {source}")
    made: list[ComponentEstimate] = []
    for c, pose, V, corner, kept in zip(station.components, poses, spreads, corners, own, strict=True):
        J = np.asarray(np.linalg.inv(at_corner(pose, corner)))
        new = replace(c, pose=pose, covariance=J @ V @ J.T)
        made.append(new if kept else replace(new, status=status))
    return replace(station, components=(made[0], made[1]), status=status)
