"""What an emulated rangefinder looks at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bimfit.errors import SensorError
from bimfit.sensor.noise import Noise
from bimfit.sensor.scip import FloatArray, IntArray, Parameters
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


Scene = StillScene | MovingScene | Sequence[Sweep] | Sequence[IntArray]


def measurer(
    scene: Scene, parameters: Parameters, noise: Noise, rng: np.random.Generator
) -> Callable[[float], IntArray]:
    """Turn a scene into what :class:`~bimfit.sensor.device.Device` asks of it.

    A callable is measured with noise. Recorded sweeps, or arrays of raw values for steps amin to amax, are
    sent as they are, one a rotation, over and over.

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
    if callable(scene):
        still = scene
        return lambda start: noise.measure(np.asarray(still(bearings)), parameters, rng)
    rows = [_values(item, parameters) for item in scene]
    if not rows:
        raise SensorError("there is no sweep to replay")
    return lambda start: rows[round(start / parameters.period) % len(rows)]


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
