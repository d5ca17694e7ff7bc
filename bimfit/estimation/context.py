"""What every step of one station's estimate needs: the design, the beams, and the sensor as it is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation import _kernels_inside as kernels
from bimfit.estimation.cloud import irregular_sensor, virtual_beams
from bimfit.estimation.likelihood import BeamModel, BeamSet, edge_rows
from bimfit.estimation.ownership import (
    Ints,
    Mask,
    Scene,
    beside_artificial_ends,
    through,
)
from bimfit.estimation.posterior import Window
from bimfit.estimation.slide import designed_width
from bimfit.estimation.spread import with_spread
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Slice

_UNKNOWN_RANGE = 1.0
_GRAZING, _FAR_OUT = 0.3, 0.2


@dataclass(frozen=True)
class Context:
    """What every step of one station needs."""

    section: JointSection
    beams: BeamSet
    rows: tuple[Array, Array]
    model: BeamModel
    sensor: SensorConfig
    fit: FitConfig
    virtual: bool

    @property
    def depth(self) -> float:
        """A return that much behind a surface went past it, m."""
        return max(4.0 * self.sensor.sigma, 1.5 * self.fit.placement_sigma)

    @property
    def window(self) -> Window:
        """The component's own window: it scales with the gap, but is never under the placement tolerance."""
        fit = self.fit
        half = max(fit.gap_fraction * designed_width(self.section), fit.placement_tolerance)
        return Window(0.64 * half, fit.component_angle / 1.5, 0.96 * half, 0.24 * half)

    def scene(self, poses: Sequence[Pose2D]) -> Scene:
        """Predicted ranges of both components at a pose each."""
        return Scene.at(self.rows, poses, self.beams)

    def passed(self, poses: Sequence[Pose2D], scene: Scene) -> int:
        """Beams that went in between the components' mouth corners."""
        a, b = (pose.apply(m) for pose, m in zip(poses, self.section.gap.mouth, strict=True))
        return through((a, b), self.beams, scene.nearest, self.depth, self.sensor.sigma)

    def usable(self, scene: Scene, side: Ints, pose: Pose2D) -> Mask:
        """Beams that may speak: away from ends that are no surface, and not grazing a face far out.

        There a milliradian moves a range by millimetres: a ridge too sharp for the quadrature's cells.
        """
        components, beams = self.section.components, self.beams
        surface = (components[0].surface, components[1].surface)
        use = np.ones(len(beams), bool)
        if not (surface[0].all() and surface[1].all()):
            edges = (pose.apply(components[0].edges), pose.apply(components[1].edges))
            margin = 2.0 * self.fit.placement_tolerance
            use = ~beside_artificial_ends(scene, side, beams, edges, surface, margin)
        kernels.far_grazing(
            *self.rows, pose.as_array(), scene.ranges, scene.faces, beams.rays, beams.start, beams.eye,
            _GRAZING, _FAR_OUT, use,
        )  # fmt: skip
        return use


def station_context(
    section: JointSection, slice_: Slice, combined: Pose2D, sensor: SensorConfig, fit: FitConfig
) -> tuple[Context, str]:
    """What every step needs, and why a hole between points is no evidence (empty where it is)."""
    virtual, reason = None, ""
    own, (sensor, distance) = sensor, sensor_here(sensor, slice_)
    if slice_.beams is None or len(slice_.beams.ranges) == 0:
        virtual = virtual_beams(slice_, combined)
        beams = BeamSet.of(virtual.beams)
        if not virtual.spacing_known and sensor.missing == "gap":
            reason = virtual.reason
            sensor = irregular_sensor(sensor)
    else:
        beams = BeamSet.of(slice_.beams)
    if sensor.missing == "unknown":
        beams = beams.take(beams.r > 0.0)
    rows = (edge_rows(section.components[0]), edge_rows(section.components[1]))
    grows = own.sigma_per_metre > 0.0
    expected = Scene.at(rows, (combined, combined), beams).nearest if grows else None
    beams = with_spread(beams, own, distance, expected)
    context = Context(section, beams, rows, BeamModel.of(sensor), sensor, fit, virtual is not None)
    return context, reason


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
