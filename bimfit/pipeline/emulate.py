"""What a virtual rangefinder is to see: a joint of a model as it is carried along, or a recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bimfit.errors import ConfigError, ScanError
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.pipeline.carriage import advanced, held_over
from bimfit.pipeline.simulate import designed, longest_open
from bimfit.pipeline.survey import model_joints
from bimfit.scan.formats import FORMATS, read_scan
from bimfit.sensor.dialogue import Speaker, read_dialogue, read_speaker
from bimfit.sensor.scene import MovingScene, Scene
from bimfit.sensor.scip import IntArray, Parameters
from bimfit.simulation.motion import random_truth
from bimfit.simulation.rangefinder import aim, cast, inside
from bimfit.simulation.scenario import Scenario
from bimfit.simulation.truth import JointTruth

PAUSE = 3.0
"""Without a scan for so long, the next one finds the sensor back at the joint's start, s."""
_MODELS = (".ifc", ".ifczip", ".ifcxml")


@dataclass(frozen=True)
class Emulation:
    """What to serve.

    Attributes
    ----------
    scene : Scene
    about : str
        What it is, in a line.
    T_world_sensor : ndarray, shape (4, 4), or None
        Where the sensor is at the first scan; None where that is not known.
    truth : JointTruth or None
        What is true of the joint; None of a recording.
    speaker : Speaker or None
        The device that the recording is of, where it tells.
    """

    scene: Scene
    about: str
    T_world_sensor: Array | None = None
    truth: JointTruth | None = None
    speaker: Speaker | None = None


@dataclass
class JointRide:
    """A sensor that is carried along a joint and back, over and over, from the first scan that is asked for.

    It looks ahead at the joint's start in the first turn. Between stations the components' poses change
    linearly. It starts anew when nobody has asked for a scan for a while, so that each program that opens the
    port sees the joint from its start, also after a cable was pulled and plugged in again.

    Parameters
    ----------
    sections, truth
        The joint as designed and as built, at the same stations.
    height : float
        Distance of the sensor from the designed mouth, m.
    speed : float
        m/s.
    """

    sections: Sequence[JointSection]
    truth: JointTruth
    height: float
    speed: float
    _start: float = math.nan
    _last: float = math.nan
    _kinds: IntArray = field(init=False)

    def __post_init__(self) -> None:
        self._out = aim(self.sections[len(self.sections) // 2], self.height)
        self._s = np.array([section.s for section in self.sections])
        self._poses = [
            np.array([station.components[k].as_array() for station in self.truth.stations]) for k in (0, 1)
        ]
        known: dict[tuple[int, int], int] = {}
        ids = [(id(section.components[0]), id(section.components[1])) for section in self.sections]
        self._kinds = np.array([known.setdefault(key, k) for k, key in enumerate(ids)])

    def ranges(self, bearings: Array, seconds: Array) -> Array:
        """Ranges (n,) m of beams at bearings (n,) rad, each at its own time (n,), s."""
        begin = float(seconds[0])
        if not 0.0 <= begin - self._last <= PAUSE:
            self._start = float(seconds[np.argmin(np.abs(bearings))])
        self._last = begin
        return self.seen(bearings, self.position(seconds - self._start))

    def position(self, elapsed: Array) -> Array:
        """Where along the joint the sensor is so long (n,) after its start, m."""
        end = float(self._s[-1])
        return np.asarray(end - np.abs(end - np.mod(self.speed * np.asarray(elapsed), 2.0 * end)))

    def seen(self, bearings: Array, s: Array) -> Array:
        """Ranges (n,) m of beams at bearings (n,) rad from places (n,) along the joint, m."""
        out = self._out
        across = np.array([out[1], -out[0]])
        directions = -np.cos(bearings)[:, None] * out + np.sin(bearings)[:, None] * across
        kinds = self._kinds[np.searchsorted(0.5 * (self._s[1:] + self._s[:-1]), s)]
        found = np.full(len(s), np.inf)
        for kind in np.unique(kinds):
            rows = np.flatnonzero(kinds == kind)
            for profile, poses in zip(self.sections[kind].components, self._poses, strict=True):
                u, v, theta = (np.interp(s[rows], self._s, poses[:, k]) for k in range(3))
                # the rays in the component's own frame, where it has not moved
                eyes = _turned(self.height * out - np.stack([u, v], axis=1), -theta)
                rays = _turned(directions[rows], -theta)
                found[rows] = np.minimum(found[rows], cast([profile], eyes, rays).ranges)
        return found


def _turned(vectors: Array, theta: Array) -> Array:
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]], axis=1)


def is_model(path: Path) -> bool:
    """Whether a file is a model by its name, not a scan."""
    return path.suffix.lower() in _MODELS


def model_emulation(
    model_path: Path, scenario: Scenario, seed: int, *, joint: str | None = None, speed: float = 0.05
) -> Emulation:
    """A sensor carried along a joint whose components have moved at random, as ``simulate`` moves them.

    Parameters
    ----------
    model_path : Path
    scenario : Scenario
        What moves how far, and where the sensor is held.
    seed : int
        Of the motion.
    joint : str, optional
        Id or ``GUID,GUID``; the longest open joint by default.
    speed : float
        Of the sensor, m/s.

    Raises
    ------
    BimfitError
        When the model or the joint cannot be used, or the sensor would stand in a component.
    """
    from bimfit.config import JointConfig

    if not (math.isfinite(speed) and speed >= 0.0):
        raise ConfigError(f"the sensor's speed must be at least 0, got {speed:g} m/s")
    model, found = model_joints(model_path, JointConfig(), [joint] if joint else [])
    chosen = found[0] if joint else longest_open(found)
    sections = designed(model, chosen, scenario)
    truth = random_truth(
        sections, scenario, seed, joint_id=chosen.id, elements=chosen.elements, kind=chosen.kind
    )
    ride = JointRide(sections, truth, scenario.sensor_height, speed)
    eye = scenario.sensor_height * aim(sections[len(sections) // 2], scenario.sensor_height)
    for section, station in zip(sections, truth.stations, strict=True):
        moved = (p.moved(pose) for p, pose in zip(section.components, station.components, strict=True))
        if any(inside(profile, eye) for profile in moved):
            raise ConfigError(
                f"the sensor would stand inside a component at station {station.s:.3f} m of joint {truth.id}",
                remedy="choose another sensor_height",
            )
    first = held_over(sections[0], scenario.sensor_height)
    start = advanced(first, np.array([-sections[0].s]))[0]
    way = f"{sections[-1].s:.3f} m at {speed:g} m/s and back, {scenario.sensor_height:g} m over it"
    about = f"joint {chosen.id} of {model_path.name}, {way}, seed {seed}"
    return Emulation(MovingScene(ride.ranges), about, start, truth)


def recorded_emulation(path: Path, parameters: Parameters) -> Emulation:
    """The sweeps of a line scan or of a recorded SCIP dialogue, sent as they are, over and over.

    Raises
    ------
    ScanError
        When the file cannot be read, or is a point cloud.
    """
    known = {extension for form in FORMATS for extension in form.extensions}
    if not known & {suffix.lower() for suffix in path.suffixes[-2:]}:
        try:
            sweeps = read_dialogue(path)
            about = f"{len(sweeps)} sweeps of the dialogue {path.name}"
            return Emulation(sweeps, about, speaker=read_speaker(path))
        except ScanError as no_dialogue:
            try:
                scan = read_scan(path)  # a scan is known by what is in it, too
            except ScanError:
                raise no_dialogue from None
    else:
        scan = read_scan(path)
    if not isinstance(scan, LineScan):
        raise ScanError("a point cloud has no sweeps to replay", file=path, remedy="give a line scan")
    if not len(scan):
        raise ScanError("there is no sweep to replay", file=path)
    scene: Scene = _raw_rows(scan, parameters) or scan
    return Emulation(scene, f"{len(scan.sweeps)} sweeps of {path.name}")


def _raw_rows(scan: LineScan, has: Parameters) -> tuple[IntArray, ...]:
    """What the device sent, exactly, where a recording of our own tells each beam's step and value.

    Empty where it does not, or where its steps are not this device's.
    """
    if not {"step", "code"} <= set(scan.extra):
        return ()
    rows = []
    turn = 2.0 * math.pi / has.ares
    for sweep in scan.split():
        steps, codes = (np.asarray(sweep.extra[name], float) for name in ("step", "code"))
        if not (np.isfinite(steps).all() and np.isfinite(codes).all() and (codes >= 0).all()):
            return ()
        between = np.arccos(np.clip(np.sum(sweep.directions[1:] * sweep.directions[:-1], axis=1), -1.0, 1.0))
        if np.any(steps < has.amin) or np.any(steps > has.amax):
            return ()
        if np.any(np.abs(between - np.diff(steps) * turn) > 0.1 * turn):
            return ()
        row = np.zeros(has.amax - has.amin + 1, dtype=np.int64)
        row[np.rint(steps).astype(np.int64) - has.amin] = codes.astype(np.int64)
        rows.append(row)
    return tuple(rows)
