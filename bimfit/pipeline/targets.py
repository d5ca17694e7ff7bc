"""What is matched against: the visible surface of a joint's components, prepared once for a profile."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from bimfit.config import Config, SearchConfig
from bimfit.estimation.cloud import recovered_viewpoint
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Slice
from bimfit.geometry.visibility import clip_edges, visible_edges
from bimfit.registration.table import Tables, Target
from bimfit.simulation.rangefinder import aim

COMBINED_PAYS, COMPONENT_PAYS = 3000.0, 300.0
"""Cells of majorant tables that a slice pays for, in the wide and in a component's small window; measured."""
_MARGIN = 0.1
"""How much farther than the components' profiles a scan is used, since they may have moved, m."""
_FAR_VIEW, _FREE_VIEW = 1.0, 0.1
_VIEW_ANGLE = math.radians(2.0)
_VIEW_RATIO = 1.05


@dataclass(frozen=True)
class Targets:
    """The combined model and each component by itself, at one station.

    Attributes
    ----------
    combined : Target
    components : tuple of two Target
    stations : int
        How many stations share them.
    """

    combined: Target
    components: tuple[Target, Target]
    stations: int = 1

    @property
    def all(self) -> tuple[Target, Target, Target]:
        """The three of them."""
        return (self.combined, *self.components)


Edges = tuple[Array, ...]


@dataclass
class TargetCache:
    """Targets shared by all stations that show the sensor the same surface.

    Tables are the expensive part of a joint. Stations share them where their visible surfaces differ by
    less than a quarter of the search's tolerance, as along a joint that tapers or follows an arc; the
    search's answer is refined against each station's own profile anyway.

    Parameters
    ----------
    config : Config
    outlines : bool
        Match whole outlines instead of the visible surface, as the paper does.
    """

    config: Config
    outlines: bool = False
    _known: dict[tuple[object, ...], tuple[JointSection, Targets]] = field(default_factory=dict)
    _made: list[tuple[Edges, Targets]] = field(default_factory=list)

    def get(self, section: JointSection, slice_: Slice) -> Targets:
        """The targets for a station, made when there are none yet."""
        viewpoint = expected_viewpoint(slice_, section)
        key = (*(id(profile) for profile in section.components), *_view_cell(viewpoint))
        if key not in self._known:
            edges = matched_edges(section, viewpoint, self.config, outlines=self.outlines)
            self._known[key] = (section, self._shared(edges, float(np.hypot(*viewpoint))))
        return self._known[key][1]

    def _shared(self, edges: Edges, distance: float) -> Targets:
        slack = 0.25 * min(self.config.search.tolerance[:2])
        for other, targets in self._made:
            if all(
                p.shape == q.shape and np.allclose(p, q, rtol=0.0, atol=slack)
                for p, q in zip(edges, other, strict=True)
            ):
                return targets
        config = dataclasses.replace(self.config, sensor=self.config.sensor.at(distance))
        made = make_targets(edges, config, outlines=self.outlines)
        self._made.append((edges, made))
        return made


def matched_edges(
    section: JointSection, viewpoint: Array, config: Config, *, outlines: bool = False
) -> Edges:
    """What of each component is matched: its visible surface, or its whole outline as in the paper.

    Only what the returns can reach within the window: tables grow with the surface. Less would tie the hits
    to where the surface was cut off, and along a face that goes on they say nothing.
    """
    if outlines:
        edges: Edges = tuple(profile.edges[profile.surface] for profile in section.components)
    else:
        edges = visible_edges(section.components, viewpoint)
    box = np.full(2, match_reach(config) + max(config.search.window[:2]))
    return tuple(clip_edges(part, -box, box) for part in edges)


def matched_slice(slice_: Slice, config: Config) -> Slice:
    """The returns that are matched: those within reach of the mouth, without what shone through the gap."""
    near = (np.abs(slice_.points) <= match_reach(config)).all(axis=1)
    return slice_ if near.all() else dataclasses.replace(slice_, points=slice_.points[near], beams=None)


def match_reach(config: Config) -> float:
    """How far from the mouth surface and returns are matched, m."""
    return config.fit.reach + _MARGIN


def profile_reach(config: Config) -> float:
    """How far from the gap the components are cut, m: a cut end comes near no return that is matched."""
    return match_reach(config) + max(config.search.window[:2]) + 2.0 * config.fit.placement_tolerance


def make_targets(edges: Edges, config: Config, *, outlines: bool = False) -> Targets:
    """Build a station's targets from each component's edges.

    The combined model is not the joint, since each component has moved by itself: its table is blurred by
    sqrt(sensor sigma^2 + placement sigma^2) (METHOD, section 2c); a component's, and the paper's, by the
    sensor's sigma.
    """
    sigma = config.sensor.sigma
    blur = sigma if outlines else math.hypot(sigma, config.fit.placement_sigma)
    a, b = (Target.of(part, sigma) for part in edges)
    return Targets(Target.of(np.concatenate(edges), blur), (a, b))


def expected_viewpoint(slice_: Slice, section: JointSection) -> Array:
    """Where the sensor stood in the section plane; where that is not known, 1 m out of the open side."""
    return _FAR_VIEW * aim(section, _FREE_VIEW) if slice_.viewpoint is None else slice_.viewpoint


def with_assumed_view(slice_: Slice, section: JointSection) -> Slice:
    """A slice that does not know its sensor, seen from 1 m out of the joint's open side.

    A corner or a T is only ever seen from there; over a joint that is open all round, that is straight above.
    """
    if slice_.viewpoint is not None:
        return slice_
    return dataclasses.replace(slice_, viewpoint=_FAR_VIEW * aim(section, _FREE_VIEW))


def with_recovered_view(slices: Sequence[Slice]) -> tuple[Slice, ...]:
    """Slices of a cloud that does not know its sensor, seen from where all their bearings are most regular.

    As they are where the points are regular from nowhere.
    """
    eye = recovered_viewpoint([cut.points for cut in slices if len(cut.points)], Pose2D())
    return tuple(slices if eye is None else (dataclasses.replace(cut, viewpoint=eye) for cut in slices))


def _view_cell(viewpoint: Array) -> tuple[int, int]:
    """Viewpoints that see the same: within 2 degrees and 5 % of the distance."""
    bearing = math.atan2(viewpoint[1], viewpoint[0])
    distance = max(float(np.hypot(*viewpoint)), 1e-3)
    return round(bearing / _VIEW_ANGLE), round(math.log(distance) / math.log(_VIEW_RATIO))


def prepare(sections: Sequence[JointSection], slices: Sequence[Slice], cache: TargetCache) -> list[Targets]:
    """Targets for every station, in order."""
    found = [cache.get(section, slice_) for section, slice_ in zip(sections, slices, strict=True)]
    count = Counter(id(targets) for targets in found)
    counted = {id(t): dataclasses.replace(t, stations=count[id(t)]) for t in found}
    return [counted[id(targets)] for targets in found]


def economic(search: SearchConfig, target: Target, stations: int, pays: float) -> SearchConfig:
    """The same search by the bound that is cheaper in all, tables included.

    Quadratic majorants search several times faster than overlapped block maxima but take longer to build, the
    longer the more cells there are. Each station ``pays`` for so many of them. Both are proven and find the
    same pose.
    """
    if search.bound == "majorant" and stations * pays < target.cells(*search.tolerance[:2]):
        return dataclasses.replace(search, bound="overlap")
    return search


def distinct(targets: Sequence[Targets]) -> list[Target]:
    """Every target once."""
    return list({id(target): target for group in targets for target in group.all}.values())


def build_seconds(target: Target) -> float:
    """What building a target's look-up tables took, s."""
    return sum(kept.seconds for kept in target.kept.values() if isinstance(kept, Tables))
