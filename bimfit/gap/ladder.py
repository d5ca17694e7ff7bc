"""Matched points on the two sides of a gap: rungs of a ladder from mouth to root."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bimfit.gap.corners import Rungs
from bimfit.gap.section import GapSection
from bimfit.geometry.pose import Array

#: A rung shorter than this is closed, m; keeps open ones apart even in single precision.
CLOSED = 1e-6
_MATCH = 0.02
_MAX_RUNGS = 64


def ladder(run: Sequence[GapSection]) -> list[Rungs]:
    """Give every section of a run the same rungs, by share of each side's length.

    Sides that have the same vertices at every station keep them all exactly; otherwise the rungs stand at the
    shares of every station's vertices, thinned to 64. Openings are never between -CLOSED and CLOSED, so that
    every sign is certain.
    """
    rows = []
    own = [(_lengths(section.side_a), _lengths(section.side_b)) for section in run]
    for section, (own_a, own_b), (share_a, share_b) in zip(run, own, _shares(own), strict=True):
        pa, pb = _at(section.side_a, own_a, share_a), _at(section.side_b, own_b, share_b)
        world = section.frame.to_world
        plane = np.concatenate([pa, pb[::-1]])
        rows.append(Rungs(world(pa), world(pb), _opening(section, pa, pb), section.frame.n, plane))
    return rows


def _opening(section: GapSection, pa: Array, pb: Array) -> Array:
    """Signed width along the common normal; A's side has the gap on its left, walking from the mouth."""
    both = pa + pb
    tangent = np.empty_like(both)
    tangent[1:-1] = both[2:] - both[:-2]
    tangent[0], tangent[-1] = both[1] - both[0], both[-1] - both[-2]
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    size = np.sqrt(np.einsum("ij,ij->i", normal, normal))
    w = np.einsum("ij,ij->i", pb - pa, normal) / np.where(size > 1e-12, size, 1.0)
    if section.closed:
        w = np.minimum(w, -CLOSED)
    elif section.width_narrowest > CLOSED:
        # No rung can be shorter than the least distance of the sides.
        w = np.maximum(w, section.width_narrowest)
    return np.where(np.abs(w) < CLOSED, -CLOSED, w)


def _shares(own: list[tuple[Array, Array]]) -> list[tuple[Array, Array]]:
    """For each section the shares of A's and of B's length at which its rungs stand."""
    if len({(len(fa), len(fb)) for fa, fb in own}) == 1:
        indexed = _by_vertex(own)
        if indexed is not None:
            return indexed
    common = _thin(np.unique(np.concatenate([np.round(f, 6) for pair in own for f in pair])))
    return [(common, common)] * len(own)


def _by_vertex(own: list[tuple[Array, Array]]) -> list[tuple[Array, Array]] | None:
    """Rungs that follow the vertices' numbers, where they come in the same order at every station."""
    all_a, all_b = np.array([fa for fa, _ in own]), np.array([fb for _, fb in own])
    mean_a, mean_b = all_a.mean(axis=0), all_b.mean(axis=0)
    columns: list[tuple[Array, Array]] = []
    i = j = 0
    while i < len(mean_a) or j < len(mean_b):
        fa = mean_a[i] if i < len(mean_a) else np.inf
        fb = mean_b[j] if j < len(mean_b) else np.inf
        if abs(fa - fb) <= _MATCH:
            columns.append((all_a[:, i], all_b[:, j]))
            i, j = i + 1, j + 1
        elif fa < fb:
            columns.append((all_a[:, i], all_a[:, i]))
            i += 1
        else:
            columns.append((all_b[:, j], all_b[:, j]))
            j += 1
    rungs_a = np.stack([c[0] for c in columns], axis=1)
    rungs_b = np.stack([c[1] for c in columns], axis=1)
    ordered = bool((np.diff(rungs_a, axis=1) >= 0.0).all() and (np.diff(rungs_b, axis=1) >= 0.0).all())
    return list(zip(rungs_a, rungs_b, strict=True)) if ordered else None


def _lengths(side: Array) -> Array:
    """Share of a side's length at each of its vertices."""
    step = side[1:] - side[:-1]
    steps = np.sqrt(np.einsum("ij,ij->i", step, step))
    total = float(steps.sum())
    if total <= 0.0:
        return np.linspace(0.0, 1.0, len(side))
    out = np.concatenate([[0.0], np.cumsum(steps) / total])
    out[-1] = 1.0
    return out


def _at(side: Array, own: Array, share: Array) -> Array:
    if np.array_equal(own, share):
        return side
    return np.stack([np.interp(share, own, side[:, 0]), np.interp(share, own, side[:, 1])], axis=1)


def _thin(shares: Array) -> Array:
    kept = [float(shares[0])]
    least = 1e-4 if len(shares) <= _MAX_RUNGS else 1.0 / _MAX_RUNGS
    for share in shares[1:-1].tolist():
        if share - kept[-1] >= least and 1.0 - share >= least:
            kept.append(share)
    return np.array([*kept, 1.0])
