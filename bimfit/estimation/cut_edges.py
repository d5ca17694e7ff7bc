"""Whether the edges at a gap's mouth are cut off where the design has corners: a likelihood-ratio test.

A bevel, a chamfer or a fillet for a square edge hardly shows in residuals, for what returns from its slope is
taken for a wider gap or for outliers. The evidence of the slice under each shape tells them apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from bimfit.estimation.posterior import Glance, Posterior
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.profile import Mask, Profile

Reshape = Callable[[int, Sequence[Profile], Pose2D | None], Sequence[Posterior | Glance | None]]
"""What is found of component 0 or 1 for each of several shapes of it, begun at a pose or where it is."""
CUTS = ((0.008, 0.008), (0.006, 0.020))
"""How much of the outer face and of the gap's side is cut off in the alternatives: a chamfer, a bevel, m."""
_MOST = 0.95
_DEEP = 10.0
"""A gap that many times deeper than wide is seen grazing: a milliradian weighs more there than a chamfer."""
_SAME = 1e-6


def odds_of_cut_edges(section: JointSection, reshape: Reshape) -> float:
    """Log Bayes factor of 'an edge at the mouth is cut off' against 'both are as designed'.

    The alternatives, A's edge cut, B's and both, with each of ``CUTS``, are equally likely beforehand.

    Parameters
    ----------
    reshape : callable
        Tries shapes of one component, the other held.
    """
    width = float(np.hypot(*(section.gap.mouth[1] - section.gap.mouth[0])))
    depth = max(float(np.hypot(*(side[-1] - side[0]))) for side in (section.gap.side_a, section.gap.side_b))
    if depth > _DEEP * max(width, CUTS[0][0]):
        return -math.inf
    gains = []
    for which, (component, side) in enumerate(
        zip(section.components, (section.gap.side_a, section.gap.side_b), strict=True)
    ):
        shapes = [cut_off(component, side, *cut) for cut in CUTS]
        gain = np.full(len(CUTS), -math.inf)
        gains.append(gain)
        if None in shapes:
            continue
        designed, *others = reshape(which, [component, *(s for s in shapes if s is not None)], None)
        if designed is None or None in others:
            continue
        found = [o for o in others if o is not None]
        best = max(found, key=lambda o: o.evidence)
        level = designed.evidence
        if best.evidence > level:  # maybe for having come to a better place, not for its shape
            (again,) = reshape(which, [component], best.pose)
            level = level if again is None else max(level, again.evidence)
        gain[:] = [o.evidence - level for o in found]
    a, b = gains
    ways = np.concatenate([a, b, a + b])
    top = float(ways.max())
    return top + math.log(float(np.mean(np.exp(ways - top)))) if math.isfinite(top) else -math.inf


def cut_off(profile: Profile, side: Array, back: float, deep: float) -> Profile | None:
    """The profile without its corner at the mouth; None where that is no vertex of it.

    Parameters
    ----------
    side : ndarray, shape (k, 2)
        The gap's side, from the mouth corner on.
    back, deep : float
        How much is cut off the outer face and the gap's side, m; never all of them.
    """
    corner, inward = side[0], side[1] - side[0]
    for n, loop in enumerate(profile.loops):
        away = np.hypot(*(loop - corner).T)
        k = int(np.argmin(away))
        if away[k] > _SAME or len(loop) < 3:
            continue
        arms = (loop[k - 1] - corner, loop[(k + 1) % len(loop)] - corner)
        # the gap's side is the arm that runs its way
        along = [float(arm @ inward) / max(float(np.hypot(*arm)), 1e-12) for arm in arms]
        sizes = (deep, back) if along[0] > along[1] else (back, deep)
        a, b = (
            corner + arm * min(size / max(float(np.hypot(*arm)), 1e-12), _MOST)
            for arm, size in zip(arms, sizes, strict=True)
        )
        cut = np.concatenate([loop[:k], [a, b], loop[k + 1 :]])
        loops = (*profile.loops[:n], cut, *profile.loops[n + 1 :])
        return Profile(loops, profile.guessed_length, _marks(profile, n, k))
    return None


def _marks(profile: Profile, n: int, k: int) -> tuple[Mask, ...]:
    """Which edges are artificial once a vertex has become an edge."""
    if not profile.artificial:
        return ()
    marks = list(profile.artificial)
    marks[n] = np.insert(marks[n], k, False)
    return tuple(marks)
