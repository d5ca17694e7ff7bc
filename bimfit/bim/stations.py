"""A joint's design, cut at its stations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from bimfit.config import FitConfig
from bimfit.errors import ConfigError, JointError
from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.joint_section import GapOutline, JointSection
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.outline import trace_gap
from bimfit.geometry.path import JointPath
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.profile import Profile
from bimfit.geometry.section import clip_window, cut

UNIFORM = 1e-6
"""Sections that differ by no more than this are one, m."""
REACH = FitConfig.reach
"""How much of the components is kept around the gap unless the caller says otherwise, m."""
_MEMORY = 8  # distinct cuts of a joint that are compared with the next
_WIDE = 0.05  # a gap this much beyond twice the joint's usual width is a missing component, m


class HasMesh(Protocol):
    """A building element, as far as sections need one."""

    @property
    def mesh(self) -> TriangleMesh:
        """Its surface in world coordinates, m."""
        ...


class HasElements(Protocol):
    """A model, as far as sections need one."""

    def element(self, guid: str) -> HasMesh:
        """The element of that GlobalId."""
        ...


class HasPath(Protocol):
    """A joint, as far as sections need one: A's and B's GlobalId and the path."""

    @property
    def elements(self) -> tuple[str, str]:
        """GlobalIds of A and B."""
        ...

    @property
    def path(self) -> JointPath:
        """Spine and axes."""
        ...


def default_stations(length: float, spacing: float) -> Array:
    """Stations that each stand for one spacing, the first and last half a spacing inside, shape (n,).

    The spacing is fitted to the length, so that it comes out even.

    Raises
    ------
    ConfigError
        When the spacing is not a positive number.
    """
    if not (np.isfinite(spacing) and spacing > 0.0):
        raise ConfigError(f"the spacing of stations must be a positive number, got {spacing}")
    count = max(1, round(length / spacing))
    return np.asarray((np.arange(count) + 0.5) * (length / count))


def design_section(
    element_a: HasMesh, element_b: HasMesh, rough: SectionFrame, s: float, reach: float = REACH
) -> JointSection | None:
    """Cut two elements at a rough frame and settle the section's frame on their gap.

    Parameters
    ----------
    element_a, element_b : HasMesh
        A lies towards -u and B towards +u of the gap.
    rough : SectionFrame
        u and v as they are to be; the origin in or near the gap.
    s : float
        Distance along the joint, m, kept in the result.
    reach : float
        How much of the components is kept around the gap, m. The cuts' edges are no surface.

    Returns
    -------
    JointSection or None
        The origin is midway between the mouth corners; None where a component is missing, or where
        nothing of A faces B.
    """
    settled = _settled((cut(element_a.mesh, rough), cut(element_b.mesh, rough)), reach)
    return None if settled is None else _section(s, rough, settled)


@dataclass(frozen=True)
class _Settled:
    """A section whose frame is settled: where in the rough frame its origin lies, and the rest in its own."""

    origin: Array
    components: tuple[Profile, Profile]
    gap: GapOutline


def _section(s: float, rough: SectionFrame, settled: _Settled) -> JointSection:
    frame = SectionFrame(rough.to_world(settled.origin), rough.u, rough.v, rough.n)
    return JointSection(float(s), frame, settled.components, settled.gap)


def _settled(whole: tuple[Profile, Profile], reach: float) -> _Settled | None:
    if whole[0].empty or whole[1].empty:
        return None
    outline = trace_gap(*whole)
    if outline is None:
        return None
    corner_a, corner_b = outline.mouth
    middle = 0.5 * (corner_a + corner_b)
    gap = GapOutline(outline.side_a - middle, outline.side_b - middle)
    around = np.concatenate([gap.side_a, gap.side_b])
    low, high = around.min(axis=0) - reach, around.max(axis=0) + reach
    to_gap = Pose2D(-float(middle[0]), -float(middle[1]))
    window = (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))
    a, b = (clip_window(profile.moved(to_gap), *window) for profile in whole)
    return _Settled(middle, (a, b), gap)


def design_sections(
    elements: HasElements | Mapping[str, HasMesh], joint: HasPath, stations: ArrayLike, reach: float = REACH
) -> tuple[JointSection, ...]:
    """Cut a joint's elements at every station.

    Where neighbouring sections are the same within 1 um, the *same* Profile and GapOutline objects are
    returned, so that what is built from them can be built once.

    Parameters
    ----------
    elements : Model, or mapping of str to HasMesh
        Where the joint's two elements are found by their GlobalIds.
    joint : HasPath
        Whose sections; ``elements`` names A, then B.
    stations : array_like, shape (n,)
        Distances along the joint, m.
    reach : float
        See :func:`design_section`.

    Returns
    -------
    tuple of JointSection
        In the order of the stations. A station at which a component is missing, as where an opening reaches
        the joint and the gap is far wider than ``joint.width`` (or, without one, than at most stations), is
        left out, as is one whose plane runs along the joint's other leg. :func:`missing_stations` names them.

    Raises
    ------
    JointError
        When an element of the joint is not there.
    """
    a, b = (_element(elements, guid) for guid in joint.elements)
    known: list[tuple[tuple[Profile, Profile], _Settled | None]] = []
    found = []
    for s in np.asarray(stations, float).reshape(-1).tolist():
        rough = joint.path.rough_frame(s)
        whole = cut(a.mesh, rough), cut(b.mesh, rough)
        # along a straight joint most cuts are alike: what follows from them is worked out once
        alike = (k for k in reversed(known[-_MEMORY:]) if _same_pair(k[0], whole))
        latest = next(alike, None)
        if latest is None:
            latest = whole, _settled(whole, reach)
            known.append(latest)
        settled = latest[1]
        if settled is not None:
            found.append(_section(s, rough, settled))
    if not found:
        return ()
    widths = np.array([_width(section.gap) for section in found])
    # what is found across a far wider gap is not what the joint is between
    designed = getattr(joint, "width", None)
    usual = float(np.median(widths)) if designed is None else max(float(designed), 0.0)
    kept = widths <= 2.0 * usual + _WIDE
    if len(joint.path.u) > 1 and not joint.path.curved:
        # beside a corner a plane can run along the other leg's mouth: a hair off, it would show another gap
        sizes = np.array([_size(section.gap) for section in found])
        kept &= sizes <= 2.0 * max(float(np.median(sizes)), float(getattr(joint, "depth", 0.0))) + _WIDE
    return _shared([section for section, keep in zip(found, kept, strict=True) if keep])


def _element(elements: HasElements | Mapping[str, HasMesh], guid: str) -> HasMesh:
    if not isinstance(elements, Mapping):
        return elements.element(guid)
    if guid not in elements:
        raise JointError(f"no element has the GlobalId {guid}")
    return elements[guid]


def missing_stations(stations: ArrayLike, sections: Sequence[JointSection]) -> Array:
    """The stations for which there is no section, shape (m,), m."""
    wanted = np.asarray(stations, float).reshape(-1)
    there = np.array([section.s for section in sections])
    return np.asarray(wanted[~np.isin(wanted, there)])


def _width(gap: GapOutline) -> float:
    a, b = gap.mouth
    c, d = gap.root
    return float(min(np.linalg.norm(a - b), np.linalg.norm(c - d)))


def _size(gap: GapOutline) -> float:
    around = np.concatenate([gap.side_a, gap.side_b])
    return float(np.linalg.norm(np.ptp(around, axis=0)))


def _shared(sections: Sequence[JointSection]) -> tuple[JointSection, ...]:
    """The same sections, with equal profiles and outlines made the same objects."""
    profiles: tuple[list[Profile], list[Profile]] = [], []
    gaps: list[GapOutline] = []
    out = []
    for section in sections:
        a, b = (_known(known, own) for known, own in zip(profiles, section.components, strict=True))
        gap = next((g for g in reversed(gaps[-_MEMORY:]) if _same_gap(g, section.gap)), None)
        if gap is None:
            gap = section.gap
            gaps.append(gap)
        out.append(JointSection(section.s, section.frame, (a, b), gap))
    return tuple(out)


def _known(known: list[Profile], own: Profile) -> Profile:
    for profile in reversed(known[-_MEMORY:]):
        if same_profile(profile, own):
            return profile
    known.append(own)
    return own


def _same_pair(p: tuple[Profile, Profile], q: tuple[Profile, Profile]) -> bool:
    return same_profile(p[0], q[0]) and same_profile(p[1], q[1])


def same_profile(p: Profile, q: Profile, tolerance: float = UNIFORM) -> bool:
    """Whether two profiles have the same loops, vertex for vertex, wherever each loop starts."""
    if len(p.loops) != len(q.loops) or abs(p.guessed_length - q.guessed_length) > tolerance:
        return False
    flags_p = p.artificial or tuple(np.zeros(len(loop), bool) for loop in p.loops)
    flags_q = q.artificial or tuple(np.zeros(len(loop), bool) for loop in q.loops)
    return all(_same_loop(*each, tolerance) for each in zip(p.loops, q.loops, flags_p, flags_q, strict=True))


def _same_loop(p: Array, q: Array, flags_p: ArrayLike, flags_q: ArrayLike, tolerance: float) -> bool:
    if len(p) != len(q):
        return False
    shift = int(np.argmin(np.linalg.norm(q - p[0], axis=1)))
    if shift:
        q, flags_q = np.roll(q, -shift, axis=0), np.roll(flags_q, -shift)
    return bool(np.abs(q - p).max() <= tolerance) and bool(np.array_equal(flags_q, flags_p))


def _same_gap(g: GapOutline, h: GapOutline) -> bool:
    pairs = (g.side_a, h.side_a), (g.side_b, h.side_b)
    return all(p.shape == q.shape and bool(np.abs(p - q).max() <= UNIFORM) for p, q in pairs)
