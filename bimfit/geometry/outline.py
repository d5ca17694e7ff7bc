"""The two sides of a designed gap, traced along the components' outlines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bimfit.geometry.joint_section import GapOutline
from bimfit.geometry.pose import Array
from bimfit.geometry.profile import Profile, signed_area

FACING = float(np.sin(np.radians(12.0)))
"""An edge faces the other component where its outward normal's u-component exceeds this."""
_PARALLEL = float(np.cos(np.radians(5.0)))
_CLASH = 0.020  # components that overlap by no more than this still have a gap outline, m
_LEDGE = 0.030  # ledges up to this long, or 1.5 times the facing depth, belong to a stepped joint, m
_BED = 0.060  # longer ones too, where the other component lies within this over their middle, m
_STEP_GAP = 0.200  # behind a ledge, the other component must be within this, m
_SAME = 2e-6


def trace_gap(profile_a: Profile, profile_b: Profile) -> GapOutline | None:
    """Find the boundary chains of A and B that face one another across the gap.

    The profiles are given in a rough section frame: the origin somewhere in or near the gap, u roughly from
    A to B, v roughly out of the mouth. Where several gaps lie between the two, the one nearest the origin
    counts.

    Convention. A chain starts at the faces that look at one another across the origin and follows its
    component's boundary towards the mouth for as long as the boundary *faces* the other component: until the
    outward normal's u-component falls under sin 12 degrees. So bevels, chamfers and fillets belong to the
    gap and the top face does not; the mouth corner is where the chain ends. The same holds for the root,
    with these additions:

    - *Plates*: the boundary that bounds a chain at one end has an opposite face, which bounds it at the other
      end even if it faces the other component (the inside faces of a mitred corner).
    - *Steps*: a ledge that does not face the other component is followed where the boundary behind it faces
      it again, with free sight on it (rebates, tongue and groove); a long one only as the bed of a halving,
      with the other component over it.
    - *Overhangs*: where one chain goes on, in v, beyond the other's end by more than the gap is wide there
      (T, lap, corner, boards of unequal thickness), it is cut off at its point nearest to the other's end.

    Returns
    -------
    GapOutline or None
        In the frame of the profiles; None where nothing of A faces B.
    """
    b_mirrored = _mirrored(profile_b)
    edges_a, edges_b = _Boundary.of(profile_a), _Boundary.of(b_mirrored)
    if not (len(edges_a.start) and len(edges_b.start)):
        return None
    found = _facing_pair(edges_a, edges_b)
    if found is None:
        return None
    chain_a = _chain(edges_a, found[0], edges_b)
    chain_b = _chain(edges_b, found[1], edges_a) * (-1.0, 1.0)
    chain_a, chain_b = _cut_overhang(chain_a, chain_b, 1.0)
    chain_a, chain_b = _cut_overhang(chain_a[::-1], chain_b[::-1], -1.0)
    chain_a, chain_b = chain_a[::-1], chain_b[::-1]
    if min(_length(chain_a), _length(chain_b)) < _SAME:
        return None
    return GapOutline(np.ascontiguousarray(chain_a), np.ascontiguousarray(chain_b))


@dataclass(frozen=True)
class _Boundary:
    """The outer loops of a component that lies on the -u side of the gap."""

    start: Array
    end: Array
    normal: Array
    following: list[int]
    previous: list[int]

    @classmethod
    def of(cls, profile: Profile) -> _Boundary:
        loops = [loop for loop in profile.loops if signed_area(loop) > 0.0]
        if not loops:
            none = np.zeros((0, 2))
            return cls(none, none, none, [], [])
        outer = Profile(tuple(loops))
        following: list[int] = []
        previous: list[int] = []
        for loop in loops:
            ids = len(following) + np.arange(len(loop))
            following += np.roll(ids, -1).tolist()
            previous += np.roll(ids, 1).tolist()
        edges = outer.edges
        return cls(edges[:, 0], edges[:, 1], outer.normals, following, previous)

    def crossings(self, level: float) -> list[tuple[float, int]]:
        """Where the line v = ``level`` crosses the boundary, as (u, edge)."""
        v0, v1 = self.start[:, 1], self.end[:, 1]
        cross = np.flatnonzero((v0 > level) != (v1 > level))
        share = (level - v0[cross]) / (v1[cross] - v0[cross])
        u = self.start[cross, 0] + share * (self.end[cross, 0] - self.start[cross, 0])
        return list(zip(u.tolist(), cross.tolist(), strict=True))

    def size(self, edge: int) -> float:
        return float(np.linalg.norm(self.end[edge] - self.start[edge]))

    def faces(self, edge: int) -> bool:
        return bool(self.normal[edge, 0] > FACING)


def _mirrored(profile: Profile) -> Profile:
    """Swap the sides: u -> -u, with material still to the left."""
    return Profile(tuple(loop[::-1] * (-1.0, 1.0) for loop in profile.loops))


def _facing_pair(a: _Boundary, b: _Boundary) -> tuple[int, int] | None:
    """Edges of A and of mirrored B that look at one another, as near the origin as can be."""
    levels = np.unique(np.concatenate([a.start[:, 1], b.start[:, 1]]))
    low = max(a.start[:, 1].min(), b.start[:, 1].min())
    high = min(a.start[:, 1].max(), b.start[:, 1].max())
    levels = levels[(levels >= low) & (levels <= high)]
    best: tuple[float, float, int, int] | None = None
    cells = np.stack([levels[:-1], levels[1:]], axis=1) if len(levels) > 1 else np.zeros((0, 2))
    cells = cells[cells[:, 1] - cells[:, 0] > _SAME]
    away = np.maximum(np.maximum(cells[:, 0], -cells[:, 1]), 0.0)
    for k in np.argsort(away, kind="stable"):
        if best is not None and away[k] > best[0]:
            break
        # Half way between neighbouring vertices no crossing grazes a corner.
        for left, right, i, j in _across(a, b, float(cells[k].mean())):
            aside = max(min(left, right), -max(left, right), 0.0)
            candidate = float(np.hypot(aside, away[k])), max(left - right, 0.0), i, j
            if best is None or candidate < best:
                best = candidate
    return None if best is None else (best[2], best[3])


def _across(a: _Boundary, b: _Boundary, level: float) -> list[tuple[float, float, int, int]]:
    """Neighbouring faces of A and B along the line v = level: (u of A, u of B, edge of A, edge of B)."""
    ends = [(u, i) for u, i in a.crossings(level) if a.normal[i, 0] > 0.0]
    starts = [(-u, j) for u, j in b.crossings(level) if b.normal[j, 0] > 0.0]
    walls = sorted([u for u, _ in a.crossings(level)] + [-u for u, _ in b.crossings(level)])
    out = []
    for left, i in ends:
        for right, j in starts:
            if right < left - _CLASH or not (a.faces(i) and b.faces(j)):
                continue
            between = sum(left + _SAME < u < right - _SAME for u in walls)
            if not between:
                out.append((left, right, i, j))
    return out


def _chain(own: _Boundary, first: int, other: _Boundary) -> Array:
    """The chain of a component through its edge ``first``, mouth corner to root corner, shape (k, 2)."""
    ahead = _facing_run(own, first, own.following)
    behind = _facing_run(own, first, own.previous)
    depth = sum(own.size(edge) for edge in {first, *ahead, *behind})
    ahead = _follow(own, first, own.following, other, depth)
    behind = _follow(own, first, own.previous, other, depth)
    after = own.following[ahead[-1] if ahead else first]
    before = own.previous[behind[-1] if behind else first]
    ahead, behind = _up_to_opposite(own, ahead, before), _up_to_opposite(own, behind, after)
    up = [*behind[::-1], first, *ahead]
    points = np.concatenate([own.start[up], own.end[up[-1:]]])
    return points[::-1]


def _facing_run(own: _Boundary, first: int, step: list[int]) -> list[int]:
    out: list[int] = []
    edge = step[first]
    while edge != first and own.faces(edge):
        out.append(edge)
        edge = step[edge]
    return out


def _follow(own: _Boundary, first: int, step: list[int], other: _Boundary, depth: float) -> list[int]:
    """Edges beyond ``first`` in one direction that belong to the gap, ledges included."""
    out = _facing_run(own, first, step)
    while True:
        ledge: list[int] = []
        edge = step[out[-1] if out else first]
        while edge != first and not own.faces(edge):
            ledge.append(edge)
            edge = step[edge]
        if edge == first or not _sees(own, edge, other):
            return out
        long = sum(own.size(e) for e in ledge) > max(_LEDGE, 1.5 * depth)
        if long and not _is_bed(own, ledge, other, forward=step is own.following):
            return out
        more = [edge, *_facing_run(own, edge, step)]
        if first in more:
            return out
        out += [*ledge, *more]


def _is_bed(own: _Boundary, ledge: list[int], other: _Boundary, *, forward: bool) -> bool:
    """Whether the other component lies over the middle of a ledge, and near."""
    stops = np.cumsum([own.size(edge) for edge in ledge])
    k = int(np.searchsorted(stops, 0.5 * stops[-1]))
    edge, left = ledge[k], float(stops[k] - 0.5 * stops[-1])
    near, far = (own.end, own.start) if forward else (own.start, own.end)
    foot = near[edge] + left / own.size(edge) * (far[edge] - near[edge])
    normal, flip = own.normal[edge], np.array([-1.0, 1.0])
    start, end = other.start * flip - foot, other.end * flip - foot
    along = np.array([-normal[1], normal[0]])
    a, b = start @ along, end @ along
    cross = np.flatnonzero((a > 0.0) != (b > 0.0))
    share = a[cross] / (a[cross] - b[cross])
    away = (start[cross] + share[:, None] * (end[cross] - start[cross])) @ normal
    return bool(((away > -_CLASH) & (away < _BED)).any())


def _sees(own: _Boundary, edge: int, other: _Boundary) -> bool:
    """Whether a line along u from the middle of an edge meets the other component first, and soon."""
    u, v = 0.5 * (own.start[edge] + own.end[edge])
    hits = [-x - u for x, _ in other.crossings(float(v)) if -x > u - _CLASH]
    own_hits = [x - u for x, k in own.crossings(float(v)) if x > u + _SAME and k != edge]
    nearest = min(hits, default=np.inf)
    return bool(nearest < _STEP_GAP and nearest < min(own_hits, default=np.inf))


def _up_to_opposite(own: _Boundary, edges: list[int], bound: int) -> list[int]:
    """Stop at the face that is the opposite of the one that bounds the chain's other end."""
    for k, edge in enumerate(edges):
        if own.faces(edge) and own.normal[edge] @ own.normal[bound] < -_PARALLEL:
            return edges[:k]
    return edges


def _cut_overhang(chain_a: Array, chain_b: Array, outward: float) -> tuple[Array, Array]:
    """Shorten, at the first rows, the chain that goes on beyond the other's end; ``outward`` is v's sign."""
    for _ in range(2):
        beyond = outward * float(chain_a[0, 1] - chain_b[0, 1])
        longer, shorter = (chain_a, chain_b) if beyond > 0.0 else (chain_b, chain_a)
        place, edge = _nearest(longer, shorter[0])
        width = float(np.linalg.norm(place - shorter[0]))
        if abs(beyond) <= max(width, 1e-3):
            break
        rest = longer[edge + 1 :]
        longer = np.vstack([place, rest if np.linalg.norm(rest[0] - place) > _SAME else rest[1:]])
        chain_a, chain_b = (longer, chain_b) if beyond > 0.0 else (chain_a, longer)
        if len(longer) < 2:
            break
    return chain_a, chain_b


def _nearest(chain: Array, point: Array) -> tuple[Array, int]:
    """The chain's point nearest to a point, and the edge that it lies on."""
    start, along = chain[:-1], chain[1:] - chain[:-1]
    size = np.maximum(np.einsum("ij,ij->i", along, along), 1e-300)
    share = np.clip(np.einsum("ij,ij->i", point - start, along) / size, 0.0, 1.0)
    feet = start + share[:, None] * along
    edge = int(np.argmin(np.linalg.norm(feet - point, axis=1)))
    return feet[edge], edge


def _length(chain: Array) -> float:
    return float(np.linalg.norm(np.diff(chain, axis=0), axis=1).sum())
