"""Fit a joint sweep by sweep while it is being measured."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bimfit.config import Config
from bimfit.errors import ConfigError, ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.geometry.status import Status
from bimfit.pipeline.carriage import Mount, advanced, held_over
from bimfit.pipeline.live_fit import NEAR, LiveFit, LiveStation
from bimfit.pipeline.scan_file import load_scan
from bimfit.pipeline.simulate import designed, longest_open
from bimfit.pipeline.survey import model_joints, mouth_paths, viewpoint_of
from bimfit.scan.coverage import covers
from bimfit.sensor.clock import host_clock
from bimfit.sensor.counters import Counters
from bimfit.sensor.hokuyo import Hokuyo
from bimfit.sensor.sweep import line_scan
from bimfit.simulation.scenario import Scenario

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint

Place = Callable[[int, LineScan], LiveStation | None]
"""Places a sweep in the sensor's coordinates, with its beams' times, and fits it; None ends."""
LEFT_OUT = "left out: this computer does not keep up"
MOST_WAITING = 3
"""With more sweeps waiting than that, the older ones are left out."""
_SKIPPED = Status("no_data", LEFT_OUT)
BEHIND = 10
"""So many sweeps in a row off a joint that was crossed before are its end."""


class Live:
    """A model's joint, and the sweeps of a sensor or of a recording fitted to it as they come.

    Parameters
    ----------
    model_path : Path
    joint : str, optional
        Id or ``GUID,GUID``; the longest open joint by default.
    mount : Mount
    config : Config

    Raises
    ------
    BimfitError
        When the model or the joint cannot be used.
    """

    def __init__(self, model_path: Path, joint: str | None, mount: Mount, config: Config) -> None:
        self.model, found = model_joints(model_path, config.joints, [joint] if joint else [])
        self._chosen = found[0] if joint else longest_open(found)
        self._mount, self._config = mount, config
        self.counters = Counters()

    @property
    def joint(self) -> Joint:
        """As designed."""
        return self._chosen

    def replay(self, path: Path) -> Iterator[LiveStation]:
        """Fit the sweeps of a recorded line scan or SCIP dialogue, in the order of their numbers.

        A recording in the sensor's own coordinates, all beams from its origin, is placed as the mount says,
        which needs its ``time`` column; any other is taken to be in model coordinates, as it is.

        Raises
        ------
        ScanError
            When the file cannot be read, has no sweeps, or does not show the joint.
        """
        scan = load_scan(path)
        if not isinstance(scan, LineScan):
            raise ScanError("a point cloud has no sweeps to replay", file=path, remedy="give a line scan")
        if not len(scan):
            raise ScanError("there is no sweep to replay", file=path)
        own = not scan.origins.any() or self._mount.trajectory is not None
        if own and "time" not in scan.extra:
            raise ScanError(
                "a scan in the sensor's coordinates has to have a column time",
                file=path,
                remedy="bimfit capture writes it; else lay the scan out in the model",
            )
        if own:
            yield from self._replay_carried(scan)
            return
        eye = viewpoint_of(scan, self._chosen)
        if eye is None or not max(covers(scan, path, NEAR) for path in mouth_paths(self._chosen)):
            raise ScanError(f"the scan does not show joint {self._chosen.id}", file=path)
        ready = LiveFit(self.model, self._chosen.facing(eye), self._config)
        ready.prepare(self._mount.height)
        for sweep in scan.split():
            yield ready.fit_placed(int(sweep.scan[0]), sweep)

    def _replay_carried(self, scan: LineScan) -> Iterator[LiveStation]:
        self._insist_on_motion("a recording in the sensor's coordinates")
        place = self._ready()
        for sweep in scan.split():
            station = place(int(sweep.scan[0]), sweep)
            if station is None:
                return
            yield station

    def stream(
        self, port: str | None, *, field: float, sweeps: int | None = None, told: Callable[[str], None]
    ) -> Iterator[LiveStation]:
        """Fit a sensor's sweeps as they come, until the joint's end; the laser is off afterwards.

        Parameters
        ----------
        port : str, optional
            None takes the one Hokuyo that is plugged in.
        field : float
            Half opening about straight ahead that is measured, rad.
        sweeps : int, optional
            End after so many.
        told : callable
            Told, in a line, when everything is ready and the sensor starts, and of what goes wrong.

        Raises
        ------
        SensorError
            When the device cannot be reached, or is gone for good.
        """
        self._insist_on_motion("a sensor")
        clock = host_clock()
        device = Hokuyo(port, clock=clock, guard=True, told=told)
        try:
            with device:
                steps = device.parameters.steps(-field, field)
                told(f"joint {self.joint.id}: getting ready")
                place = self._ready()
                told(f"joint {self.joint.id}: go")
                with closing(device.scans(*steps, count=sweeps)) as stream:  # type: ignore[type-var]
                    for sweep in stream:
                        if device.waiting > MOST_WAITING:
                            yield LiveStation(sweep.index, math.nan, _SKIPPED, stamp=sweep.stamp_device)
                            continue
                        station = place(sweep.index, line_scan([sweep]))
                        if station is None:
                            return
                        yield dataclasses.replace(
                            station, stamp=sweep.stamp_device, latency=clock() - sweep.received
                        )
        finally:
            self.counters = device.counters

    def _insist_on_motion(self, source: str) -> None:
        mount = self._mount
        if mount.speed is None and mount.trajectory is None:
            raise ConfigError(
                f"{source} does not say how it moves",
                remedy="--speed 0.05 (m/s), 0 where it stands, or a --trajectory",
            )

    def _ready(self) -> Place:
        """Prepare; takes seconds."""
        mount = self._mount
        ready = LiveFit(self.model, self._facing(), self._config)
        ready.prepare(mount.height)
        if mount.trajectory is None and mount.pose is None:
            return _over_the_joint(ready, mount)
        return _until_passed(ready, mount)

    def _facing(self) -> Joint:
        """The joint with its mouth towards the sensor: where its pose says, else the side easier to reach."""
        mount, joint = self._mount, self._chosen
        where = mount.somewhere()
        if where is not None:
            return joint.facing(where)
        section = designed(self.model, joint, Scenario(sensor_height=mount.height))[0]
        if float(section.frame.v @ joint.path.rough_frame(section.s).v) < 0.0:
            joint = dataclasses.replace(joint, path=joint.path.flipped(), legs=joint.legs[::-1])
        if mount.flip:
            joint = dataclasses.replace(joint, path=joint.path.flipped(), legs=joint.legs[::-1])
        return joint


def _over_the_joint(ready: LiveFit, mount: Mount) -> Place:
    """Sweeps of a sensor that is held over the designed mouth and goes along it."""
    speed, length = mount.speed or 0.0, ready.joint.path.length
    begun: list[float] = []  # when the first sweep looked ahead

    def place(index: int, sweep: LineScan) -> LiveStation | None:
        times, ahead = _times(sweep)
        begun[:] = begun or [float(times[ahead])]
        # each beam has its own time; the section is where the sensor was when it looked ahead
        way = speed * (times - begun[0])
        s = mount.start + float(way[ahead])
        if (s > length and speed > 0.0) or (s < 0.0 and speed < 0.0):
            return None
        section = ready.section(s) if 0.0 <= s <= length else None
        if section is None:
            reason = "the design shows no gap there" if 0.0 <= s <= length else "outside the joint"
            return LiveStation(index, s, Status("no_data", reason))
        pose = held_over(section, mount.height, mirrored=mount.mirrored)
        off = (way - way[ahead]) * (-1.0 if mount.mirrored else 1.0)
        return ready.fit(index, section, sweep.laid_out(advanced(pose, off)))

    return place


def _until_passed(ready: LiveFit, mount: Mount) -> Place:
    """Sweeps of a sensor whose pose is known at every time, until it has passed the joint."""
    begun: list[float] = []
    behind: list[bool] = []  # sweeps off the joint since it was last crossed

    def place(index: int, sweep: LineScan) -> LiveStation | None:
        times, ahead = _times(sweep)
        begun[:] = begun or [float(times[ahead])]
        poses = mount.poses(times, begun[0])
        if poses is None:
            late = mount.ended(times, begun[0])
            before = Status("no_data", "before the trajectory begins")
            return None if late else LiveStation(index, math.nan, before)
        station = ready.fit_placed(index, sweep.laid_out(poses))
        if not math.isnan(station.s):
            behind[:] = [True]
        elif behind:
            behind.append(True)
        return None if len(behind) > BEHIND else station

    return place


def _times(sweep: LineScan) -> tuple[Array, int]:
    """When each beam was measured, s, and which of them looked ahead."""
    return np.asarray(sweep.extra["time"], np.float64), int(np.argmax(sweep.directions[:, 0]))
