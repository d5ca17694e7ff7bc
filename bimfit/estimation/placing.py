"""Where a station's joint is as a whole: the combined pose and its rivals, slid and fitted."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from bimfit.estimation import checks
from bimfit.estimation.components import components_at
from bimfit.estimation.context import Context
from bimfit.estimation.result import StationEstimate
from bimfit.estimation.slide import SlideResult, best_start
from bimfit.geometry.pose import Pose2D

_FAR_ALONG = 0.025
_WORTH_A_LOOK = -15.0


def placed(
    context: Context,
    combined: Pose2D,
    matches: tuple[Pose2D | None, Pose2D | None],
    rivals: Sequence[Pose2D],
) -> StationEstimate:
    """The best estimate near the combined pose and its rivals."""
    slid = max(
        (_slid(context, combined, rivals), *(_slid(context, pose, ()) for pose in _home(combined))),
        key=lambda place: place.score,
    )
    best = components_at(context, slid, matches)
    if slid.rival is None or slid.rival_odds < _WORTH_A_LOOK:
        return best
    # the slide's blur cannot tell the two apart for certain; both fitted at the sensor's sigma can
    other = components_at(context, dataclasses.replace(slid, pose=slid.rival, rival=slid.pose), (None, None))
    odds = _evidence(other) - _evidence(best)
    if best.status.measured and not other.status.measured:
        return best  # what explains more by being impossible is no rival
    if odds > 0.0 or (other.status.measured and not best.status.measured):
        best, odds = other, -abs(odds)
    return checks.with_rival(best, odds)


def _slid(context: Context, combined: Pose2D, rivals: Sequence[Pose2D]) -> SlideResult:
    """Slide the combined pose and its rivals, by the beams that may speak there."""
    usable = context.look(combined).usable
    table = context.table if usable.all() else context.table.take(usable)
    return best_start(context.section, table, (combined, *rivals), context.sensor, context.fit)


def _home(combined: Pose2D) -> tuple[Pose2D, ...]:
    """The combined pose slid back along the faces to the design, where it is too far for the slide to look.

    Faces that go on for longer than the scan is used leave the hits of a combined search all but flat along
    them; only the beams that miss tell where the gap is.
    """
    c, s = math.cos(combined.theta), math.sin(combined.theta)
    along = combined.u * c + combined.v * s
    if abs(along) < _FAR_ALONG:
        return ()
    return (Pose2D(combined.u - along * c, combined.v - along * s, combined.theta),)


def _evidence(estimate: StationEstimate) -> float:
    """Log evidence of both components; one that cannot be seen explains nothing."""
    return sum(c.posterior.evidence for c in estimate.components if c.posterior is not None)
