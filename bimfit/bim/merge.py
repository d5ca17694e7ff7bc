"""Fifth stage of the joint finder: strips of one pair of elements joined into legs and paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bimfit.bim.legs import HOLE, NEARLY_PARALLEL, SNAP, Leg, likely_pairs
from bimfit.bim.steps import join_steps
from bimfit.geometry.pose import Array

_PARALLEL = 0.9998
_FACET_TURN = (0.004, 0.45)


def merge(legs: Sequence[Leg]) -> list[Leg]:
    """Join the strips of one pair and state: facets turned, runs of one plane, steps, then end to end."""
    if len(legs) < 2:
        return list(legs)
    out = _turn_facets(list(legs))
    out = _join_collinear(out)
    out = join_steps(out)
    return _join_ends(out)


def _turn_facets(legs: list[Leg]) -> list[Leg]:
    """Facets of a curve that are deeper than they are long: let their axes follow the curve."""
    links: dict[int, list[int]] = {i: [] for i in range(len(legs))}
    turn = (float(np.cos(_FACET_TURN[1])), float(np.cos(_FACET_TURN[0])))
    for i, j in likely_pairs(legs, parallel=NEARLY_PARALLEL, turn=turn, near=True):
        if _neighbours_across(legs[i], legs[j]):
            links[i].append(j)
            links[j].append(i)
    seen: set[int] = set()
    for i in links:
        if i in seen or not links[i]:
            continue
        run, queue = [], [i]
        seen.add(i)
        while queue:
            k = queue.pop()
            run.append(k)
            fresh = [j for j in links[k] if j not in seen]
            seen.update(fresh)
            queue.extend(fresh)
        if len(run) >= 3 and sum(legs[k].depth for k in run) > max(legs[k].length for k in run):
            for k in run:
                legs[k] = _turned(legs[k])
    return legs


def _turned(leg: Leg) -> Leg:
    middle, side = leg.middle, leg.side
    points = np.stack([middle - 0.5 * leg.depth * side, middle + 0.5 * leg.depth * side])
    return replace(leg, points=points, length=leg.depth, depth=leg.length, legs=(leg.depth,))


def _neighbours_across(a: Leg, b: Leg) -> bool:
    """Whether two strips lie side by side along their long sides and turn a little about them."""
    turn = float(np.arccos(np.clip(a.u[0] @ b.u[0], -1.0, 1.0)))
    if not _FACET_TURN[0] < turn < _FACET_TURN[1] or abs(a.way @ b.way) < NEARLY_PARALLEL:
        return False
    apart = b.middle - a.middle
    along = abs(float(apart @ a.way))
    reach = 0.5 * (a.depth + b.depth)
    across = float(np.linalg.norm(apart - (apart @ a.way) * a.way))
    alike = abs(a.length - b.length) < 0.1 * max(a.length, b.length)
    return alike and along < 0.05 * a.length and abs(across - reach) < 0.1 * reach + 2e-3


def _join_collinear(legs: list[Leg]) -> list[Leg]:
    """Join runs of one plane and one axis with at most 50 mm between them."""
    done = False
    while not done:
        done = True
        for i, j in likely_pairs(legs, parallel=_PARALLEL, turn=(_PARALLEL, 1.1), row=True):
            joined = _collinear(legs[i], legs[j])
            if joined is not None:
                legs = [leg for k, leg in enumerate(legs) if k not in (i, j)] + [joined]
                done = False
                break
    return legs


def _collinear(a: Leg, b: Leg) -> Leg | None:
    if not (a.straight and b.straight) or a.u[0] @ b.u[0] < _PARALLEL or abs(a.way @ b.way) < _PARALLEL:
        return None
    way = a.way
    offset = b.middle - a.middle
    beside = offset - (offset @ way) * way
    if abs(beside @ a.u[0]) > SNAP or abs(beside @ a.side) > 0.1 * max(a.depth, b.depth):
        return None
    if abs(a.depth - b.depth) > 0.2 * max(a.depth, b.depth) or abs(a.gap - b.gap) > 2.0 * SNAP:
        return None
    ta, tb = np.sort((a.points - a.points[0]) @ way), np.sort((b.points - a.points[0]) @ way)
    hole = max(ta[0], tb[0]) - min(ta[1], tb[1])
    if not -0.005 <= hole <= HOLE:
        return None
    low, high = min(ta[0], tb[0]), max(ta[1], tb[1])
    length = a.length + b.length
    return replace(
        a,
        points=a.points[0] + np.outer([low, high], way),
        length=length,
        depth=(a.depth * a.length + b.depth * b.length) / length,
        gap=(a.gap * a.area + b.gap * b.area) / (a.area + b.area),
        low=min(a.low, b.low),
        high=max(a.high, b.high),
        area=a.area + b.area,
        legs=(length,),
    )


def _join_ends(legs: list[Leg]) -> list[Leg]:
    """Join legs end to end into polylines, nearest ends first."""
    open_ = [i for i, leg in enumerate(legs) if not leg.closed]
    candidates = []
    for i, e, j, f in _near_ends(legs, open_):
        distance = _end_distance(legs[i], e, legs[j], f)
        if distance is not None:
            candidates.append((distance, i, e, j, f))
    partner: dict[tuple[int, int], tuple[int, int]] = {}
    for _, i, e, j, f in sorted(candidates):
        if (i, e) not in partner and (j, f) not in partner:
            partner[i, e], partner[j, f] = (j, f), (i, e)
    out = [leg for i, leg in enumerate(legs) if i not in open_]
    left = set(open_)
    while left:
        start = min((i for i in left if (i, 0) not in partner or (i, 1) not in partner), default=min(left))
        entry = 1 if (start, 0) in partner and (start, 1) not in partner else 0
        chain: list[Leg] = []
        i, e = start, entry
        while i in left:
            left.discard(i)
            chain.append(legs[i] if e == 0 else _reversed(legs[i]))
            onward = partner.get((i, 1 - e))
            if onward is None:
                break
            i, e = onward
        ring = (start, entry) in partner and len(chain) > 2 and partner[start, entry] == (i, 1 - e)
        ring = ring or ((start, entry) in partner and i == start and len(chain) > 2)
        out.append(_chained(chain, closed=ring))
    return out


def _reversed(leg: Leg) -> Leg:
    lips = leg.lips
    if lips is not None:
        lips = (lips[2].mirrored(), lips[1].mirrored(), lips[0].mirrored())
    points, u = leg.points[::-1].copy(), leg.u[::-1].copy()
    return replace(leg, points=points, u=u, legs=leg.legs[::-1], lips=lips)


def _near_ends(legs: Sequence[Leg], open_: Sequence[int]) -> list[tuple[int, int, int, int]]:
    """Ends of different legs near enough to be one corner: (leg, end, leg, end)."""
    if not open_:
        return []
    ends = np.array([legs[i].points[-e] for i in open_ for e in (0, 1)])
    gap = np.repeat(np.abs([legs[i].gap for i in open_]), 2)
    apart = np.linalg.norm(ends[:, None] - ends[None], axis=2)
    near = np.triu(apart <= 1.5 * np.maximum(gap[:, None], gap) + 0.01, 1)
    pairs = [(int(p), int(q)) for p, q in np.argwhere(near)]
    return [(open_[p // 2], p % 2, open_[q // 2], q % 2) for p, q in pairs if p // 2 != q // 2]


def _end_distance(a: Leg, e: int, b: Leg, f: int) -> float | None:
    """Distance between end e of a and end f of b, where one could go on as the other."""
    pa, pb = a.points[-e], b.points[-f]
    distance = float(np.linalg.norm(pa - pb))
    if distance > 1.5 * max(abs(a.gap), abs(b.gap)) + 0.01:
        return None
    out = a.points[-1] - a.points[-2] if e else a.points[0] - a.points[1]
    into = b.points[-2] - b.points[-1] if f else b.points[1] - b.points[0]
    out, into = out / np.linalg.norm(out), into / np.linalg.norm(into)
    ua, ub = a.u[-1 if e else 0], b.u[-1 if f else 0]
    if out @ into < -0.7 or np.cross(out, ua) @ np.cross(into, ub) < 0.7:
        return None
    return distance


def _chained(chain: Sequence[Leg], *, closed: bool) -> Leg:
    if len(chain) == 1:
        return chain[0]
    points, axes = [chain[0].points], [chain[0].u]
    for leg in chain[1:]:
        corner = _corner(points[-1][-2:], leg.points[:2])
        points[-1] = np.vstack([points[-1][:-1], corner])
        points.append(np.vstack([corner, leg.points[1:]]))
        axes.append(leg.u)
    if closed:
        corner = _corner(points[-1][-2:], points[0][:2])
        points[-1] = np.vstack([points[-1][:-1], corner])
        points[0] = np.vstack([corner, points[0][1:]])
    line = np.vstack([points[0], *(p[1:] for p in points[1:])])
    length = sum(leg.length for leg in chain)
    return Leg(
        points=line,
        u=np.vstack(axes),
        length=length,
        depth=sum(leg.depth * leg.length for leg in chain) / length,
        gap=sum(leg.gap * leg.length for leg in chain) / length,
        low=min(leg.low for leg in chain),
        high=max(leg.high for leg in chain),
        area=sum(leg.area for leg in chain),
        legs=tuple(x for leg in chain for x in leg.legs),
        closed=closed,
        groove=chain[0].groove,
        lips=chain[0].lips,
    )


def _corner(a: Array, b: Array) -> Array:
    """Where leg a's end (2, 3) meets leg b's start (2, 3): where their lines pass nearest, or midway."""
    middle = 0.5 * (a[1] + b[0])
    da, db = a[1] - a[0], b[1] - b[0]
    da, db = da / np.linalg.norm(da), db / np.linalg.norm(db)
    cosine = float(da @ db)
    if 1.0 - cosine * cosine < 0.01:
        return np.asarray(middle)
    r = b[0] - a[1]
    s = (r @ da - cosine * (r @ db)) / (1.0 - cosine * cosine)
    t = (cosine * (r @ da) - r @ db) / (1.0 - cosine * cosine)
    meeting = 0.5 * (a[1] + s * da + b[0] + t * db)
    near = np.linalg.norm(meeting - middle) <= 2.0 * np.linalg.norm(r) + 1e-3
    return np.asarray(meeting if near else middle)
