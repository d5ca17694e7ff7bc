"""Runs the finder's stages on a set of elements, up to legs with a kind and a mouth."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bimfit.bim.bands import middle_line, straight_arms
from bimfit.bim.broad import face_pairs
from bimfit.bim.clearance import covered_sides, judge
from bimfit.bim.faces import Faces, Index, cross, dot, find_faces, overlapping, ranges
from bimfit.bim.kind import Stations, classify, free_sides
from bimfit.bim.legs import Leg
from bimfit.bim.merge import merge
from bimfit.bim.narrow import PairFrames, facing_pieces, pair_frames
from bimfit.bim.strips import Strips, find_strips
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.path import JointPath
from bimfit.geometry.pose import Array

_PARALLEL = math.radians(10.0)
_GROOVE = math.radians(100.0)
_GROOVE_FACE = 0.1
_GROOVE_ROOT = 0.02
_BLUNT = (math.cos(math.radians(80.0)), math.cos(math.radians(5.0)))
_MANY_FACES = 64
_SHARP = math.cos(math.radians(80.0))
_FULL = 0.9
_BAND_DEPTH = 0.5
_ROUNDING = 1e-9
_DRAWN = 1e-5  # files are drawn to about this, m
_MID = 0.4871  # off the middle, where meshes tend to have vertices
_SHARES = np.array([1.0 / 6.0, _MID, 5.0 / 6.0])


@dataclass(frozen=True)
class Limits:
    """What counts as two faces that meet: metres, m^2 and radians."""

    max_gap: float = 0.06
    max_overlap: float = 0.03
    max_angle: float = _PARALLEL
    min_area: float = 1e-4
    min_diagonal: float = 0.02
    min_length: float = 0.1
    min_depth: float = 0.0025
    grooves: bool = True


@dataclass(frozen=True)
class Draft:
    """A joint between two elements, by number, in world coordinates."""

    a: int
    b: int
    state: str
    filler: int
    kind: str
    leg: Leg
    path: JointPath
    free: tuple[bool, bool]


def find_drafts(meshes: Sequence[TriangleMesh], eligible: NDArray[np.bool_], limits: Limits) -> list[Draft]:
    """Find where eligible elements meet; the others only stand in the way."""
    if len(meshes) < 2:
        return []
    faces = find_faces(meshes, min_area=limits.min_area, min_diagonal=limits.min_diagonal)
    a, b = face_pairs(
        faces,
        max_gap=limits.max_gap,
        max_overlap=limits.max_overlap,
        min_cosine=math.cos(limits.max_angle),
        max_cosine=1.1,
        chosen=eligible[faces.element],
    )
    frames = pair_frames(faces, a, b)
    found = _strips(faces, frames, limits, -limits.max_overlap)
    groups = _legs(faces, frames, found, limits)
    if limits.grooves:
        _add_grooves(faces, eligible, limits, groups)
    rows = [(key, leg) for key in sorted(groups) for leg in merge(groups[key])]
    rows = [
        (key, leg)
        for key, leg in rows
        if leg.length >= limits.min_length - _ROUNDING and leg.depth >= limits.min_depth - _ROUNDING
    ]
    drafts = _finish(faces, rows) if rows else []
    _lead_out(faces, rows, drafts)
    return [draft for draft in drafts if not draft.leg.groove or draft.kind in ("v-groove", "bevel")]


Key = tuple[int, int, str, int]


def _strips(faces: Faces, frames: PairFrames, limits: Limits, least_gap: float) -> Strips:
    pieces = facing_pieces(faces, frames, least_gap=least_gap, max_gap=limits.max_gap + _DRAWN)
    strips = find_strips(frames, pieces)
    thin = (strips.depth < min(limits.min_depth, 0.002)) | (strips.length < limits.min_diagonal)
    return strips.take(np.flatnonzero(~thin & (strips.area >= 0.5 * limits.min_area)))


def _legs(faces: Faces, frames: PairFrames, strips: Strips, limits: Limits) -> dict[Key, list[Leg]]:
    verdict = judge(faces, frames, strips)
    kept = np.flatnonzero(verdict.state != "own")
    strips, state, filler = strips.take(kept), verdict.state[kept], verdict.filler[kept]
    half = 0.5 * strips.length[:, None] * strips.axis
    ends = np.stack(
        [_mid_gap(frames, strips.pair, strips.centre + sign * half) for sign in (-1.0, 1.0)], axis=1
    )
    m = frames.m[strips.pair]
    first, second = (faces.element[side[strips.pair]].tolist() for side in (frames.a, frames.b))
    plain = (strips.depth, strips.length, strips.gap, strips.gap_min, strips.gap_max, strips.area)
    depths, lengths, gaps, lows, highs, areas = (values.tolist() for values in plain)
    full = strips.area >= _FULL * strips.length * strips.depth
    groups: dict[Key, list[Leg]] = defaultdict(list)
    for k, key in enumerate(zip(first, second, state.tolist(), filler.tolist(), strict=True)):
        gap = gaps[k], lows[k], highs[k]
        lines = [] if full[k] else _lines(strips, k)
        if not lines:
            leg = Leg(ends[k], m[k : k + 1], lengths[k], depths[k], *gap, areas[k], (lengths[k],))
            groups[key].append(leg)
        for line, depth, closed in lines:
            points = _mid_gap(frames, np.full(len(line), strips.pair[k]), line)
            u = np.repeat(m[k : k + 1], len(line) - 1, axis=0)
            length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
            groups[key].append(Leg(points, u, length, depth, *gap, depth * length, (length,), closed))
    return groups


def _mid_gap(frames: PairFrames, pair: Index, points: Array) -> Array:
    low, high = frames.heights(pair, points[:, None, :])
    return frames.lift(pair, points, 0.5 * (low + high)[:, 0])


def _lines(strips: Strips, k: int) -> list[tuple[Array, float, bool]]:
    """Middle lines of a strip that is no rectangle, with depths and whether they are closed; else nothing."""
    rows = slice(int(strips.splits[k]), int(strips.splits[k + 1]))
    pieces = zip(strips.pieces.corners[rows], strips.pieces.count[rows], strict=True)
    polygons = [corners[:count] for corners, count in pieces]
    band = middle_line(polygons, max_depth=_BAND_DEPTH)
    if band is None:
        return [(arm.line, arm.depth, False) for arm in straight_arms(polygons)]
    line, closed = band
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    return [(line, float(strips.area[k]) / length, closed)]


def _add_grooves(
    faces: Faces, eligible: NDArray[np.bool_], limits: Limits, groups: dict[Key, list[Leg]]
) -> None:
    """Grooves without a root land: slim faces at a wide angle, of elements of which nothing else meets.

    Where they are nearly square to one another, as the faces of blocks are round a corner, one of them has to
    be a prepared edge: its element has another face that it leads on to bluntly.
    """
    diagonal = np.linalg.norm(faces.high - faces.low, axis=1)
    slim = (faces.area < _GROOVE_FACE * diagonal) & (faces.area < diagonal**2 / 3.0)
    a, b = face_pairs(
        faces,
        max_gap=limits.max_gap,
        max_overlap=0.0,
        min_cosine=math.cos(max(_GROOVE, limits.max_angle)),
        max_cosine=math.cos(limits.max_angle),
        chosen=slim & eligible[faces.element],
    )
    count = len(faces.starts)
    taken = np.unique([key[0] * count + key[1] for key in groups]) if groups else np.zeros(0, np.int64)
    prepared = _blunt_edged(faces, slim)
    sharp = -dot(faces.normal[a], faces.normal[b]) > _SHARP
    fresh = (sharp | prepared[a] | prepared[b]) & ~np.isin(faces.element[a] * count + faces.element[b], taken)
    # they come as near as the root is wide
    fresh &= overlapping(
        faces.low[a] - _GROOVE_ROOT, faces.high[a] + _GROOVE_ROOT, faces.low[b], faces.high[b]
    )
    if not fresh.any():
        return
    frames = pair_frames(faces, a[fresh], b[fresh])
    strips = _strips(faces, frames, limits, -1e-3)
    strips = strips.take(
        np.flatnonzero((strips.gap_min <= _GROOVE_ROOT) & (strips.depth >= limits.min_depth))
    )
    for key, legs in _legs(faces, frames, strips, limits).items():
        groups[key].extend(replace(leg, groove=True) for leg in legs)


def _blunt_edged(faces: Faces, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the chosen faces may meet another of its element's at a blunt angle, shape (faces,)."""
    out = chosen.copy()
    count = np.bincount(faces.element, minlength=len(faces.starts) - 1)
    order, first = np.argsort(faces.element, kind="stable"), np.cumsum(count) - count
    some = np.flatnonzero(chosen & (count[faces.element] <= _MANY_FACES))
    sizes = count[faces.element[some]]
    row, other = np.repeat(some, sizes), order[ranges(first[faces.element[some]], sizes)]
    cosine = dot(faces.normal[row], faces.normal[other])
    out[some] = False
    out[row[(cosine > _BLUNT[0]) & (cosine < _BLUNT[1])]] = True
    return out


def _finish(faces: Faces, rows: Sequence[tuple[Key, Leg]]) -> list[Draft]:
    """Kinds, mouths and paths."""
    legs = [leg for _, leg in rows]
    picks = [_longest(leg) for leg in legs]
    start = np.array([leg.points[i] for leg, i in zip(legs, picks, strict=True)])
    end = np.array([leg.points[i + 1] for leg, i in zip(legs, picks, strict=True)])
    n, u, v = _axes(end - start, np.array([leg.u[i] for leg, i in zip(legs, picks, strict=True)]))
    depth = np.array([leg.depth for leg in legs])
    stations = Stations(
        origin=start + _MID * (end - start) + _lead(legs, u, v),
        u=u,
        v=v,
        n=n,
        depth=depth,
        gap=np.array([leg.gap for leg in legs]),
        a=np.array([key[0] for key, _ in rows]),
        b=np.array([key[1] for key, _ in rows]),
    )
    shape = classify(
        faces, stations, np.array([leg.length for leg in legs]), np.array([leg.area for leg in legs])
    )
    spots = _spots(legs, start, end, u, v)
    filler = np.array([key[3] for key, _ in rows])
    way = (*spots, depth + 2.0 * shape.prepared, stations.gap, filler)
    free = free_sides(faces, *way)
    _free_past_lips(faces, legs, spots, stations.gap, filler, free)
    free &= ~covered_sides(faces, *way)
    flip = _default_mouth(free, shape.opening, v, stations.origin)
    out = []
    for k, (key, leg) in enumerate(rows):
        axes = (u[k : k + 1], v[k : k + 1]) if leg.straight else _axes(np.diff(leg.points, axis=0), leg.u)[1:]
        path = _path(leg, faces.origin, *axes, flip=bool(flip[k]))
        sides = (bool(free[k, 0]), bool(free[k, 1]))
        deeper = float(shape.prepared[k])
        whole = replace(leg, depth=leg.depth + deeper) if deeper else leg
        sides = sides[::-1] if flip[k] else sides
        out.append(Draft(key[0], key[1], key[2], key[3], str(shape.kind[k]), whole, path, sides))
    return out


def _lead_out(faces: Faces, rows: Sequence[tuple[Key, Leg]], drafts: list[Draft]) -> None:
    """Where a stepped section's leading faces lead nowhere, let those square to them lead, in ``drafts``.

    A halving's bed may be larger than its cheeks, and between the cheeks is where it opens.
    """
    shut = [(k, rows[k][0], rows[k][1].square) for k, draft in enumerate(drafts) if not any(draft.free)]
    turned = [(k, key, leg) for k, key, leg in shut if leg is not None]
    if turned:
        for (k, *_), draft in zip(turned, _finish(faces, [row[1:] for row in turned]), strict=True):
            if any(draft.free):
                drafts[k] = draft


def _lead(legs: Sequence[Leg], u: Array, v: Array) -> Array:
    """From the spine to the middle of the leading faces, shape (k, 3): not zero for stepped sections only."""
    place = np.array(
        [(0.0, 0.0) if leg.lips is None else (leg.lips[1].across, leg.lips[1].out) for leg in legs]
    )
    return np.asarray(place[:, :1] * u + place[:, 1:] * v)


def _free_past_lips(
    faces: Faces,
    legs: Sequence[Leg],
    spots: tuple[Array, Array, Array],
    gap: Array,
    filler: Index,
    free: NDArray[np.bool_],
) -> None:
    """Look again out of stepped gaps, into ``free``: each way from the outermost faces, straight on."""
    stepped = np.array([k for k, leg in enumerate(legs) if leg.lips is not None], np.int64)
    if not len(stepped):
        return
    origin, u, v = (values[stepped] for values in spots)
    for side, which in ((0, 2), (1, 0)):
        lips = [leg.lips[which] for leg in legs if leg.lips is not None]
        across, out = (
            np.array(x)[:, None, None] for x in zip(*((lip.across, lip.out) for lip in lips), strict=True)
        )
        depth = np.array([lip.depth for lip in lips])
        at_lip = origin + across * u + out * v
        free[stepped, side] = free_sides(faces, at_lip, u, v, depth, gap[stepped], filler[stepped])[:, side]


def _longest(leg: Leg) -> int:
    if leg.straight:
        return 0
    return int(np.argmax(np.linalg.norm(np.diff(leg.points, axis=0), axis=1)))


def _axes(way: Array, across: Array) -> tuple[Array, Array, Array]:
    """Unit n, u and v = n x u from directions (k, 3) along and across."""
    n = way / np.sqrt(dot(way, way))[:, None]
    u = across - dot(across, n)[:, None] * n
    u = u / np.sqrt(dot(u, u))[:, None]
    return n, u, cross(n, u)


def _spots(legs: Sequence[Leg], start: Array, end: Array, u: Array, v: Array) -> tuple[Array, Array, Array]:
    """Three points of each spine and the u and v directions there, shape (k, 3, 3) each."""
    points = start[:, None] + _SHARES[None, :, None] * (end - start)[:, None]
    across, out = np.repeat(u[:, None], 3, axis=1), np.repeat(v[:, None], 3, axis=1)
    for k, leg in enumerate(legs):
        if leg.straight:
            continue
        way = np.diff(leg.points, axis=0)
        _, leg_u, leg_v = _axes(way, leg.u)
        stops = np.concatenate([[0.0], np.cumsum(np.linalg.norm(way, axis=1))])
        s = _SHARES * stops[-1]
        i = np.clip(np.searchsorted(stops, s, side="right") - 1, 0, len(way) - 1)
        t = (s - stops[i]) / (stops[i + 1] - stops[i])
        points[k], across[k], out[k] = leg.points[i] + t[:, None] * way[i], leg_u[i], leg_v[i]
    return points, across, out


def _path(leg: Leg, origin: Array, u: Array, v: Array, *, flip: bool) -> JointPath:
    points = leg.points + origin
    if flip:
        return JointPath(points[::-1], u[::-1], -v[::-1], leg.closed)
    return JointPath(points, u, v, leg.closed)


def _default_mouth(free: NDArray[np.bool_], opening: Array, v: Array, origin: Array) -> NDArray[np.bool_]:
    """Whether the mouth is on the -v side: the free side, else the wide one, else up, else outwards."""
    outward = np.einsum("ij,ij->i", v, origin)
    main = v[np.arange(len(v)), np.argmax(np.abs(v), axis=1)]
    outward = np.where(np.abs(outward) > 1e-6, outward, main)
    side = np.where(np.abs(v[:, 2]) > 0.5, v[:, 2], outward)
    side = np.where(opening != 0.0, opening, side)
    only = free[:, 0] != free[:, 1]
    side = np.where(only, np.where(free[:, 0], 1.0, -1.0), side)
    return np.asarray(side < 0.0)
