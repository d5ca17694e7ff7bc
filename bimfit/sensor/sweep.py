"""One turn of a rangefinder, and many of them as a line scan."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import SensorError
from bimfit.geometry.line_scan import LineScan
from bimfit.sensor.scip import FIRST_MEASUREMENT, FloatArray, IntArray, Parameters, ScanRequest, reason


@dataclass(frozen=True)
class Sweep:
    """One turn, as measured.

    Attributes
    ----------
    index : int
        Sweeps delivered before this one.
    ranges : ndarray, shape (n,)
        m; NaN where there is no measurement, also beyond the device's own DMAX; see :attr:`reasons`.
    codes : ndarray, shape (n,)
        What the device sent: mm, or error codes below 20.
    bearings : ndarray, shape (n,)
        rad, 0 ahead, counter-clockwise seen from above.
    steps : ndarray, shape (n,)
        The device's steps; halves where an even number of steps is merged.
    delays : ndarray, shape (n,)
        When each beam was measured, s after the stamp.
    stamp_device : float
        The device's clock at step 0, s, unwrapped.
    stamp_host : float
        The same moment on the host's clock, s since 1970.
    received : float
        When its last byte was read, on the host's clock, s since 1970; NaN where that is not known.
    """

    index: int
    ranges: FloatArray
    codes: IntArray
    bearings: FloatArray
    steps: FloatArray
    delays: FloatArray
    stamp_device: float
    stamp_host: float
    received: float = math.nan

    @classmethod
    def from_values(
        cls,
        index: int,
        values: IntArray,
        request: ScanRequest,
        parameters: Parameters,
        stamp_device: float,
        stamp_host: float,
        received: float = math.nan,
    ) -> Sweep:
        """Make it of a scan's values, shape (request.size,)."""
        steps = request.middles
        # Two characters end at 4095, which may stand for anything farther.
        most = parameters.dmax if request.width == 3 else min(parameters.dmax, 4094)
        measured = (values >= FIRST_MEASUREMENT) & (values <= most)
        return cls(
            index,
            np.where(measured, values / 1000.0, np.nan),
            values,
            parameters.bearings(steps),
            steps,
            steps / parameters.ares * parameters.period,
            stamp_device,
            stamp_host,
            received,
        )

    @property
    def hit(self) -> NDArray[np.bool_]:
        """Which beams were measured, shape (n,)."""
        return np.isfinite(self.ranges)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why each beam has no range, n strings; empty where it has one."""
        return tuple(
            reason(int(code)) if code < FIRST_MEASUREMENT else "" if hit else "beyond the sensor's range"
            for code, hit in zip(self.codes, self.hit, strict=True)
        )

    @property
    def times(self) -> FloatArray:
        """When each beam was measured on the host's clock, s since 1970, shape (n,)."""
        return np.asarray(self.stamp_host + self.delays, dtype=np.float64)


def line_scan(
    sweeps: Sequence[Sweep],
    T_world_sensor: FloatArray | Callable[[FloatArray], FloatArray] | None = None,
    source: str = "",
) -> LineScan:
    """Lay sweeps out as a line scan, a row a beam; ``time`` and ``code`` are further columns.

    Parameters
    ----------
    sweeps : sequence of Sweep
        At least one.
    T_world_sensor : ndarray, shape (4, 4) or (sweeps, 4, 4), or callable (times (n,)) -> (n, 4, 4)
        Where the sensor was: x ahead, y left, z up. One pose, one a sweep, or one for each beam's own time,
        as a sweep is not instantaneous. None: the sensor's own coordinates.
    source : str
        Name of the sensor.

    Raises
    ------
    SensorError
        Without sweeps, or when the poses do not fit.
    """
    if not sweeps:
        raise SensorError("no sweep was measured")
    scan = np.repeat([sweep.index for sweep in sweeps], [sweep.ranges.size for sweep in sweeps])
    times = np.concatenate([sweep.times for sweep in sweeps])
    bearings = np.concatenate([sweep.bearings for sweep in sweeps])
    local = np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(bearings.size)])
    given = T_world_sensor(times) if callable(T_world_sensor) else T_world_sensor
    poses = np.asarray(np.eye(4) if given is None else given, dtype=np.float64)
    if not callable(T_world_sensor) and poses.shape == (len(sweeps), 4, 4):
        poses = np.repeat(poses, [sweep.ranges.size for sweep in sweeps], axis=0)
    elif poses.shape == (4, 4):
        poses = np.broadcast_to(poses, (times.size, 4, 4))
    if poses.shape != (times.size, 4, 4):
        raise SensorError(
            f"poses of shape {poses.shape} do not fit {len(sweeps)} sweeps of {times.size} beams"
        )
    made = LineScan.of(
        scan,
        poses[:, :3, 3],
        np.einsum("nij,nj->ni", poses[:, :3, :3], local),
        np.concatenate([sweep.ranges for sweep in sweeps]),
        source,
    )
    return replace(made, extra={"time": times, "code": np.concatenate([sweep.codes for sweep in sweeps])})
