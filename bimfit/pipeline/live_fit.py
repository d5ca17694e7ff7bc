"""One sweep of a joint, fitted as it comes: everything that is slow is made ready beforehand."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bimfit.bim.stations import design_sections
from bimfit.config import Config
from bimfit.estimation.noise import estimate_noise
from bimfit.estimation.result import StationEstimate
from bimfit.gap.section import GapSection, gap_section
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.slice import Slice
from bimfit.geometry.status import Status
from bimfit.pipeline.fit import fit_station
from bimfit.pipeline.mouth import mouth_paths, spine_stations
from bimfit.pipeline.targets import TargetCache, Targets, match_reach, profile_reach, with_assumed_view
from bimfit.scan.coverage import sweep_positions
from bimfit.scan.grid import StationGrid
from bimfit.scan.slicing import cut_slices
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
        reach = profile_reach(self.config)
        return next(iter(design_sections(self.model, self.joint, [s], reach)), None)

    def place(self, sweep: LineScan) -> float:
        """Where along the joint a sweep in model coordinates crosses it, m; NaN where it does not."""
        found = sweep_positions(sweep, self._grid, self._mouth, NEAR)
        if not len(found):
            return math.nan
        stations = spine_stations(self.joint.path, self._mouth, found[:1])
        return float(stations[0]) if len(stations) else math.nan

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
