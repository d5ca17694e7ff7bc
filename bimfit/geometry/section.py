"""Cut a mesh by a section plane.

Real elements are rarely closed solids: half of them come with doubled vertices, some with missing, doubled or
mis-wound triangles, some as several overlapping bodies. The cut therefore needs no closed mesh. Where the
segments form simple loops, as they nearly always do, the loops are the answer; else they are snapped, noded,
closed and sorted into inside and outside (:mod:`bimfit.geometry.healing`).

Healing comes before clipping: a window clipped out of an open outline cannot be closed any more.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.healing import heal, unique_within
from bimfit.geometry.mesh import Faces, TriangleMesh
from bimfit.geometry.pose import Array
from bimfit.geometry.profile import Mask, Profile, signed_area

WELD = 1e-6
"""Vertices this near to one another are one, and this near to the plane are on it, m."""
STRAIGHT = 1e-6
"""Vertices are dropped where the outline stays within this of itself, m."""
MIN_AREA = 1e-9
"""Loops that enclose less are dropped, m^2."""

Ids = NDArray[np.int64]


def cut(mesh: TriangleMesh, frame: SectionFrame, reach: float | None = None) -> Profile:
    """Cut a mesh by the plane of a section frame.

    A plane that lies in a face of the mesh, as at either end of an element, gives the section right beside
    it on the side where the material is.

    Parameters
    ----------
    mesh : TriangleMesh
        In world coordinates, m; open, mis-wound or overlapping meshes are healed.
    frame : SectionFrame
        The plane through its origin, spanned by u and v.
    reach : float, optional
        Keep what lies within this of the origin in u and in v, m (:func:`clip_window`). None keeps all.

    Returns
    -------
    Profile
        Empty where the plane misses the mesh. ``guessed_length`` is the length of the segments that had to
        be made up to close it; where they do not run straight on from what is there they are no surface
        (``Profile.surface``).
    """
    segments, nodes = _segments(mesh, frame)
    if not len(segments):
        return Profile(())
    loops = _loops(segments, nodes)
    simple = None if loops is None else _sorted_out(loops)
    if simple is not None:
        profile = Profile(_tidy(simple))
    else:
        if loops is not None:  # now consistently wound
            segments = np.concatenate([np.stack([p, np.roll(p, -1, axis=0)], axis=1) for p in loops])
        rings, closings, doubtful = heal(segments)
        length = float(np.linalg.norm(closings[:, 1] - closings[:, 0], axis=1).sum())
        tidy = _tidy(rings)
        profile = Profile(tidy, length, _lying_on(tidy, closings[doubtful]) if doubtful.any() else ())
    if reach is None or profile.empty:
        return profile
    return clip_window(profile, (-reach, -reach), (reach, reach))


def clip_window(profile: Profile, low: tuple[float, float], high: tuple[float, float]) -> Profile:
    """Keep the part of a profile that lies in a window.

    Edges inside the window stay where they are. The edges along its border are no surface of the component:
    they are marked (``Profile.artificial``), still hide what lies behind them, and are never matched
    (:func:`bimfit.geometry.visibility.visible_edges`).

    Parameters
    ----------
    low, high : tuple of 2 float
        Least and greatest (u, v), m.
    """
    if profile.empty:
        return profile
    least, greatest = profile.bounds
    if np.all(least >= low) and np.all(greatest <= high):
        return profile
    import shapely

    window = shapely.box(*low, *high)
    if np.any(least > high) or np.any(greatest < low):
        return Profile(())
    kept = shapely.intersection(_as_shapely(profile), window)
    loops = _tidy([np.asarray(ring.coords)[:-1] for ring in _rings(kept)])
    old = np.concatenate([profile.edges[~profile.surface], _border(low, high)])
    return Profile(loops, profile.guessed_length, _lying_on(loops, old))


# -- plane and triangles ---------------------------------------------------------------------------


def _segments(mesh: TriangleMesh, frame: SectionFrame) -> tuple[Array, Ids]:
    """Directed segments (k, 2, 2), material to the left, and the ids of their ends (k, 2)."""
    points, faces = _welded(mesh, frame)
    height = points[:, 2]
    # Vertices on the plane count as above it, and where then nothing crosses, as below it.
    for above in (height >= 0.0, height > 0.0):
        sides = above[faces]
        count = sides.sum(axis=1)
        crossing = (count == 1) | (count == 2)
        if crossing.any():
            return _crossings(points, faces[crossing], sides[crossing], count[crossing] == 1)
    return np.zeros((0, 2, 2)), np.zeros((0, 2), np.int64)


def _welded(mesh: TriangleMesh, frame: SectionFrame) -> tuple[Array, Faces]:
    """Section coordinates (k, 3) of the triangles near the plane, vertices welded, and their faces."""
    # The origin goes first, in float64: at map coordinates the rest would drown.
    relative = mesh.vertices - frame.origin
    height = relative @ frame.n
    corners = height[mesh.faces]
    with np.errstate(invalid="ignore"):
        near = (corners.min(axis=1) <= 2 * WELD) & (corners.max(axis=1) >= -2 * WELD)
    used, inverse = np.unique(mesh.faces[near], return_inverse=True)
    points = relative[used] @ frame.rotation
    points[np.abs(points[:, 2]) < WELD, 2] = 0.0
    merged = unique_within(points, WELD)
    faces = merged[inverse.reshape(-1, 3)]
    finite = np.isfinite(points).all(axis=1)[faces].all(axis=1)
    return points, np.asarray(faces[finite], np.int64)


def _crossings(points: Array, faces: Faces, sides: NDArray[np.bool_], lone_above: Mask) -> tuple[Array, Ids]:
    rows = np.arange(len(faces))
    lone = np.argmax(sides == lone_above[:, None], axis=1)
    a, b, c = (faces[rows, (lone + k) % 3] for k in range(3))
    # Seen from outside, counter-clockwise, with a above the plane: from edge ab to edge ca.
    first = np.where(lone_above, b, c)
    second = np.where(lone_above, c, b)
    ends, ids = [], []
    for other in (first, second):
        below, over = np.where(lone_above, other, a), np.where(lone_above, a, other)
        p, q = points[below], points[over]
        # always from below to above, so that both triangles of an edge find the same point
        share = p[:, 2] / (p[:, 2] - q[:, 2])
        ends.append(p[:, :2] + (q[:, :2] - p[:, :2]) * share[:, None])
        low, high = np.minimum(below, over), np.maximum(below, over)
        # a crossing at a vertex belongs to the vertex, whichever edge it came along
        low = np.where(p[:, 2] == 0.0, below, np.where(q[:, 2] == 0.0, over, low))
        high = np.where(p[:, 2] == 0.0, below, np.where(q[:, 2] == 0.0, over, high))
        ids.append(low * len(points) + high)
    segments = np.stack(ends, axis=1)
    nodes = np.stack(ids, axis=1)
    real = nodes[:, 0] != nodes[:, 1]
    return segments[real], np.asarray(nodes[real], np.int64)


# -- loops -----------------------------------------------------------------------------------------


def _cycles(nodes: Ids) -> list[tuple[Ids, Mask]] | None:
    """Closed walks as (segments, which are walked forwards); None unless two segments meet at every node."""
    _, ids = np.unique(nodes, return_inverse=True)
    ends = ids.reshape(-1)
    if len(ends) == 0 or not np.all(np.bincount(ends) == 2):
        return None
    # each end's partner: the other end at the same node
    order = np.argsort(ends, kind="stable").reshape(-1, 2)
    partner = np.empty(len(ends), np.int64)
    partner[order[:, 0]], partner[order[:, 1]] = order[:, 1], order[:, 0]
    hops = partner.tolist()
    cycles, seen = [], [False] * len(nodes)
    for first in range(len(nodes)):
        walk, forwards, entered = [], [], 2 * first
        while not seen[entered >> 1]:
            seen[entered >> 1] = True
            walk.append(entered >> 1)
            forwards.append(entered & 1 == 0)
            entered = hops[entered ^ 1]
        if walk:
            cycles.append((np.array(walk), np.array(forwards)))
    return cycles


def _loops(segments: Array, nodes: Ids) -> list[Array] | None:
    """Loops wound as most of their length is; None where the segments do not close."""
    cycles = _cycles(nodes)
    if cycles is None:
        return None
    loops = []
    for walk, forwards in cycles:
        chosen = segments[walk]
        points = np.where(forwards[:, None], chosen[:, 0], chosen[:, 1])
        if not forwards.all():
            length = np.linalg.norm(chosen[:, 1] - chosen[:, 0], axis=1)
            if length[forwards].sum() < length[~forwards].sum():
                points = points[::-1]
        loops.append(points)
    return loops


def _sorted_out(loops: list[Array]) -> list[Array] | None:
    """Turn loops so that material lies to the left; None where they cross or their windings conflict."""
    import shapely

    loops = [loop for loop in loops if len(loop) > 2 and abs(signed_area(loop)) > MIN_AREA]
    if not loops:
        return []
    rings = [shapely.LinearRing(loop) for loop in loops]
    if not shapely.MultiLineString(rings).is_simple:
        return None
    outward = np.array([signed_area(loop) > 0.0 for loop in loops])
    if len(loops) == 1:
        return [loops[0] if outward[0] else loops[0][::-1]]
    solids = np.array([shapely.Polygon(ring) for ring in rings])
    inside = shapely.contains_properly(solids[:, None], shapely.points([loop[0] for loop in loops])[None, :])
    depth = inside.sum(axis=0)
    for k in range(len(loops)):
        parents = np.flatnonzero(inside[:, k] & (depth == depth[k] - 1))
        if len(parents) and outward[parents[0]] == outward[k]:
            return None  # a body inside a body, or a hole turned inside out
    return [loop if outward[k] == (depth[k] % 2 == 0) else loop[::-1] for k, loop in enumerate(loops)]


def _tidy(loops: list[Array]) -> tuple[Array, ...]:
    """Drop vertices on straight runs; start at the least (u, v); greatest loop first."""
    import shapely

    out = []
    for loop in loops:
        first = np.lexsort((loop[:, 1], loop[:, 0]))[0]  # an extreme vertex is a corner
        line = shapely.LineString(np.concatenate([loop[first:], loop[: first + 1]]))
        slim = shapely.get_coordinates(line.simplify(STRAIGHT, preserve_topology=False))[:-1]
        if len(slim) > 2 and abs(signed_area(slim)) > MIN_AREA:
            out.append(slim)
    return tuple(sorted(out, key=lambda loop: -abs(signed_area(loop))))


def _as_shapely(profile: Profile) -> Any:
    import shapely

    # Greatest first: a hole comes after what it is cut from, and an island in it after the hole.
    first, *others = sorted(profile.loops, key=lambda loop: -abs(signed_area(loop)))
    shape: Any = shapely.Polygon(first)
    for loop in others:
        join = shapely.union if signed_area(loop) > 0.0 else shapely.difference
        shape = join(shape, shapely.polygons(loop))
    return shape


def _rings(shape: Any) -> list[Any]:
    """Outer rings counter-clockwise and holes clockwise of whatever areas a shapely geometry holds."""
    import shapely

    out: list[Any] = []
    for part in shapely.get_parts(shapely.get_parts(shape)):
        if isinstance(part, shapely.Polygon) and not part.is_empty:
            turned = shapely.orient_polygons(part)
            out += [turned.exterior, *turned.interiors]
    return out


def _border(low: tuple[float, float], high: tuple[float, float]) -> Array:
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])], float)
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def _lying_on(loops: tuple[Array, ...], segments: Array) -> tuple[Mask, ...]:
    """Which edges of each loop lie, for more than half of their length, on the segments (k, 2, 2)."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    size = np.maximum(np.einsum("ij,ij->i", along, along), 1e-300)
    shares = (np.arange(8) + 0.5) / 8
    masks = []
    for loop in loops:
        step = np.roll(loop, -1, axis=0) - loop
        samples = (loop[:, None] + step[:, None] * shares[None, :, None]).reshape(-1, 2)
        offset = samples[:, None] - start[None]
        where = np.clip(np.einsum("ijk,jk->ij", offset, along) / size, 0.0, 1.0)
        distance = np.linalg.norm(offset - where[..., None] * along[None], axis=2).min(axis=1)
        masks.append((distance < 2 * STRAIGHT).reshape(-1, 8).mean(axis=1) > 0.5)
    return tuple(masks) if any(mask.any() for mask in masks) else ()
