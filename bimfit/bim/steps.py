"""Stepped sections: strips that lie beside one another, as rebated, halved and tongued edges have them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bimfit.bim.legs import COMMON, NEARLY_PARALLEL, Leg, Lip, likely_pairs

_FACING = 0.7  # cosine from which a strip of the section counts as parallel to the leading one


def join_steps(legs: list[Leg]) -> list[Leg]:
    """Join strips beside one another into one stepped section, led by the largest."""
    legs = sorted(legs, key=lambda leg: -leg.area)
    beside: dict[int, set[int]] = defaultdict(set)
    for i, j in likely_pairs(legs, parallel=NEARLY_PARALLEL, turn=(-0.2, 1.1), near=True):
        if _steps(legs[i], legs[j]):
            beside[i].add(j)
            beside[j].add(i)
    out: list[Leg] = []
    taken = [False] * len(legs)
    for i, main in enumerate(legs):
        if taken[i]:
            continue
        taken[i] = True
        group, queue = [main], [i]
        while queue:
            for j in sorted(beside[queue.pop()]):
                if not taken[j]:
                    taken[j] = True
                    group.append(legs[j])
                    queue.append(j)
        out.append(replace(_stepped(group), square=_square(group)))
    return out


def _square(group: Sequence[Leg]) -> Leg | None:
    """The section led by the largest of the strips that are not parallel to the first, if there is one."""
    across = group[0].u[0]
    rest = [leg for leg in group if abs(float(leg.u[0] @ across)) <= _FACING]
    if not rest:
        return None
    lead = max(rest, key=lambda leg: leg.area)
    return _stepped([lead, *(leg for leg in group if leg is not lead)])


def _steps(a: Leg, b: Leg) -> bool:
    if not (a.straight and b.straight) or abs(a.way @ b.way) < NEARLY_PARALLEL or a.u[0] @ b.u[0] < -0.2:
        return False
    way = a.way
    ta, tb = np.sort(a.points @ way), np.sort(b.points @ way)
    common = min(ta[1], tb[1]) - max(ta[0], tb[0])
    if common < COMMON * min(a.length, b.length):
        return False
    ends = []
    for leg in (a, b):
        middle, side = leg.middle, leg.side
        ends.append(np.stack([middle - 0.5 * leg.depth * side, middle + 0.5 * leg.depth * side]))
    apart = ends[0][:, None] - ends[1][None]
    apart = apart - (apart @ way)[..., None] * way
    return float(np.linalg.norm(apart, axis=2).min()) < 1.5 * max(abs(a.gap), abs(b.gap)) + 5e-3


def _stepped(group: Sequence[Leg]) -> Leg:
    """The section of a group, led by its first: the spine in that strip's gap, midway in the whole depth.

    The gap is the narrowest of the strips parallel to the main one, as that between the lands of a groove.
    """
    main = group[0]
    if len(group) == 1:
        return main
    side, across = main.side, main.u[0]
    middle = np.array([leg.middle for leg in group]) - main.middle
    half = np.array([0.5 * leg.depth * abs(float(leg.side @ side)) for leg in group])
    low, high = middle @ side - half, middle @ side + half
    depth, shift = float(high.max() - low.min()), 0.5 * float(high.max() + low.min())
    facing = [k for k, leg in enumerate(group) if leg.u[0] @ across > _FACING]
    bottom, lead, top = (
        Lip(float(middle[k] @ across), float(middle[k] @ side) - shift, group[k].depth)
        for k in (min(facing, key=lambda k: low[k]), 0, max(facing, key=lambda k: high[k]))
    )
    narrowest = min((group[k] for k in facing), key=lambda leg: leg.gap)
    return replace(
        main,
        points=main.points + shift * side,
        depth=max(depth, main.depth),
        gap=narrowest.gap,
        low=min(group[k].low for k in facing),
        high=max(group[k].high for k in facing),
        area=sum(leg.area for leg in group),
        lips=(bottom, lead, top),
    )
