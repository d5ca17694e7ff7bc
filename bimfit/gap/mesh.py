"""The as-built gap as one closed mesh, lofted through its sections."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bimfit.gap.corners import Rungs, with_mitres
from bimfit.gap.ladder import ladder
from bimfit.gap.runs import Span, find_runs
from bimfit.gap.section import GapSection
from bimfit.geometry.mesh import Faces, TriangleMesh
from bimfit.geometry.pose import Array

_Key = tuple[int, int]


@dataclass(frozen=True)
class GapMesh:
    """A gap's space: closed bodies, outward counter-clockwise.

    Attributes
    ----------
    vertices : ndarray, shape (n, 3)
        World coordinates, m, float64.
    faces : ndarray, shape (m, 3), int64
    width : ndarray, shape (n,)
        Width of the gap at each vertex, across it, m.
    bodies : int
        How many separate bodies: the gap is split where it is closed and where it was not measured.
    bridged, unmeasured : tuple of (float, float)
        Stretches along the joint without a measurement, interpolated and left out.
    """

    vertices: Array
    faces: Faces
    width: Array
    bodies: int
    bridged: tuple[Span, ...] = ()
    unmeasured: tuple[Span, ...] = ()

    @property
    def empty(self) -> bool:
        """Whether nothing is open, or nothing could be lofted."""
        return len(self.faces) == 0

    @property
    def triangles(self) -> TriangleMesh:
        """The bare mesh."""
        return TriangleMesh(self.vertices, self.faces)

    @property
    def volume(self) -> float:
        """Enclosed volume, m^3."""
        return 0.0 if self.empty else self.triangles.volume


def loft(
    sections: Sequence[GapSection | None], *, ring: float | None = None, max_bridge: float | None = None
) -> GapMesh:
    """Stitch sections into closed, oriented 2-manifold bodies.

    Neighbouring sections are joined by straight rungs' ends. Where the gap closes, between stations or
    between mouth and root, the two sides are brought together along the line where their distance passes
    zero, and what lies beyond is left out; so bodies never turn inside out, and what overlaps is no volume.

    Parameters
    ----------
    sections : sequence of GapSection or None
        In order along the joint; None where a station has no estimate.
    ring : float, optional
        Length of a path that closes on itself, m.
    max_bridge : float, optional
        See :func:`bimfit.gap.runs.find_runs`.

    Returns
    -------
    GapMesh
        Empty where no two neighbouring stations were measured, or nothing is open.

    Raises
    ------
    ValueError
        When sections are out of order.
    """
    runs = find_runs(sections, ring=ring, max_bridge=max_bridge)
    vertices, faces, widths, bodies, count = (
        [np.zeros((0, 3))],
        [np.zeros((0, 3), np.int64)],
        [np.zeros(0)],
        0,
        0,
    )
    for run in runs.sections:
        if len(run) < 2:
            continue
        rows = with_mitres(ladder(run), ring=runs.ring)
        if len(rows) < 2:
            continue
        v, f, w = _Sheets(rows, ring=runs.ring and len(rows) > 2).build()
        if _runs_against_normal(run):
            f = f[:, ::-1]
        v, f, w, found = _checked(v, f, w)
        if not found:
            continue
        vertices.append(v)
        faces.append(f + count)
        widths.append(w)
        count += len(v)
        bodies += found
    return GapMesh(
        np.concatenate(vertices),
        np.concatenate(faces),
        np.concatenate(widths),
        bodies,
        runs.bridged,
        runs.unmeasured,
    )


def _runs_against_normal(run: Sequence[GapSection]) -> bool:
    """Whether s grows against the sections' normals, which turns a loft inside out."""
    pairs = itertools.pairwise(run)
    return sum(float((a.frame.n + b.frame.n) @ (b.frame.origin - a.frame.origin)) for a, b in pairs) < 0.0


class _Sheets:
    """Marching triangles on the ladder's grid: keeps what is open, and closes it along A, B and the rims."""

    def __init__(self, rows: Sequence[Rungs], *, ring: bool) -> None:
        self._rows = rows
        self._stations, self._rungs = len(rows), len(rows[0].opening)
        self._a, self._b = np.concatenate([r.a for r in rows]), np.concatenate([r.b for r in rows])
        self._w = np.concatenate([r.opening for r in rows])
        self._ring = ring
        self._keys: dict[_Key, int] = {}
        self._points: list[Array] = []
        self._widths: list[float] = []
        self._caps: dict[int, Faces | None] = {}
        self._faces: list[tuple[int, int, int]] = []
        self._rim: list[tuple[int, int, int, int]] = []

    def build(self) -> tuple[Array, Faces, Array]:
        """Vertices, faces and widths of the run."""
        rows = self._stations if self._ring else self._stations - 1
        for i in range(rows):
            for j in range(self._rungs - 1):
                k, right = i * self._rungs + j, ((i + 1) % self._stations) * self._rungs + j
                # Walked like this, A's sheet faces A: outwards.
                self._triangle(k, k + 1, right + 1)
                self._triangle(k, right + 1, right)
        self._close_rims()
        if not self._ring:
            self._cap(0)
            self._cap(self._stations - 1)
        return (
            np.array(self._points).reshape(-1, 3),
            np.array(self._faces, np.int64).reshape(-1, 3),
            np.array(self._widths),
        )

    def _triangle(self, *corners: int) -> None:
        """Clip a triangle of the grid to what is open, and lay it on both sides."""
        is_open = [self._w[k] > 0.0 for k in corners]
        if not any(is_open):
            return
        polygon: list[_Key] = []
        for n, k in enumerate(corners):
            after = corners[(n + 1) % 3]
            if is_open[n]:
                polygon.append((k, k))
            if is_open[n] != is_open[(n + 1) % 3]:
                polygon.append((min(k, after), max(k, after)))
        side_a = [self._vertex(key, 0) for key in polygon]
        side_b = [self._vertex(key, 1) for key in polygon]
        for n in range(1, len(polygon) - 1):
            self._face(side_a[0], side_a[n], side_a[n + 1])
            self._face(side_b[0], side_b[n + 1], side_b[n])
        for n, key in enumerate(polygon):
            after_key = polygon[(n + 1) % len(polygon)]
            if self._on_rim(key, after_key):
                m = (n + 1) % len(polygon)
                self._rim.append((side_a[n], side_a[m], side_b[n], side_b[m]))

    def _on_rim(self, p: _Key, q: _Key) -> bool:
        """Whether the edge from p to q is on the grid's rim: mouth, root, first or last station."""
        nodes = {*p, *q}
        if len(nodes) != 2:
            return False
        i, j = zip(*(divmod(k, self._rungs) for k in nodes), strict=True)
        if i[0] == i[1]:
            return not self._ring and i[0] in (0, self._stations - 1) and not self._whole(i[0])
        return j[0] == j[1] and j[0] in (0, self._rungs - 1)

    def _whole(self, i: int) -> bool:
        """Whether an end is open all over, so that its cap is the section's own polygon."""
        part = self._w[i * self._rungs : (i + 1) * self._rungs]
        return self._rows[i].plane is not None and bool((part > 0.0).all()) and self._capped(i) is not None

    def _capped(self, i: int) -> Faces | None:
        """Triangles of an end's polygon; None where its outline crosses itself and the rungs must do."""
        if i not in self._caps:
            self._caps[i] = _triangulate(self._rows[i].plane)
        return self._caps[i]

    def _cap(self, i: int) -> None:
        triangles = self._capped(i) if self._whole(i) else None
        if triangles is None:
            return
        nodes = range(i * self._rungs, (i + 1) * self._rungs)
        ring = [self._vertex((k, k), 0) for k in nodes] + [self._vertex((k, k), 1) for k in reversed(nodes)]
        for p, q, r in triangles.tolist():
            # Seen along n the polygon runs counter-clockwise: outwards at the last station.
            self._face(ring[p], ring[r], ring[q]) if i == 0 else self._face(ring[p], ring[q], ring[r])

    def _close_rims(self) -> None:
        for pa, qa, pb, qb in self._rim:
            if pa != pb:
                self._face(qa, pa, pb)
            if qa != qb:
                self._face(qa, pb, qb)

    def _face(self, p: int, q: int, r: int) -> None:
        self._faces.append((p, q, r))

    def _vertex(self, key: _Key, side: int) -> int:
        """The vertex of a node on one side, or where the sides meet on the edge between two nodes."""
        k, m = key
        pinch = k != m
        name = (k * len(self._w) + m, -1 if pinch else side)
        found = self._keys.get(name)
        if found is not None:
            return found
        if pinch:
            t = self._w[k] / (self._w[k] - self._w[m])
            a = self._a[k] + t * (self._a[m] - self._a[k])
            b = self._b[k] + t * (self._b[m] - self._b[k])
            self._points.append(0.5 * (a + b))
            self._widths.append(0.0)
        else:
            self._points.append((self._b if side else self._a)[k])
            self._widths.append(float(self._w[k]))
        self._keys[name] = len(self._points) - 1
        return self._keys[name]


def _triangulate(ring: Array | None) -> Faces | None:
    """Triangles of a simple counter-clockwise polygon that keep all its edges, or None."""
    import manifold3d
    import shapely

    if ring is None or not shapely.is_valid(shapely.polygons(ring)):
        return None
    try:
        triangles = np.asarray(manifold3d.triangulate([ring]), np.int64).reshape(-1, 3)
    except (ValueError, RuntimeError):
        return None
    n = len(ring)
    edges = set(zip(triangles.ravel().tolist(), np.roll(triangles, -1, axis=1).ravel().tolist(), strict=True))
    kept = len(triangles) == n - 2 and all((k, (k + 1) % n) in edges for k in range(n))
    return triangles if kept else None


def _checked(vertices: Array, faces: Faces, width: Array) -> tuple[Array, Faces, Array, int]:
    """Make sure of closed, oriented bodies; their number comes last.

    Those without a positive volume, which sections that cut each other leave behind, are left out.

    Raises
    ------
    ArithmeticError
        Which would be a fault of this module, not of its input.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(faces):
        return vertices, faces, width, 0
    n = len(vertices)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    there, back = start * n + end, end * n + start
    if len(np.unique(there)) != len(there) or not np.array_equal(np.sort(there), np.sort(back)):
        raise ArithmeticError("the lofted gap is not a closed, oriented 2-manifold")
    edges = coo_array((np.ones(len(start), np.int8), (start, end)), (n, n))
    count, label = connected_components(edges, directed=False)
    t = (vertices - vertices.mean(axis=0))[faces]
    six = np.einsum("ij,ij->i", t[:, 0], np.cross(t[:, 1], t[:, 2]))
    good = np.bincount(label[faces[:, 0]], six, count) > 0.0
    if good.all():
        return vertices, faces, width, int(count)
    kept = good[label]
    number = np.cumsum(kept) - 1
    return vertices[kept], number[faces[kept[faces[:, 0]]]], width[kept], int(good.sum())
