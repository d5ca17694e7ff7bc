"""Fit a joint sweep by sweep while it is being measured."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bimfit.bim.stations import design_sections
from bimfit.config import Config
from bimfit.errors import ConfigError, ScanError
from bimfit.estimation.noise import estimate_noise
from bimfit.estimation.result import StationEstimate
from bimfit.gap.section import GapSection, gap_section
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.geometry.slice import Slice
from bimfit.geometry.status import Status
from bimfit.pipeline.carriage import advanced, held_over
from bimfit.pipeline.fit import fit_station
from bimfit.pipeline.simulate import designed, longest_open
from bimfit.pipeline.survey import load_scan, model_joints, mouth_paths, viewpoint_of
from bimfit.pipeline.targets import TargetCache, Targets, match_reach, with_assumed_view
from bimfit.scan.coverage import covers, sweep_positions
from bimfit.scan.grid import StationGrid
from bimfit.scan.slicing import cut_slices
from bimfit.sensor.clock import host_clock
from bimfit.sensor.counters import Counters
from bimfit.sensor.hokuyo import Hokuyo
from bimfit.sensor.sweep import line_scan
from bimfit.simulation.motion import random_truth
from bimfit.simulation.rangefinder import simulate_scan
from bimfit.simulation.scenario import Scenario

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint
    from bimfit.bim.model import Model

NEAR = 0.3
RECENT = 20
"""So many sweeps say what the sensor's noise is."""
SWEEPS = 1000
"""So many sweeps are prepared for: building the faster look-up tables pays."""
LEFT_OUT = "left out: this computer does not keep up"
MOST_WAITING = 3
"""With more sweeps waiting than that, the older ones are left out."""
_SKIPPED = Status("no_data", LEFT_OUT)
_STEP = 0.01
_PROFILES = 0.02
"""Distance at which a joint's profile is looked at beforehand, m."""


@dataclass(frozen=True)
class LiveStation:
    """What one sweep says.

    Attributes
    ----------
    index : int
        The sweep's number.
    s : float
        Where along the joint it is, m; NaN where it does not cross it.
    status : Status
    gap : GapSection or None
        None where it could not be measured.
    stamp : float
        The device's clock at the sweep's start, s; NaN of a recording.
    latency : float
        From the sweep's last byte to here, s; NaN of a recording.
    """

    index: int
    s: float
    status: Status
    gap: GapSection | None = None
    stamp: float = math.nan
    latency: float = math.nan


class LiveFit:
    """A joint that is ready to be fitted, sweep by sweep.

    Parameters
    ----------
    model, joint
        The joint with its mouth towards the sensor.
    config : Config
    """

    def __init__(self, model: Model, joint: Joint, config: Config) -> None:
        self.model, self.joint, self.config = model, joint, config
        self._targets = TargetCache(config)
        self._sensor = config.sensor
        self._recent: deque[StationEstimate] = deque(maxlen=RECENT)
        self._mouth = mouth_paths(joint)[0]
        count = math.ceil(self._mouth.length / _STEP)
        s = np.linspace(0.0, self._mouth.length, max(count, 2) + 1)
        self._grid = StationGrid.of([self._mouth.rough_frame(float(x)) for x in s], s)

    def prepare(self, height: float) -> None:
        """Build tables and load kernels with sweeps as designed, seen from ``height``, m; takes seconds.

        Where the joint's profile changes along it, each profile's tables are built.
        """
        scenario = Scenario(motion="none", sensor_height=height)
        length = self.joint.path.length
        ready: set[int] = set()
        for s in np.linspace(0.0, length, math.ceil(length / _PROFILES) + 1):
            section = self.section(float(s))
            if section is None:
                continue
            sweep = simulate_scan((section,), random_truth((section,), scenario, 0), scenario, 0)
            targets = self._cut(section, sweep)[1]
            if id(targets.combined) not in ready:
                self.fit(0, section, sweep)
                self._reach_all(targets)
                ready.add(id(targets.combined))
        self._recent.clear()
        self._sensor = self.config.sensor

    def _reach_all(self, targets: Targets) -> None:
        """Let the tables reach as far as returns do, or one farther off would have them built again."""
        window = 2.0 * np.array(self.config.search.window[:2])
        for target in targets.all:
            low_u, low_v, high_u, high_v = target.box
            span = np.array([high_u - low_u, high_v - low_v]) + window
            target.reach(float(0.5 * np.hypot(*np.minimum(span, 2.0 * match_reach(self.config)))))

    def section(self, s: float) -> JointSection | None:
        """The design at a place along the joint, m; None where no cross-section shows both components."""
        return next(iter(design_sections(self.model, self.joint, [s])), None)

    def place(self, sweep: LineScan) -> float:
        """Where along the joint a sweep in model coordinates crosses it, m; NaN where it does not."""
        found = sweep_positions(sweep, self._grid, self._mouth, NEAR)
        if not len(found):
            return math.nan
        return float(np.interp(found[0], self._mouth.stops, self.joint.path.stops))

    def fit_placed(self, index: int, sweep: LineScan) -> LiveStation:
        """Fit a sweep in model coordinates, which says itself where it is."""
        s = self.place(sweep)
        if math.isnan(s):
            return LiveStation(index, s, Status("no_data", "the sweep does not cross the joint"))
        section = self.section(s)
        if section is None:
            return LiveStation(index, s, Status("no_data", "the design shows no gap there"))
        return self.fit(index, section, sweep)

    def fit(self, index: int, section: JointSection, sweep: LineScan) -> LiveStation:
        """Fit a sweep in model coordinates to the section that it shows."""
        slice_, targets = self._cut(section, sweep)
        config = dataclasses.replace(self.config, sensor=self._sensor)
        estimate = fit_station(section, slice_, targets, config).estimate
        assert estimate is not None  # the method that is asked for makes one, always
        self._learn(estimate)
        a, b = estimate.components
        gap = None
        if estimate.status.measured and a.pose is not None and b.pose is not None:
            gap = gap_section(
                section.s, section.frame, section.gap, a.pose, b.pose, a.covariance, b.covariance
            )
        return LiveStation(index, section.s, estimate.status, gap)

    def _cut(self, section: JointSection, sweep: LineScan) -> tuple[Slice, Targets]:
        (cut,) = cut_slices(
            sweep,
            [section.frame],
            [section.s],
            thickness=self.config.slices.thickness,
            reach=match_reach(self.config),
        )
        slice_ = with_assumed_view(cut, section)
        targets = dataclasses.replace(self._targets.get(section, slice_), stations=SWEEPS)
        return slice_, targets

    def _learn(self, estimate: StationEstimate) -> None:
        """Let the last sweeps' residuals say how the sensor really measures."""
        if self.config.sensor.adapt:
            self._recent.append(estimate)
            self._sensor = estimate_noise(self._recent, self.config.sensor).sensor


@dataclass(frozen=True)
class Mount:
    """How the sensor is carried.

    Attributes
    ----------
    speed : float or None
        Along the joint, m/s.
    start : float
        Where along the joint the first sweep is, m.
    height : float
        Of the sensor over the designed mouth, m.
    pose : ndarray, shape (4, 4), or None
        T_world_sensor at the first sweep, where it is known; the sensor then goes along its z axis, and
        ``start`` and ``height`` do not matter.
    flip : bool
        Look into the joint's other mouth.
    mirrored : bool
        Bearings grow from B towards A, as of a sensor that is mounted the other way up.
    """

    speed: float | None = None
    start: float = 0.0
    height: float = 0.25
    pose: Array | None = None
    flip: bool = False
    mirrored: bool = False

    def __post_init__(self) -> None:
        if self.speed is not None and not math.isfinite(self.speed):
            raise ConfigError(f"--speed must be a number, got {self.speed}")
        if not self.height > 0.0:
            raise ConfigError(f"--height must be more than 0, got {self.height:g} m")


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
        """Fit the sweeps of a recorded line scan, in the order of their numbers.

        A recording in the sensor's own coordinates is placed as the mount says, which needs its ``time``
        column; any other is taken to be in model coordinates, as it is.

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
        if "time" in scan.extra and not scan.origins.any():
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
        self._insist_on_speed("a recording in the sensor's coordinates")
        place = self._ready()
        for sweep in scan.split():
            station = place(int(sweep.scan[0]), sweep, np.asarray(sweep.extra["time"], float))
            if station is None:
                return
            yield station

    def stream(
        self, port: str | None, *, field: float, sweeps: int | None = None, told: Callable[[], None]
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
            Called when everything is ready and the sensor starts.

        Raises
        ------
        SensorError
            When the device cannot be reached, or is gone for good.
        """
        self._insist_on_speed("a sensor")
        clock = host_clock()
        device = Hokuyo(port, clock=clock, guard=True)
        try:
            with device:
                steps = device.parameters.steps(-field, field)
                place = self._ready()
                told()
                with closing(device.scans(*steps, count=sweeps)) as stream:  # type: ignore[type-var]
                    for sweep in stream:
                        if device.waiting > MOST_WAITING:
                            yield LiveStation(sweep.index, math.nan, _SKIPPED, stamp=sweep.stamp_device)
                            continue
                        station = place(sweep.index, line_scan([sweep]), sweep.times)
                        if station is None:
                            return
                        yield dataclasses.replace(
                            station, stamp=sweep.stamp_device, latency=clock() - sweep.received
                        )
        finally:
            self.counters = device.counters

    def _insist_on_speed(self, source: str) -> None:
        if self._mount.speed is None:
            raise ConfigError(
                f"{source} does not say how fast it moves", remedy="--speed 0.05 (m/s), 0 where it stands"
            )

    def _ready(self) -> Callable[[int, LineScan, Array], LiveStation | None]:
        """Prepare; what it returns places a sweep in the sensor's coordinates and fits it, or ends."""
        mount = self._mount
        speed = mount.speed or 0.0
        ready = LiveFit(self.model, self._facing(), self._config)
        ready.prepare(mount.height)
        first: list[float] = []  # when the first sweep looked ahead
        length = ready.joint.path.length

        def carried_on(index: int, sweep: LineScan, times: Array) -> LiveStation | None:
            ahead = int(np.argmax(sweep.directions[:, 0]))
            first[len(first) :] = [float(times[ahead])] if not first else []
            # each beam has its own time; the section is where the sensor was when it looked ahead
            way = speed * (times - first[0])
            if mount.pose is not None:
                return ready.fit_placed(index, sweep.laid_out(advanced(mount.pose, way)))
            middle = float(way[ahead])
            s = mount.start + middle
            if (s > length and speed > 0.0) or (s < 0.0 and speed < 0.0):
                return None
            section = ready.section(s) if 0.0 <= s <= length else None
            if section is None:
                reason = "the design shows no gap there" if 0.0 <= s <= length else "outside the joint"
                return LiveStation(index, s, Status("no_data", reason))
            return ready.fit(
                index, section, sweep.laid_out(advanced(held_over(section, mount.height), way - middle))
            )

        return carried_on

    def _facing(self) -> Joint:
        """The joint with its mouth towards the sensor: where its pose says, else the side easier to reach."""
        mount, joint = self._mount, self._chosen
        if mount.pose is not None:
            return joint.facing(mount.pose[:3, 3])
        section = designed(self.model, joint, Scenario(sensor_height=mount.height))[0]
        if float(section.frame.v @ joint.path.rough_frame(section.s).v) < 0.0:
            joint = dataclasses.replace(joint, path=joint.path.flipped(), legs=joint.legs[::-1])
        if mount.flip:
            joint = dataclasses.replace(joint, path=joint.path.flipped(), legs=joint.legs[::-1])
        return joint
