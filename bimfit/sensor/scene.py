"""What an emulated rangefinder looks at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bimfit.errors import SensorError
from bimfit.geometry.line_scan import LineScan
from bimfit.sensor.noise import Noise
from bimfit.sensor.scip import FIRST_MEASUREMENT, FloatArray, IntArray, Parameters
from bimfit.sensor.sweep import Sweep

StillScene = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class MovingScene:
    """A scene that changes while it is measured, or a sensor that moves.

    Attributes
    ----------
    ranges : callable (bearings (n,) rad, seconds (n,)) -> ranges (n,) m
        Each beam has its own time, s since the device was switched on.
    """

    ranges: Callable[[FloatArray, FloatArray], FloatArray]


Scene = StillScene | MovingScene | LineScan | Sequence[Sweep] | Sequence[IntArray]


def measurer(
    scene: Scene, parameters: Parameters, noise: Noise, rng: np.random.Generator
) -> Callable[[float], IntArray]:
    """Turn a scene into what :class:`~bimfit.sensor.device.Device` asks of it.

    A callable is measured with noise. Recordings are sent as they are, one sweep a rotation, over and over:
    line scans, sweeps, or arrays of raw values for steps amin to amax. A line scan in its sensor's own
    coordinates has x ahead; any other does not tell where the sensor's front was, and the middle beam of each
    sweep is taken to look ahead.

    Raises
    ------
    SensorError
        When a recording is empty or does not fit the device.
    """
    import scipy.signal  # noqa: F401  slow to import: not when the first scan is due

    steps = np.arange(parameters.amin, parameters.amax + 1)
    bearings = parameters.bearings(steps.astype(np.float64))
    delays = steps / parameters.ares * parameters.period
    if isinstance(scene, MovingScene):
        moving = scene.ranges
        return lambda start: noise.measure(moving(bearings, start + delays), parameters, rng)
    if isinstance(scene, LineScan):
        scene = _from_line_scan(scene, parameters)
    if callable(scene):
        still = scene
        return lambda start: noise.measure(np.asarray(still(bearings)), parameters, rng)
    rows = [_values(item, parameters) for item in scene]
    if not rows:
        raise SensorError("there is no sweep to replay")
    return lambda start: rows[round(start / parameters.period) % len(rows)]


def _from_line_scan(scan: LineScan, parameters: Parameters) -> list[IntArray]:
    rows = []
    own = not scan.origins.any() and not scan.directions[:, 2].any()
    for sweep in scan.split():
        directions = sweep.directions
        if len(directions) > 1 and np.all(directions == directions[0]):
            raise SensorError(
                "beams that are parallel are no rangefinder's sweep",
                file=scan.source or None,
                place=f"sweep {sweep.scan[0]}",
            )
        mm = np.rint(np.nan_to_num(sweep.ranges, nan=0.0) * 1000.0).astype(np.int64)
        # Our own recordings know the codes of what is missing.
        missing = _column(sweep, "code").astype(np.int64) if "code" in sweep.extra else 0
        bearings = np.arctan2(directions[:, 1], directions[:, 0]) if own else _bearings(directions)
        steps = np.rint(bearings / (2.0 * np.pi) * parameters.ares).astype(np.int64)
        steps += parameters.afrt
        values = np.where((mm >= parameters.dmin) & (mm <= parameters.dmax), mm, missing)
        row = np.zeros(parameters.amax - parameters.amin + 1, dtype=np.int64)
        inside = (steps >= parameters.amin) & (steps <= parameters.amax)
        row[steps[inside] - parameters.amin] = values[inside]
        rows.append(row)
    if not any((row >= FIRST_MEASUREMENT).any() for row in rows):
        near, far = parameters.dmin / 1000.0, parameters.dmax / 1000.0
        raise SensorError(f"nothing lies {near:g} to {far:g} m from the sensor", file=scan.source or None)
    return rows


def _bearings(directions: FloatArray) -> FloatArray:
    """Bearings of a sweep's beams (n, 3), rad, the middle one ahead.

    Beams are numbered counter-clockwise seen from above, so the first one looks to the right.
    """
    ahead = directions[len(directions) // 2]
    up = np.cross(directions[0], directions[-1])
    if np.linalg.norm(np.cross(directions[0], ahead)) > 1e-9:
        up = np.cross(directions[0], ahead)
    if np.linalg.norm(up) < 1e-9:
        up = np.cross(ahead, np.eye(3)[int(np.argmin(np.abs(ahead)))])
    left = np.cross(up / np.linalg.norm(up), ahead)
    return np.asarray(np.arctan2(directions @ left, directions @ ahead))


def _column(sweep: LineScan, name: str) -> FloatArray:
    """A further column as numbers; what is none of a sensor's values becomes 0."""
    return np.nan_to_num(np.asarray(sweep.extra[name], dtype=np.float64), posinf=0.0, neginf=0.0)


def _values(item: Sweep | IntArray, parameters: Parameters) -> IntArray:
    size = parameters.amax - parameters.amin + 1
    if not isinstance(item, Sweep):
        values = np.asarray(item, dtype=np.int64)
        if values.shape != (size,) or values.min() < 0:
            raise SensorError(f"a recorded sweep has {size} values, this one {values.shape}")
        return values
    values = np.zeros(size, dtype=np.int64)
    # A cluster's value stands for the step in the middle of it.
    nearest = np.rint(item.steps).astype(np.int64) - parameters.amin
    inside = (nearest >= 0) & (nearest < size)
    values[nearest[inside]] = item.codes[inside]
    return values
