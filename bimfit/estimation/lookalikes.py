"""Other gaps in the slice that look like the joint's (METHOD, section 5: count the well-explained gaps).

Equal boards in a row explain the data equally well wherever the model is put. Which gap is meant, only the
design can say: the one nearest to where the joint is expected.
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

_LEVEL = 0.025
"""A return that far from the mouth's line, along v, is no edge of a gap beside it, m."""
_NARROW, _WIDE = 0.4, 1.8
_BEAMS = 3
_MOST = 4
_SURE = 4.5


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
    width = float(np.hypot(*(section.gap.mouth[1] - section.gap.mouth[0])))
    middles = kernels.holes(
        pose.as_array(), beams.rays, beams.r, beams.start, beams.eye,
        _LEVEL, _BEAMS, _NARROW * width, _WIDE * width + 0.004, max(0.8 * width, 0.010),
    )  # fmt: skip
    out = [pose @ Pose2D(u, v) for u, v in middles.tolist()]
    out.sort(key=lambda place: math.hypot(place.u - pose.u, place.v - pose.v))
    kept: list[Pose2D] = []
    for place in out:  # several sweeps show the same gap
        if all(math.hypot(place.u - k.u, place.v - k.v) > max(0.5 * width, 0.010) for k in kept):
            kept.append(place)
    return kept[:_MOST]


def with_lookalikes(
    station: StationEstimate, others: Sequence[StationEstimate], expected: float
) -> StationEstimate:
    """Choose among gaps that explain the slice equally well, and say whether the choice is safe.

    Parameters
    ----------
    others : sequence of StationEstimate
        The same slice estimated at the other places.
    expected : float
        Standard deviation of the joint's place as a whole about its design, m.
    """
    good = [e for e in others if e.status.name == "ok" and e.combined is not None and _apart(e, station)]
    if not good or station.combined is None or not station.status.measured:
        return station
    ranked = sorted([station, *good], key=_distance)
    best = ranked[0]
    lead = (_distance(ranked[1]) ** 2 - _distance(best) ** 2) / (2.0 * expected**2)
    if lead > _SURE or best.status.name not in ("ok", "weak"):
        return best
    other = ranked[1].combined
    assert other is not None and best.combined is not None
    off = math.hypot(other.u - best.combined.u, other.v - best.combined.v)
    reason = f"{len(good) + 1} gaps in the slice look like this one; the next is {off * 1e3:.0f} mm away"
    a, b = (
        replace(c, rivals=(*c.rivals, Rival(o.pose, -lead))) if o.pose is not None else c
        for c, o in zip(best.components, ranked[1].components, strict=True)
    )
    return replace(
        best, components=(a, b), rival_odds=max(best.rival_odds, -lead), status=Status("ambiguous", reason)
    )


def _distance(station: StationEstimate) -> float:
    assert station.combined is not None
    return math.hypot(station.combined.u, station.combined.v)


def _apart(one: StationEstimate, two: StationEstimate) -> bool:
    """Whether two estimates are of different gaps."""
    if one.combined is None or two.combined is None:
        return False
    return math.hypot(one.combined.u - two.combined.u, one.combined.v - two.combined.v) > 0.010
