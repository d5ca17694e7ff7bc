"""Other gaps in the slice that look like the joint's (METHOD, section 5: count the well-explained gaps).

Equal boards in a row explain the data equally well wherever the model is put. Which gap is meant, only the
design can say: the one nearest to where the joint is expected, provided that it is expected to be that near.
The joint as a whole is assumed to lie N(0, ``fit.joint_sigma``) off its design. A gap is taken for the
joint's where that makes every other gap seen 90 times less likely, and where the gap itself lies within three
deviations: beyond, the assumption is wrong and decides nothing. Otherwise the station is ``ambiguous``. A
scan that is off by about a whole pitch of equal boards puts another gap where the joint is expected; no slice
can tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bimfit.estimation import _kernels_inside as kernels
from bimfit.estimation.likelihood import BeamSet
from bimfit.estimation.result import Rival, StationEstimate
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.status import Status

_LEVEL, _TILT = 0.025, 0.1
"""A return that far from the mouth's line along v, m and a metre along it, is no edge of a gap beside it."""
_NARROW, _WIDE = 0.4, 1.8
_BEAMS = 2
_MOST = 4
_SURE = 4.5
"""Log-odds of the nearest gap against the next that decide."""
_EXPECTED = 3.0
"""So many standard deviations off the design a gap may be for its being the nearest to count."""


def gap_places(section: JointSection, beams: BeamSet, pose: Pose2D) -> list[Pose2D]:
    """Where else the slice has a gap of about the designed width at about the same level, nearest first.

    Parameters
    ----------
    pose : Pose2D
        Where the joint is taken to be; that gap itself is left out.

    Returns
    -------
    list of Pose2D
        At most four places to try.
    """
    width = section.gap.width
    middles = kernels.holes(
        pose.as_array(), beams.rays, beams.r, beams.start, beams.eye,
        _LEVEL, _TILT, _BEAMS, _NARROW * width, _WIDE * width + 0.004, max(0.8 * width, 0.010),
    )  # fmt: skip
    out = [pose @ Pose2D(u, v) for u, v in middles.tolist()]
    out.sort(key=lambda place: math.hypot(place.u - pose.u, place.v - pose.v))
    kept: list[Pose2D] = []
    for place in out:  # several sweeps show the same gap
        if all(math.hypot(place.u - k.u, place.v - k.v) > max(0.5 * width, 0.010) for k in kept):
            kept.append(place)
    return kept[:_MOST]


def with_lookalikes(
    station: StationEstimate, others: Sequence[StationEstimate], width: float, expected: float
) -> StationEstimate:
    """Choose among gaps that explain the slice equally well, and say whether the choice is safe.

    Parameters
    ----------
    others : sequence of StationEstimate
        The same slice estimated at the other places.
    width : float
        Of the designed gap, m.
    expected : float
        Standard deviation of the joint's place as a whole about its design, m.
    """
    if station.combined is None or not station.status.measured:
        return station
    alike = [e for e in others if e.status.measured and _apart(e, station, width)]
    best = min([station, *(e for e in alike if e.status.name == "ok")], key=_distance)
    near = _distance(best) < _EXPECTED * expected
    # amid chance holes a weak place is nothing against one that is expected
    rest = [e for e in (station, *alike) if _apart(e, best, width) and not (near and e.status.name == "weak")]
    if not rest or best.status.name not in ("ok", "weak"):
        return best
    second = min(rest, key=_distance)
    lead = (_distance(second) ** 2 - _distance(best) ** 2) / (2.0 * expected**2)
    if near and lead > _SURE:
        return best
    assert second.combined is not None and best.combined is not None
    off = math.hypot(second.combined.u - best.combined.u, second.combined.v - best.combined.v)
    reason = f"{len(rest) + 1} gaps in the slice look like this one; the next is {off * 1e3:.0f} mm away"
    a, b = (
        replace(c, rivals=(*c.rivals, Rival(o.pose, -lead))) if o.pose is not None else c
        for c, o in zip(best.components, second.components, strict=True)
    )
    return replace(
        best, components=(a, b), rival_odds=max(best.rival_odds, -lead), status=Status("ambiguous", reason)
    )


def _distance(station: StationEstimate) -> float:
    assert station.combined is not None
    return math.hypot(station.combined.u, station.combined.v)


def _apart(one: StationEstimate, two: StationEstimate, width: float) -> bool:
    """Whether two estimates are of different gaps: by where their components are, for those are measured."""
    a, b = _middle(one), _middle(two)
    return math.hypot(a[0] - b[0], a[1] - b[1]) > max(0.5 * width, 0.010)


def _middle(station: StationEstimate) -> tuple[float, float]:
    """Where the gap's middle has moved, m; of components without a pose, where the joint as a whole has."""
    poses = [c.pose or station.combined for c in station.components]
    moved = [(p.u, p.v) for p in poses if p is not None]
    u, v = np.mean(moved, axis=0).tolist()
    return u, v
