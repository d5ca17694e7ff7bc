"""What is matched against: the visible surface of a joint's components, prepared once for a profile."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from bimfit.config import Config
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array
from bimfit.geometry.slice import Slice
from bimfit.geometry.visibility import visible_edges
from bimfit.registration.table import Target

_FAR_VIEW = 1.0
_VIEW_ANGLE = math.radians(2.0)
_VIEW_RATIO = 1.05


@dataclass(frozen=True)
class Targets:
    """The combined model and each component by itself, at one station."""

    combined: Target
    components: tuple[Target, Target]

    @property
    def all(self) -> tuple[Target, Target, Target]:
        """The three of them."""
        return (self.combined, *self.components)


@dataclass
class TargetCache:
    """Targets shared by all stations that have the same profiles and see them from about the same place.

    Parameters
    ----------
    config : Config
    outlines : bool
        Match whole outlines instead of the visible surface, as the paper does.
    """

    config: Config
    outlines: bool = False
    _made: dict[tuple[object, ...], Targets] = field(default_factory=dict)

    def get(self, section: JointSection, slice_: Slice) -> Targets:
        """The targets for a station, made when there are none yet."""
        viewpoint = expected_viewpoint(slice_)
        key = (*(id(profile) for profile in section.components), *_view_cell(viewpoint))
        if key not in self._made:
            self._made[key] = make_targets(section, viewpoint, self.config, outlines=self.outlines)
        return self._made[key]


def make_targets(
    section: JointSection, viewpoint: Array, config: Config, *, outlines: bool = False
) -> Targets:
    """Build a station's targets.

    The combined model is not the joint, since each component has moved by itself: its table is blurred by
    sqrt(sensor sigma^2 + placement sigma^2) (METHOD, section 2c); a component's by the sensor's sigma.
    """
    if outlines:
        edges = tuple(profile.edges[profile.surface] for profile in section.components)
        blur = config.sensor.sigma
    else:
        edges = visible_edges(section.components, viewpoint)
        blur = math.hypot(config.sensor.sigma, config.fit.placement_sigma)
    a, b = (Target.of(part, config.sensor.sigma) for part in edges)
    return Targets(Target.of(np.concatenate(edges), blur), (a, b))


def expected_viewpoint(slice_: Slice) -> Array:
    """Where the sensor stood in the section plane; 1 m straight out of the mouth where that is not known."""
    return np.array([0.0, _FAR_VIEW]) if slice_.viewpoint is None else slice_.viewpoint


def _view_cell(viewpoint: Array) -> tuple[int, int]:
    """Viewpoints that see the same: within 2 degrees and 5 % of the distance."""
    bearing = math.atan2(viewpoint[1], viewpoint[0])
    distance = max(float(np.hypot(*viewpoint)), 1e-3)
    return round(bearing / _VIEW_ANGLE), round(math.log(distance) / math.log(_VIEW_RATIO))


def prepare(sections: Sequence[JointSection], slices: Sequence[Slice], cache: TargetCache) -> list[Targets]:
    """Targets for every station, in order."""
    return [cache.get(section, slice_) for section, slice_ in zip(sections, slices, strict=True)]


def distinct(targets: Sequence[Targets]) -> list[Target]:
    """Every target once."""
    return list({id(target): target for group in targets for target in group.all}.values())
