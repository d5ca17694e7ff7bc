"""Record a rangefinder: sweeps until enough, until interrupted, or until the device is gone."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bimfit.errors import BimfitError, ConfigError, ExportError, SensorError
from bimfit.files import whole_file
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.pipeline.carriage import advanced
from bimfit.pipeline.spool import Spool
from bimfit.scan.formats import FORMATS, write_scan
from bimfit.sensor.counters import Counters
from bimfit.sensor.hokuyo import Hokuyo
from bimfit.sensor.sweep import Sweep, line_scan


@dataclass(frozen=True)
class Recording:
    """What was recorded.

    Attributes
    ----------
    spool : Spool
        Where it is, until :meth:`~bimfit.pipeline.spool.Spool.finish`; with the columns ``time`` (s since
        1970, of every beam), ``code`` (what the device sent), ``step`` and ``stamp`` (the device's clock at
        the sweep's start, s).
    sweeps : int
    counters : Counters
        What went wrong meanwhile.
    failure : BimfitError or None
        Why it ended before its time, where the device gave up or the disc was full.
    """

    spool: Spool
    sweeps: int
    counters: Counters
    failure: BimfitError | None = None


def record(
    port: str | None,
    output: Path,
    *,
    sweeps: int | None = None,
    seconds: float | None = None,
    field: float | None = None,
    speed: float = 0.0,
    pose: Array | None = None,
    told: Callable[[int], None] = lambda count: None,
    note: Callable[[str], None] = lambda text: None,
) -> Recording:
    """Record sweeps, each on disk as soon as it is whole; the laser is off afterwards, whatever happens.

    Parameters
    ----------
    port : str, optional
        None takes the one Hokuyo that is plugged in.
    output : Path
        The line scan that is to become of it.
    sweeps, seconds : optional
        When to end; whichever comes first, else never.
    field : float, optional
        Half opening about straight ahead that is recorded, rad; all of it by default.
    speed : float
        Of the sensor along its own z axis, m/s, from the first sweep on.
    pose : ndarray, shape (4, 4), optional
        T_world_sensor when the first sweep looks ahead; the sensor's own coordinates by default.
    told : callable
        Told the number of sweeps so far.
    note : callable
        Told, in a line, of what goes wrong meanwhile.

    Raises
    ------
    SensorError
        When the device cannot be reached, or not one whole sweep came. Later failures end the recording.
    """
    count, first, failure = 0, (0.0, 0.0), None
    spool = Spool(output)
    device = Hokuyo(port, guard=True, told=note)
    try:
        with device:
            start, end = (None, None) if field is None else device.parameters.steps(-field, field)
            with closing(device.scans(start, end, count=sweeps)) as stream:  # type: ignore[type-var]
                for sweep in stream:
                    if not count:
                        first = sweep.stamp_host, float(sweep.times[np.argmin(np.abs(sweep.bearings))])
                    spool.add(_laid_out(sweep, first[1], speed, pose))
                    count += 1
                    told(count)
                    if seconds is not None and sweep.stamp_host - first[0] >= seconds:
                        break
    except KeyboardInterrupt:
        pass
    except (SensorError, ExportError) as error:
        if not count:
            raise
        failure = error
    finally:
        spool.close()
    if not count:
        raise SensorError("interrupted before the first whole sweep came; nothing is written")
    return Recording(spool, count, device.counters, failure)


def _laid_out(sweep: Sweep, first: float, speed: float, pose: Array | None) -> LineScan:
    """A sweep as beams, with its further columns; the sensor looked ahead first at that time, s."""
    at = np.eye(4) if pose is None else pose
    scan = line_scan([sweep], lambda times: advanced(at, speed * (times - first)), "rangefinder")
    columns = {"step": sweep.steps, "stamp": np.full(sweep.steps.size, sweep.stamp_device)}
    return replace(scan, extra={**scan.extra, **columns})


class _Probed(Exception):
    """The file could be written."""


def check_output(path: Path) -> None:
    """Find out, before anything is recorded, whether a line scan can be written there.

    Raises
    ------
    ExportError
        When its extension names no format of line scans, or its folder cannot be written to.
    """
    able = [extension for form in FORMATS if form.beams for extension in form.extensions]
    if path.suffix.lower() not in able:
        raise ExportError(
            f"a line scan cannot be written as {path.suffix or 'a file without extension'}",
            file=path,
            remedy=f"use {', '.join(able)}",
        )
    try:
        with whole_file(path) as part:
            write_scan(LineScan.of([], [], [], []), part)
            raise _Probed
    except _Probed:
        pass


def check_length(sweeps: int | None, seconds: float | None) -> None:
    """Refuse recordings of no length.

    Raises
    ------
    ConfigError
        For a duration that is not positive.
    """
    if seconds is not None and not seconds > 0.0:
        raise ConfigError(f"--seconds {seconds:g}: must be more than 0")
    if sweeps is not None and sweeps < 1:
        raise ConfigError(f"--sweeps {sweeps}: must be at least 1")
