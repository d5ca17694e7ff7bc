"""Which joints a scan really shows: both components, not just one of them or what stands beside."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bimfit.config import Config
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array
from bimfit.geometry.slice import Slice
from bimfit.pipeline.targets import expected_viewpoint, match_reach, matched_edges

SURFACE = 0.1
"""How far from a component's mouth corner its visible surface is looked at, m."""
NEAR = 0.04
"""A return this near a component's designed surface may belong to it, m."""
LOOKS = 40
"""So many stations of a joint are looked at, evenly spread."""


def share_shown(sections: Sequence[JointSection], slices: Sequence[Slice], config: Config) -> Array:
    """The share of a joint's stations at which each component shows itself, shape (2,), and 0 without any.

    A component shows itself where at least half of ``config.fit.min_points`` returns lie near its visible
    surface beside the mouth, as designed and nearer to it than to the other component.
    """
    if not sections:
        return np.zeros(2)
    picked = np.unique(np.linspace(0, len(sections) - 1, min(LOOKS, len(sections))).round().astype(int))
    shown = [_shown(sections[k], slices[k], config) for k in picked]
    return np.asarray(np.mean(shown, axis=0))


def _shown(section: JointSection, slice_: Slice, config: Config) -> tuple[bool, bool]:
    points = slice_.points[(np.abs(slice_.points) <= match_reach(config)).all(axis=1)]
    edges = matched_edges(section, expected_viewpoint(slice_, section), config)
    a, b = (_distances(points, part, corner) for part, corner in zip(edges, section.gap.mouth, strict=True))
    least = 0.5 * config.fit.min_points
    return (
        int(np.count_nonzero((a <= NEAR) & (a <= b))) >= least,
        int(np.count_nonzero((b <= NEAR) & (b <= a))) >= least,
    )


def _distances(points: Array, edges: Array, corner: Array) -> Array:
    """From each point (n, 2) to the nearest of the edges (k, 2, 2) about the corner, shape (n,)."""
    start, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    square = np.maximum(np.einsum("ij,ij->i", along, along), 1e-18)
    near = _to_edges(corner[None, :], start, along, square)[0] <= SURFACE
    if not near.any() or not len(points):
        return np.full(len(points), np.inf)
    return np.asarray(_to_edges(points, start[near], along[near], square[near]).min(axis=1))


def _to_edges(points: Array, start: Array, along: Array, square: Array) -> Array:
    """Distances from points (n, 2) to edges, shape (n, k)."""
    offset = points[:, None, :] - start[None, :, :]
    share = np.clip(np.einsum("nkj,kj->nk", offset, along) / square, 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[..., None] * along, axis=2))
