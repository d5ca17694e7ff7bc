"""Sixth stage of the joint finder: kind of joint, from a section at mid-station, and its mouths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bimfit.bim.clearance import nearby_triangles, ray_distance
from bimfit.bim.faces import Faces, Index
from bimfit.geometry.pose import Array

_REACH = 0.05
_SIDE = 0.06
_ON_LINE = 5e-4
_AT_CORNER = 5e-4
_OVERHANG = 3e-3
_STEP_SLACK = 5e-3
_JUTTING = 0.5
_SLANT = np.radians(15.0)
_TAPER = np.radians(1.5)
_STEEP = np.radians(10.5)
_PREPARED_SHARE = 0.3
_SHEET_DEPTH = 0.5
_SHEET_AREA = 0.5
_PATCH = 0.2
_BESIDE = 1e-3

Sides = NDArray[np.bool_]


@dataclass(frozen=True)
class Stations:
    """One section a joint: where, and of which elements.

    Attributes
    ----------
    origin, u, v, n : ndarray, shape (k, 3)
        Midway in gap and depth, and the axes.
    depth, gap : ndarray, shape (k,)
        m.
    a, b : ndarray, shape (k,)
        Elements.
    """

    origin: Array
    u: Array
    v: Array
    n: Array
    depth: Array
    gap: Array
    a: Index
    b: Index


@dataclass(frozen=True)
class Shape:
    """What the sections show.

    Attributes
    ----------
    kind : ndarray of str, shape (k,)
    opening : ndarray, shape (k,)
        Positive where the gap opens towards +v, negative towards -v, 0 where it does neither.
    prepared : ndarray, shape (k,)
        How much deeper the joint is than its facing faces, by the prepared edges beyond them, m.
    """

    kind: NDArray[np.str_]
    opening: Array
    prepared: Array


def classify(faces: Faces, stations: Stations, length: Array, area: Array) -> Shape:
    """Name each joint's kind from what overhangs at either end of its depth and how its edges turn."""
    k = len(stations.gap)
    row, side, ends = _section(faces, stations)
    slope, level = _face_lines(stations, row, side, ends)
    top = np.full((k, 2, 2), np.nan)  # station, side, end: v of the face's ends
    on_line = _collinear(row, side, ends, slope, level)
    for e, reduce in ((0, np.fmin), (1, np.fmax)):
        flat = top[:, :, e].copy()
        reduce.at(
            flat,
            (row[on_line], side[on_line]),
            (ends[on_line, :, 1].min(axis=1), ends[on_line, :, 1].max(axis=1))[e],
        )
        top[:, :, e] = flat
    common_low, common_high = np.fmax(top[:, 0, 0], top[:, 1, 0]), np.fmin(top[:, 0, 1], top[:, 1, 1])
    angle, turned, inner = _corners(row, side, ends, slope, level, top)
    taper = np.arctan(slope[:, 1]) - np.arctan(slope[:, 0])
    turned = np.where(_prepared(angle, taper), turned, 0.0)
    over = _overhangs(top, angle, turned, stations.gap)
    depth = np.where(np.isfinite(common_high - common_low), common_high - common_low, stations.depth)
    kind = _name(over, angle, turned, taper, np.maximum(depth, 1e-6))
    kind[_stepped(top, inner, stations.gap)] = "rebate"
    kind[(stations.depth >= _SHEET_DEPTH) & (area >= _SHEET_AREA)] = "sheet"
    kind[(length < 1.2 * stations.depth) & (length < _PATCH)] = "patch"
    prepared = turned.sum(axis=1)
    opening = np.where(
        np.abs(taper) > _TAPER, np.sign(taper), np.sign(np.round(prepared[:, 1] - prepared[:, 0], 4))
    )
    deeper = np.where((kind == "v-groove") | (kind == "bevel"), turned.max(axis=1).sum(axis=1), 0.0)
    return Shape(kind, np.nan_to_num(opening), deeper)


def _prepared(angle: Array, taper: Array) -> NDArray[np.bool_]:
    """Whether the edge beyond a face's end is a prepared one, and not the element's own side: (k, side, end).

    Where an element is cut at a slant, one of its corners is sharp and the blunt one leads to its side.
    """
    blunt, sharp = angle > np.pi / 2.0 + _SLANT, angle < np.pi / 2.0 - _SLANT
    plain = blunt & ~sharp[:, ::-1] & ~sharp[:, :, ::-1]
    return np.asarray(plain & (np.abs(taper) <= _STEEP)[:, None, None])


def _stepped(top: Array, inner: NDArray[np.bool_], gap: Array) -> NDArray[np.bool_]:
    """Whether the section goes on round a step, shape (k,).

    One face ends in an inner corner, where its element juts out across the gap, the other ends near by.
    """
    near = np.abs(top[:, 0] - top[:, 1]) <= 1.5 * np.abs(gap)[:, None] + _STEP_SLACK
    return np.asarray((inner.any(axis=1) & near).any(axis=1))


def _overhangs(top: Array, angle: Array, turned: Array, gap: Array) -> NDArray[np.bool_]:
    """Which side's face goes on beyond the other's, at either end of the depth: shape (k, side, end).

    A prepared edge counts with the face that it leads on from. Slanting ends of faces that lie apart are
    shifted against each other, without one of them going on.
    """
    reach = np.array([-1.0, 1.0]) * top + turned
    slant = np.abs(1.0 / np.tan(np.clip(angle, np.radians(25.0), np.radians(155.0)))).max(axis=(1, 2))
    margin = _OVERHANG + np.abs(gap) * np.where(slant > np.tan(_SLANT), slant, 0.0)
    return np.asarray(reach - reach[:, ::-1] > margin[:, None, None])


def _name(
    over: NDArray[np.bool_], angle: Array, turned: Array, taper: Array, depth: Array
) -> NDArray[np.str_]:
    """Kinds from overhangs (k, side, end), interior angles (k, side, end) and the opening angle."""
    k = len(taper)
    kind = np.full(k, "square-butt", "<U12")
    blunt, sharp = angle > np.pi / 2.0 + _SLANT, angle < np.pi / 2.0 - _SLANT
    kind[np.abs(taper) > _TAPER] = "tapered"
    both = turned.min(axis=1).max(axis=1)
    either = turned.max(axis=(1, 2))
    kind[either > 0.0] = "bevel"
    kind[both > _PREPARED_SHARE * (depth + both)] = "v-groove"
    steep = np.abs(taper) > _STEEP
    wide = (taper > 0.0).astype(int)
    at_mouth = angle[np.arange(k), :, wide]
    kind[steep] = "bevel"
    kind[steep & np.all(np.abs(at_mouth - np.pi / 2.0) > np.radians(5.0), axis=1)] = "v-groove"
    for e in (0, 1):
        slanted = (sharp[:, 0, e] & blunt[:, 1, e]) | (blunt[:, 0, e] & sharp[:, 1, e])
        kind[slanted & ~steep] = "scarf"
    for e in (0, 1):
        slanted = np.all(sharp[:, :, e], axis=1) & np.all(blunt[:, :, 1 - e], axis=1)
        kind[slanted & ~steep] = "mitre"
    a, b = over[:, 0], over[:, 1]
    count = a.sum(axis=1) + b.sum(axis=1)
    kind[count == 1] = "corner"
    kind[a.all(axis=1) | b.all(axis=1)] = "t-joint"
    kind[(a[:, 0] & b[:, 1]) | (a[:, 1] & b[:, 0])] = "lap"
    return kind


def _section(faces: Faces, stations: Stations) -> tuple[Index, Index, Array]:
    """Cut A and B near the joint: (station, side, segments (r, 2, 2) in (u, v))."""
    centre = stations.origin
    reach = (
        np.abs(stations.v) * (0.5 * stations.depth + _SIDE)[:, None]
        + np.abs(stations.u) * (0.5 * np.abs(stations.gap) + _SIDE)[:, None]
        + 1e-4
    )
    row, triangle = nearby_triangles(faces, centre - reach, centre + reach)
    owner = faces.owner[triangle]
    mine = (owner == stations.a[row]) | (owner == stations.b[row])
    row, triangle = row[mine], triangle[mine]
    offset = faces.triangles[triangle] - centre[row][:, None]
    height = np.einsum("nij,nj->ni", offset, stations.n[row])
    flat = np.stack(
        [np.einsum("nij,nj->ni", offset, stations.u[row]), np.einsum("nij,nj->ni", offset, stations.v[row])],
        axis=2,
    )
    above = height > 0.0
    cut = np.flatnonzero(above.any(axis=1) & ~above.all(axis=1))
    row, triangle, height, flat, above = row[cut], triangle[cut], height[cut], flat[cut], above[cut]
    # the corner that lies alone on its side of the plane; both its edges are cut
    lone = np.where(above.sum(axis=1) == 1, np.argmax(above, axis=1), np.argmin(above, axis=1))
    r = np.arange(len(row))
    ends = []
    for step in (1, 2):
        other = (lone + step) % 3
        h0, h1 = height[r, lone], height[r, other]
        t = h0 / (h0 - h1)
        ends.append(flat[r, lone] + t[:, None] * (flat[r, other] - flat[r, lone]))
    side = (faces.owner[triangle] == stations.b[row]).astype(np.int64)
    return row, side, np.stack(ends, axis=1)


def _face_lines(stations: Stations, row: Index, side: Index, ends: Array) -> tuple[Array, Array]:
    """Slope du/dv and u at v = 0 of each side's facing line, shape (k, 2) each."""
    k = len(stations.gap)
    slope, level = np.zeros((k, 2)), np.stack([-0.5 * stations.gap, 0.5 * stations.gap], axis=1)
    du, dv = (ends[:, 1] - ends[:, 0]).T
    low, high = ends[:, :, 1].min(axis=1), ends[:, :, 1].max(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = du / dv
        at = ends[:, 0, 0] - s * ends[:, 0, 1]
    good = (low <= 1e-6) & (high >= -1e-6) & (np.abs(dv) > 1e-6) & (np.abs(s) < 2.0)
    chosen = np.flatnonzero(good)
    miss = np.abs(at[chosen] - level[row[chosen], side[chosen]])
    order = np.lexsort((miss, side[chosen], row[chosen]))
    chosen = chosen[order]
    key = row[chosen] * 2 + side[chosen]
    first = chosen[np.diff(key, prepend=-1) != 0]
    slope[row[first], side[first]], level[row[first], side[first]] = s[first], at[first]
    return slope, level


def _collinear(row: Index, side: Index, ends: Array, slope: Array, level: Array) -> NDArray[np.bool_]:
    line = level[row, side][:, None] + slope[row, side][:, None] * ends[:, :, 1]
    return np.asarray(np.abs(ends[:, :, 0] - line).max(axis=1) < _ON_LINE)


def _corners(
    row: Index, side: Index, ends: Array, slope: Array, level: Array, top: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Interior angle at each face's ends, rad, how far in v the next edge goes on, m, whether it juts out.

    All of shape (k, side, end). At an inner corner the next edge comes out of the face, into the gap: such an
    end counts as square and not prepared.
    """
    k = len(slope)
    angle, turned = np.full((k, 2, 2), np.pi / 2.0), np.zeros((k, 2, 2))
    inner = np.zeros((k, 2, 2), bool)
    off_line = ~_collinear(row, side, ends, slope, level)
    for e, sign in ((0, -1.0), (1, 1.0)):
        v = top[:, :, e]
        corner = np.stack([level + slope * v, v], axis=2)
        apart = np.linalg.norm(ends - corner[row, side][:, None], axis=2)
        near = np.argmin(apart, axis=1)
        r = np.arange(len(row))
        touching = np.flatnonzero(off_line & (apart[r, near] < _AT_CORNER))
        away = ends[touching, 1 - near[touching]] - corner[row[touching], side[touching]]
        size = np.linalg.norm(away, axis=1)
        order = np.lexsort((-size, side[touching], row[touching]))
        key = (row[touching] * 2 + side[touching])[order]
        first = order[np.diff(key, prepend=-1) != 0]
        i, j = row[touching[first]], side[touching[first]]
        unit = away[first] / np.maximum(size[first, None], 1e-12)
        inward = np.stack([slope[i, j], np.ones(len(i))], axis=1) * -sign
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        run = _run(row, side, ends, (i, j), corner[i, j], unit)
        across = np.where(j == 0, 1.0, -1.0) * (unit[:, 0] - slope[i, j] * unit[:, 1])
        juts = across > _JUTTING
        inner[i, j, e] = juts & (run * across > _OVERHANG)
        bent = np.arccos(np.clip(np.einsum("ij,ij->i", unit, inward), -1.0, 1.0))
        angle[i, j, e] = np.where(juts, np.pi / 2.0, bent)
        turned[i, j, e] = np.where(juts, 0.0, run * np.maximum(sign * unit[:, 1], 0.0))
    return angle, turned, inner


def _run(
    row: Index, side: Index, ends: Array, where: tuple[Index, Index], corner: Array, unit: Array
) -> Array:
    """How far the edges that leave the corners (m, 2) along ``unit`` go on, m."""
    i, j = where
    if not len(i):
        return np.zeros(0)
    slot = np.full((int(max(row.max(), i.max())) + 1, 2), -1, np.int64)
    slot[i, j] = np.arange(len(i))
    which = slot[row, side]
    some = np.flatnonzero(which >= 0)
    w = which[some]
    offset = ends[some] - corner[w][:, None]
    along = np.einsum("nij,nj->ni", offset, unit[w])
    across = offset[..., 0] * unit[w, None, 1] - offset[..., 1] * unit[w, None, 0]
    on = np.abs(across).max(axis=1) < _ON_LINE
    out = np.zeros(len(i))
    np.maximum.at(out, w[on], along[on].max(axis=1))
    return out


def free_sides(
    faces: Faces, origin: Array, u: Array, v: Array, depth: Array, gap: Array, ignored: Index
) -> Sides:
    """Whether the way out of the gap is free, towards +v and -v: shape (k, 2).

    Parameters
    ----------
    origin, u, v : ndarray, shape (k, stations, 3)
        Mid-gap points and axes; the majority of the stations decides.
    depth, gap : ndarray, shape (k,)
        m; the way ends 50 mm beyond the depth. Where the faces touch it starts there, a bit to either side.
    ignored : ndarray, shape (k,)
        An element that does not count, such as the filler; -1 for none.
    """
    k, count, _ = origin.shape
    way, reach = v.reshape(-1, 3), np.repeat(0.5 * depth + _REACH, count)
    start, beside = origin.reshape(-1, 3), _BESIDE * u.reshape(-1, 3)
    half = np.abs(way) * reach[:, None] + np.abs(beside)
    row, triangle = nearby_triangles(faces, start - half, start + half)
    kept = faces.owner[triangle] != ignored[row // count]
    row, triangle = row[kept], triangle[kept]
    tight = gap <= 2.0 * _BESIDE
    out = np.zeros((k, 2), bool)
    clear = np.repeat(0.5 * depth + _BESIDE, count)
    for chosen, shift, first in ((~tight, 0.0, None), (tight, 1.0, clear), (tight, -1.0, clear)):
        some = chosen[row // count]
        r, t = row[some], triangle[some]
        distance = ray_distance(start[r] + shift * beside[r], way[r], faces.triangles[t])
        least = 1e-6 if first is None else first[r]
        shut = np.zeros((k * count, 2), bool)
        for side, sign in ((0, 1.0), (1, -1.0)):
            hit = (sign * distance > least) & (sign * distance <= reach[r])
            shut[r[hit], side] = True
        free = shut.reshape(k, count, 2).sum(axis=1) * 2 <= count
        out[chosen] |= free[chosen]
    return out
