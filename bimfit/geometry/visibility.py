"""Which part of a cross-section a sensor can see."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from bimfit.geometry.pose import Array
from bimfit.geometry.profile import Profile

_MIN_LENGTH = 1e-9


def visible_edges(profiles: Sequence[Profile], viewpoint: ArrayLike) -> tuple[Array, ...]:
    """Cut every profile down to what is seen from ``viewpoint``.

    An edge counts where its outward normal points towards the sensor and no other edge of any of the
    profiles is nearer on the same bearing (METHOD, section 2b). Edges that are no surface
    (``Profile.artificial``) hide others and are not seen themselves.

    Parameters
    ----------
    profiles : sequence of Profile
        All that may be seen or be in the way, in one section frame.
    viewpoint : array_like, shape (2,)
        The sensor (u, v), m.

    Returns
    -------
    tuple of ndarray, shape (k, 2, 2)
        A profile each: the visible pieces of its edges, directed as the edges are.
    """
    eye = np.asarray(viewpoint, float)
    if not profiles:
        return ()
    edges = np.concatenate([p.edges for p in profiles])
    owner = np.repeat(np.arange(len(profiles)), [len(p.edges) for p in profiles])
    normals = np.concatenate([p.normals for p in profiles])
    surface = np.concatenate([p.surface for p in profiles])
    facing = np.einsum("ij,ij->i", normals, eye - edges[:, 0]) > 1e-12
    edges, owner, surface = edges[facing], owner[facing], surface[facing]
    pieces: list[list[Array]] = [[] for _ in profiles]
    for index, piece in _nearest_pieces(edges - eye):
        if surface[index] and np.linalg.norm(piece[1] - piece[0]) > _MIN_LENGTH:
            pieces[int(owner[index])].append(piece + eye)
    return tuple(np.array(p).reshape(-1, 2, 2) for p in pieces)


def _nearest_pieces(edges: Array) -> list[tuple[int, Array]]:
    """Pieces of the edges (n, 2, 2), seen from the origin, that nothing hides, as (edge, piece)."""
    if not len(edges):
        return []
    # A facing edge runs clockwise as seen from the eye: its end has the lesser bearing.
    high = np.arctan2(edges[:, 0, 1], edges[:, 0, 0])
    d = edges[:, 1] - edges[:, 0]
    sweep = np.arctan2(
        edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0],
        np.einsum("ij,ij->i", edges[:, 0], edges[:, 1]),
    )
    low = high + sweep
    stops = np.unique(np.mod(np.concatenate([low, high]), 2.0 * np.pi))
    starts, ends = stops, np.append(stops[1:], stops[0] + 2.0 * np.pi)
    middle = 0.5 * (starts + ends)
    # bearing of each interval's middle relative to each edge's low end
    relative = np.mod(middle[:, None] - low[None, :], 2.0 * np.pi)
    inside = relative < -sweep[None, :]
    ray = np.stack([np.cos(middle), np.sin(middle)], axis=1)
    normal = np.stack([d[:, 1], -d[:, 0]], axis=1)
    offset = np.einsum("ij,ij->i", normal, edges[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(inside, offset[None, :] / (ray @ normal.T), np.inf)
    nearest = np.argmin(distance, axis=1)
    seen = np.isfinite(distance[np.arange(len(middle)), nearest])
    out: list[tuple[int, Array]] = []
    for k in np.flatnonzero(seen):
        i = int(nearest[k])
        bearings = np.array([ends[k], starts[k]])
        rays = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
        scale = offset[i] / (rays @ normal[i])
        out.append((i, rays * scale[:, None]))
    return out


def clip_edges(edges: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """The parts of directed edges (n, 2, 2) inside an upright box, shape (k, 2, 2), k <= n.

    Parameters
    ----------
    edges : array_like, shape (n, 2, 2)
    low, high : array_like, shape (2,)
        Corners of the box.
    """
    e = np.asarray(edges, float).reshape(-1, 2, 2)
    start, along = e[:, 0], e[:, 1] - e[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        a = (np.asarray(low, float) - start) / along
        b = (np.asarray(high, float) - start) / along
    outside = (along == 0.0) & ((start < low) | (start > high))
    flat = along == 0.0
    enter = np.where(flat, 0.0, np.minimum(a, b)).max(axis=1).clip(0.0, None)
    leave = np.where(flat, 1.0, np.maximum(a, b)).min(axis=1).clip(None, 1.0)
    kept = (enter < leave) & ~outside.any(axis=1)
    whole = kept & (enter == 0.0) & (leave == 1.0)
    parts = np.stack([start + enter[:, None] * along, start + leave[:, None] * along], axis=1)
    return np.asarray(np.where(whole[:, None, None], e, parts)[kept])
