"""Which joints a scan really shows, with both components, and from which side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from bimfit.config import Config
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array
from bimfit.geometry.slice import Slice
from bimfit.pipeline.targets import expected_viewpoint, match_reach, matched_edges

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint
    from bimfit.pipeline.records import JointResult

Cut: TypeAlias = "tuple[Joint, tuple[JointSection, ...], tuple[Slice, ...]]"
LEAST_SHOWN = 0.7
"""A joint not asked for by name is fitted where both components show at this share of its stations."""
SURFACE = 0.1
"""How far from a component's mouth corner its visible surface is looked at, m."""
NEAR = 0.04
"""A return this near a component's designed surface may belong to it, m."""
LOOKS = 40
"""So many stations of a joint are looked at, evenly spread."""


def fully_shown(cuts: Sequence[Cut], config: Config) -> tuple[list[Cut], list[str]]:
    """Leave out joints of which the scan shows one side only, or what stands beside them: kept, ids left.

    Where that would leave none, all are kept: their fits then say what is wrong.
    """
    kept = [c for c in cuts if share_shown(c[1], c[2], config).min() >= LEAST_SHOWN]
    if not kept:
        return list(cuts), []
    ids = {c[0].id for c in kept}
    return kept, [c[0].id for c in cuts if c[0].id not in ids]


def fitted_shown(results: Sequence[JointResult]) -> tuple[list[JointResult], list[str]]:
    """Leave out joints whose stations turned out to hold next to nothing of a component: kept, ids left.

    That something is missing where it should be is a result and stays, and where none is left all do.
    """
    kept = [r for r in results if r.measured or not (r.without_data or not r.stations)]
    if not kept:
        return list(results), []
    ids = {r.joint.id for r in kept}
    return kept, [r.joint.id for r in results if r.joint.id not in ids]


def left_out(ids: Sequence[str]) -> list[str]:
    """A note that names joints that were left out, if any."""
    if not ids:
        return []
    named = ", ".join(sorted(ids)[:6]) + (", ..." if len(ids) > 6 else "")
    return [
        f"left out {len(ids)} joint{'s' if len(ids) > 1 else ''} that the scan shows only in part "
        f"({named}); --joint ID fits one all the same"
    ]


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


def surface_shown(sections: Sequence[JointSection], slices: Sequence[Slice], config: Config) -> float:
    """How much of what the slices hold lies on the components' visible surface beside the mouth, as designed.

    In returns; one that is off by ``config.fit.placement_sigma`` counts 0.6.
    """
    total = 0.0
    for section, slice_ in zip(sections, slices, strict=True):
        edges = matched_edges(section, expected_viewpoint(slice_, section), config)
        nearest = np.minimum(
            *(
                _distances(slice_.points, part, corner)
                for part, corner in zip(edges, section.gap.mouth, strict=True)
            )
        )
        total += float(np.exp(-0.5 * (nearest / config.fit.placement_sigma) ** 2).sum())
    return total


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
