"""Shape freedoms in the main job: estimated after a first pass, then the joint is fitted again."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from bimfit.config import Config, SensorConfig
from bimfit.estimation.result import StationEstimate
from bimfit.estimation.shape import Shape, estimate_shape
from bimfit.gap.section import GapSection, GapSigma, gap_section
from bimfit.geometry.joint_section import GapOutline, JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.shape import deformed
from bimfit.geometry.status import Status
from bimfit.pipeline.records import FreedomResult

if TYPE_CHECKING:
    from bimfit.pipeline.fit import StationFit

Shapes = tuple[Shape | None, Shape | None]
_UNITS = {"thickness": ("mm", 1e3)}


@dataclasses.dataclass(frozen=True)
class StationShape:
    """Both components' shapes at one station, and the designed section that they differ from."""

    designed: JointSection
    shapes: Shapes
    station: int


def free_shapes(fits: Sequence[StationFit], sensor: SensorConfig, config: Config) -> list[StationFit]:
    """Estimate both components' freedoms and give every station its deformed section; estimates stay."""
    estimates = [fit.estimate for fit in fits if fit.estimate is not None]
    sections, slices = [fit.section for fit in fits], [fit.slice for fit in fits]
    a, b = (
        estimate_shape(estimates, sections, slices, which, config.shape, sensor, config.fit)
        for which in (0, 1)
    )
    return [
        dataclasses.replace(
            fit, section=_section(fit.section, (a, b), i), shape=StationShape(fit.section, (a, b), i)
        )
        for i, fit in enumerate(fits)
    ]


def _section(section: JointSection, shapes: Shapes, station: int) -> JointSection:
    for which, shape in enumerate(shapes):
        if shape is not None:
            section = deformed(section, which, shape.at(station))
    return section


def judged(estimate: StationEstimate, shape: StationShape) -> StationEstimate:
    """The estimate with the shape's share in its covariances, ``weak`` where a freedom is at its limit."""
    components = list(estimate.components)
    status = estimate.status
    for which, of in enumerate(shape.shapes):
        c = components[which]
        if of is None or c.covariance is None:
            continue
        G, V = of.gain[shape.station], of.covariance[shape.station]
        components[which] = dataclasses.replace(c, covariance=c.covariance + G @ V @ G.T)
        for k in np.flatnonzero(of.at_limit[shape.station]):
            reason = f"component {'AB'[which]}: its {of.names[k]} is at the limit of its freedom"
            reason += f" ({_said(of, shape.station, int(k))})"
            if status.name == "ok":
                status = Status("weak", reason)
    return dataclasses.replace(estimate, components=(components[0], components[1]), status=status)


def _said(shape: Shape, station: int, k: int) -> str:
    unit, factor = _UNITS.get(shape.names[k], ("degrees", 180.0 / math.pi))
    return f"{shape.value[station, k] * factor:+.1f} {unit} from the design"


def freedoms(shape: StationShape | None, which: int) -> tuple[FreedomResult, ...]:
    """What is reported of one component's freedoms at one station."""
    of = None if shape is None else shape.shapes[which]
    if of is None or shape is None:
        return ()
    i = shape.station
    out = []
    for k, name in enumerate(of.names):
        if of.unseen[k]:
            out.append(FreedomResult(name, None, None, "unseen", ""))
            continue
        state = "at its limit" if of.at_limit[i, k] else "estimated"
        out.append(FreedomResult(name, float(of.value[i, k]), float(of.sd[i, k]), state, of.model[k]))
    return tuple(out)


def with_shape_sigma(
    gap: GapSection, shape: StationShape, poses: tuple[Pose2D, Pose2D], covariances: tuple[Array, Array]
) -> GapSection:
    """The gap with the shapes' own uncertainty added to its deviations.

    ``covariances`` hold what the shape adds to the poses; it is taken out here and put back together with
    what it does to the sides themselves, for the two go together.
    """
    if gap.sigma is None:
        return gap
    own = list(covariances)
    extra = np.zeros(len(dataclasses.fields(GapSigma)))
    for which, of in enumerate(shape.shapes):
        if of is None:
            continue
        i = shape.station
        own[which] = own[which] - of.gain[i] @ of.covariance[i] @ of.gain[i].T
        values, axes = np.linalg.eigh(of.covariance[i])
        for sd, axis in zip(np.sqrt(np.maximum(values, 0.0)), axes.T, strict=True):
            if sd > 0.0:
                up, down = (_moved(gap, shape, poses, which, sign * sd * axis) for sign in (1.0, -1.0))
                extra += np.square(0.5 * (up - down))
    alone = gap_section(gap.s, gap.frame, _outline(shape), *poses, *own).sigma
    if alone is None:
        return gap
    total = np.sqrt(np.square(dataclasses.astuple(alone)) + extra)
    return dataclasses.replace(gap, sigma=GapSigma(*total.tolist()))


def _outline(shape: StationShape) -> GapOutline:
    return _section(shape.designed, shape.shapes, shape.station).gap


def _moved(
    gap: GapSection, shape: StationShape, poses: tuple[Pose2D, Pose2D], which: int, change: Array
) -> Array:
    """The gap's figures, in the order of GapSigma, when a component's freedoms and its pose move."""
    of = shape.shapes[which]
    assert of is not None
    seen = ~of.unseen
    values = {
        name: float(of.value[shape.station, k] + change[k]) for k, name in enumerate(of.names) if seen[k]
    }
    section = deformed(shape.designed, which, values)
    other = shape.shapes[1 - which]
    if other is not None:
        section = deformed(section, 1 - which, other.at(shape.station))
    both = list(poses)
    both[which] = Pose2D.from_array(poses[which].as_array() + of.gain[shape.station] @ change)
    g = gap_section(gap.s, gap.frame, section.gap, both[0], both[1])
    return np.array(
        [g.origin[0], g.origin[1], g.angle, g.width_mouth, g.area, g.width_root, g.width_narrowest]
    )
