"""Errors of estimated gaps against the truth, in the form of the paper's Table 1."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.pose import Array
from bimfit.simulation.truth import JointTruth


@dataclass(frozen=True)
class GapEstimate:
    """What a method says of the gap at one station.

    Attributes
    ----------
    frame : SectionFrame
        The station's design.
    origin : ndarray, shape (3,)
        Midway between the mouth corners as built, world, m.
    angle : float
        Turn of the line through them, rad, counter-clockwise about ``frame.n``.
    area : float
        m^2.
    width : float
        Between the mouth corners, m; NaN where not told.
    """

    frame: SectionFrame
    origin: Array
    angle: float
    area: float
    width: float = math.nan


@dataclass(frozen=True)
class GapErrors:
    """Signed errors at the stations of one joint, each of shape (k,); NaN where nothing was estimated.

    Attributes
    ----------
    s : ndarray
        Distance along the joint's truth, m.
    x, z : ndarray
        Of the gap's origin, across the joint (u) and out of its mouth (v), m.
    angle : ndarray
        Rad.
    volume : ndarray
        Of the slice of the gap between midway to either neighbour, m^3.
    width : ndarray
        Between the mouth corners, m.
    length : ndarray
        How much of the joint each station stands for, m.
    """

    s: Array
    x: Array
    z: Array
    angle: Array
    volume: Array
    width: Array = field(default_factory=lambda: np.zeros(0))
    length: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def position(self) -> Array:
        """Length of the error of the origin, m."""
        return np.hypot(self.x, self.z)

    @property
    def estimated(self) -> NDArray[np.bool_]:
        """Where there is an estimate."""
        return np.isfinite(self.x) & np.isfinite(self.z)

    @property
    def lost(self) -> int:
        """How many stations have none."""
        return int(np.count_nonzero(~self.estimated))


@dataclass(frozen=True)
class TableRow:
    """One row of Table 1: least, greatest, mean and standard deviation of an absolute error.

    ``name`` and ``unit`` as the paper prints them; ``count`` is how many slices went in, 0 where not known.
    """

    name: str
    unit: str
    min: float
    max: float
    mean: float
    std: float
    count: int = 0


PAPER_SOURCE = "paper, Table 1: GRCSM on one virtual joint, 83 slices"
PAPER_TABLE_1 = (
    TableRow("|err_x|", "mm", 0.0, 37.0, 1.6, 4.0, 83),
    TableRow("|err_z|", "mm", 0.0, 2.2, 0.6, 0.5, 83),
    TableRow("||err_pos||", "mm", 0.0, 37.0, 1.7, 4.0, 83),
    TableRow("|err_theta|", "deg", 0.1, 10.0, 2.3, 2.0, 83),
    TableRow("|err_V|", "cm3", 0.0, 1.3, 0.3, 0.2, 83),
)
"""The paper's Table 1, in the order and the units of :func:`accuracy_table`."""
PAPER_SECONDS_A_SLICE = {"GRCSM": 0.082, "MRCSM": 630.0}
"""The paper's section 6, MATLAB; mean time a scan."""


def gap_errors(estimates: Iterable[GapEstimate | None], truth: JointTruth) -> GapErrors:
    """Compare estimates with the truth of the same joint.

    Stations are paired in the world, not by number: an estimate is compared with the truth interpolated to
    where along the joint it stands, so that the fit may choose other stations, run along the joint the other
    way or exchange its sides. The volume is the area times half the distance to each neighbouring station
    of the truth (the paper's section 4.5).

    Parameters
    ----------
    estimates : iterable of GapEstimate or None
        None counts as lost.
    truth : JointTruth

    Returns
    -------
    GapErrors
        A row an estimate that lies on the joint (within half a station of its ends), and one for each None.
    """
    table = _Truth(truth)
    rows = []
    for estimate in estimates:
        row = (math.nan,) * 7 if estimate is None else table.error(estimate)
        if row is not None:
            rows.append(row)
    columns = np.array(rows, float).reshape(-1, 7).T
    return GapErrors(*columns)


class _Truth:
    """A joint's truth as functions of the distance along it."""

    def __init__(self, truth: JointTruth) -> None:
        stations = truth.stations
        self.frames = [station.frame for station in stations]
        self.places = np.array([frame.origin for frame in self.frames])
        self.s = np.array([station.s for station in stations])
        self.origins = np.array([station.gap.origin for station in stations])
        self.angles = np.array([station.gap.angle for station in stations])
        self.areas = np.array([station.gap.area for station in stations])
        self.mouths = np.array([station.gap.width_mouth for station in stations])
        steps = np.diff(self.s)
        self.widths = np.r_[steps, 0.0] / 2 + np.r_[0.0, steps] / 2 if len(steps) else np.ones(1)
        self.slack = float(np.median(steps)) / 2 if len(steps) else 1e-3

    def error(self, estimate: GapEstimate) -> tuple[float, ...] | None:
        """Of s (where it stands), x, z, angle, volume, width and length; None beyond the joint's ends."""
        k = int(np.argmin(np.linalg.norm(self.places - estimate.frame.origin, axis=1)))
        frame = self.frames[k]
        along = float((estimate.frame.origin - frame.origin) @ frame.n)
        s = float(self.s[k] + along)
        if not self.s[0] - self.slack - 1e-6 <= s <= self.s[-1] + self.slack + 1e-6:
            return None
        origin = np.array([np.interp(s, self.s, column) for column in self.origins.T])
        sense = 1.0 if estimate.frame.n @ frame.n > 0.0 else -1.0
        offset = frame.direction_to_section(estimate.origin - origin)
        angle = _half_turn(sense * estimate.angle - float(np.interp(s, self.s, self.angles)))
        area = estimate.area - float(np.interp(s, self.s, self.areas))
        width = abs(estimate.width) - float(np.interp(s, self.s, self.mouths))
        length = float(self.widths[k])
        return s, float(offset[0]), float(offset[1]), angle, area * length, width, length


def _half_turn(angle: float) -> float:
    """The angle between lines without direction, in (-pi/2, pi/2]."""
    return math.pi / 2 - (math.pi / 2 - angle) % math.pi


def accuracy_table(errors: Sequence[GapErrors]) -> tuple[TableRow, ...]:
    """The paper's Table 1 over all estimated stations of some joints; NaN where there is none.

    The standard deviation is that of the absolute errors, as the paper's is.
    """
    columns = {
        ("|err_x|", "mm"): [np.abs(e.x) * 1e3 for e in errors],
        ("|err_z|", "mm"): [np.abs(e.z) * 1e3 for e in errors],
        ("||err_pos||", "mm"): [e.position * 1e3 for e in errors],
        ("|err_theta|", "deg"): [np.degrees(np.abs(e.angle)) for e in errors],
        ("|err_V|", "cm3"): [np.abs(e.volume) * 1e6 for e in errors],
    }
    rows = []
    for (name, unit), parts in columns.items():
        values = np.concatenate(parts) if parts else np.zeros(0)
        values = values[np.isfinite(values)]
        if not len(values):
            rows.append(TableRow(name, unit, math.nan, math.nan, math.nan, math.nan))
            continue
        low, high, mean, std = (float(f) for f in (values.min(), values.max(), values.mean(), values.std()))
        rows.append(TableRow(name, unit, low, high, mean, std, len(values)))
    return tuple(rows)


def estimates_of(joint: Mapping[str, Any]) -> tuple[GapEstimate | None, ...]:
    """The estimates in one joint of a results.json, None at stations without a gap.

    Raises
    ------
    KeyError
        When it is not such a joint.
    """
    out: list[GapEstimate | None] = []
    for station in joint["stations"]:
        gap = station["gap"]
        if gap is None or gap["origin"] is None:
            out.append(None)
            continue
        frame = SectionFrame(
            *(np.asarray(station["frame"][axis], float) for axis in ("origin", "u", "v", "n"))
        )
        known = [math.nan if value is None else float(value) for value in (gap["angle"], gap["area"])]
        out.append(GapEstimate(frame, np.asarray(gap["origin"], float), *known))
    return tuple(out)


def truth_for(elements: Sequence[str], truths: Sequence[JointTruth]) -> JointTruth | None:
    """The truth of the joint between two elements, in whichever order they are named."""
    for truth in truths:
        if set(truth.elements) == set(elements):
            return truth
    return None
