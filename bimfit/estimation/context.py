"""What every step of one station's estimate needs: the design, the beams, and the sensor as it is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation import _kernels_sight as kernels
from bimfit.estimation.cloud import VirtualBeams, irregular_sensor, virtual_beams
from bimfit.estimation.likelihood import BeamModel, BeamSet
from bimfit.estimation.ownership import BeamTable, Mask, Sight, Views, beam_table, beside_artificial_ends
from bimfit.estimation.posterior import Window
from bimfit.estimation.spread import with_spread
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Slice

_UNKNOWN_RANGE = 1.0
_GRAZING, _FAR_OUT = 0.3, 0.2
_FEW_THROUGH = 3


@dataclass(frozen=True)
class Context:
    """What every step of one station needs.

    Attributes
    ----------
    section : JointSection
        The design.
    slice : Slice
        What the scan shows.
    beams : BeamSet
    table : BeamTable
        The same with what covering each costs while neither component is known.
    model : BeamModel
    sensor : SensorConfig
        As it is at the slice's range, its neighbours pooled.
    fit : FitConfig
    growth : float
        How many times the sensor's sigma at no range ``sensor.sigma`` is.
    virtual : bool
        Whether the beams were made up from points.
    reason : str
        Why a hole between points is no evidence; empty where it is.
    """

    section: JointSection
    slice: Slice
    beams: BeamSet
    table: BeamTable
    model: BeamModel
    sensor: SensorConfig
    fit: FitConfig
    growth: float
    virtual: bool
    reason: str

    @property
    def rows(self) -> tuple[Array, Array]:
        """Edges of both components as designed, (m, 6) each."""
        a, b = self.section.components
        return a.rows, b.rows

    @property
    def depth(self) -> float:
        """A return that much behind a surface went past it, m."""
        return self.table.margin

    @cached_property
    def window(self) -> Window:
        """The component's own window: it scales with the gap, but is never under the placement tolerance."""
        fit = self.fit
        half = max(fit.gap_fraction * self.section.gap.width, fit.placement_tolerance)
        return Window(0.64 * half, fit.component_angle / 1.5, 0.96 * half, 0.24 * half)

    def look(self, pose: Pose2D) -> Sight:
        """What the beams should see with both components at one pose, and which may speak for which.

        Those may not that end beside what is no surface, nor those that graze a face far out: a milliradian
        moves a range by millimetres there, a ridge too sharp for the quadrature's cells.
        """
        table = self.table
        sight = Sight(
            *kernels.look(*self.rows, pose.as_array(), table.rows, table.start, table.eye, _GRAZING, _FAR_OUT)
        )
        a, b = self.section.components
        if a.artificial or b.artificial:
            edges, surface = (pose.apply(a.edges), pose.apply(b.edges)), (a.surface, b.surface)
            margin = 2.0 * self.fit.placement_tolerance
            sight.may[:] &= ~beside_artificial_ends(sight, self.beams, edges, surface, margin)
        return sight

    def weigh(self, poses: Sequence[Pose2D], usable: Mask) -> Views:
        """What the beams should see with a pose each, and how far apart that leaves the components."""
        table = self.table
        at = np.array([(pose.u, pose.v, pose.theta) for pose in poses])
        return Views(
            *kernels.weigh(
                *self.rows, at, self.section.gap.corners, table.rows, table.start, table.eye, usable,
                self.depth, self.sensor.sigma, _FEW_THROUGH,
            )
        )  # fmt: skip


def station_context(
    section: JointSection, slice_: Slice, combined: Pose2D, sensor: SensorConfig, fit: FitConfig
) -> Context:
    """What every step needs, from what the scan shows and about where the joint is."""
    virtual: VirtualBeams | None = None
    (here, distance), reason = sensor_here(sensor, slice_), ""
    if slice_.beams is None or len(slice_.beams.ranges) == 0:
        virtual = virtual_beams(slice_, combined)
        beams = BeamSet.of(virtual.beams)
        if not virtual.spacing_known and sensor.missing == "gap":
            reason = virtual.reason
            here = irregular_sensor(here)
    else:
        beams = BeamSet.of(slice_.beams)
    if sensor.missing == "unknown":
        beams = beams.take(beams.r > 0.0)
    if sensor.sigma_per_metre > 0.0 or sensor.correlation > 0.0:
        beams = with_spread(beams, sensor, distance, _expected(section, beams, combined, sensor))
    model = BeamModel.of(here)
    table = beam_table(beams, model, max(4.0 * here.sigma, 1.5 * fit.placement_sigma))
    return Context(
        section, slice_, beams, table, model, here, fit, here.sigma / sensor.pooled().sigma,
        virtual is not None, reason,
    )  # fmt: skip


def _expected(section: JointSection, beams: BeamSet, pose: Pose2D, sensor: SensorConfig) -> Array | None:
    """Range that each beam should measure, m; None where sigma does not grow with it."""
    if not sensor.sigma_per_metre > 0.0:
        return None
    (a, b), at = section.components, pose.as_array()
    ranges, _ = kernels.scene(a.rows, b.rows, at, at, beams.rays, beams.start, beams.eye)
    return np.asarray(ranges.min(axis=0))


def sensor_here(sensor: SensorConfig, slice_: Slice) -> tuple[SensorConfig, float]:
    """The sensor at a slice's typical range with its neighbours pooled, and that range, m (0: any)."""
    distance = typical_range(slice_) if sensor.sigma_per_metre > 0.0 else 0.0
    return sensor.at(distance).pooled(), distance


def typical_range(slice_: Slice) -> float:
    """How far the joint is from the sensor, m: the median range of a slice, or of its points from its eye."""
    ranges = np.zeros(0)
    if slice_.beams is not None:
        ranges = slice_.beams.ranges[np.isfinite(slice_.beams.ranges)]
    elif slice_.viewpoint is not None and len(slice_.points):
        ranges = np.hypot(*(slice_.points - slice_.viewpoint).T)
    return float(np.median(ranges)) if len(ranges) else _UNKNOWN_RANGE
