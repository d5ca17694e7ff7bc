"""Rows of rungs closed into bodies: the two sides' sheets, and what joins them along the rims."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bimfit.gap.corners import Rungs
from bimfit.geometry.mesh import Faces
from bimfit.geometry.pose import Array

_Key = tuple[int, int]


def close_rows(rows: Sequence[Rungs], *, ring: bool) -> tuple[Array, Faces, Array]:
    """Close rows of rungs into a mesh.

    Parameters
    ----------
    rows : sequence of Rungs
        At least two, with the same number of rungs.
    ring : bool
        Whether the last row leads into the first.

    Returns
    -------
    vertices : ndarray, shape (n, 3)
    faces : ndarray, shape (m, 3)
        Outward where rows run along their normals.
    width : ndarray, shape (n,)
    """
    if all(bool((row.opening > 0.0).all()) for row in rows):
        return _close_open(rows, ring=ring)
    return _Sheets(rows, ring=ring).build()


def _close_open(rows: Sequence[Rungs], *, ring: bool) -> tuple[Array, Faces, Array]:
    """The same as :class:`_Sheets` makes of rows that are open all over, all at once."""
    stations, rungs = len(rows), len(rows[0].opening)
    here = np.arange(stations if ring else stations - 1)
    there = (here + 1) % stations
    j = np.arange(rungs - 1)
    k, right = (here[:, None] * rungs + j).ravel(), (there[:, None] * rungs + j).ravel()
    side_a = np.concatenate([np.stack([k, k + 1, right + 1], 1), np.stack([k, right + 1, right], 1)])
    b = stations * rungs
    parts = [side_a, side_a[:, ::-1] + b]
    mouth, after = here * rungs, there * rungs
    root, beyond = mouth + rungs - 1, after + rungs - 1
    # From A to B: along the mouth, back along the root.
    for p, q in ((mouth, after), (beyond, root)):
        parts += [np.stack([p, q, q + b], 1), np.stack([p, q + b, p + b], 1)]
    if not ring:
        for i in (0, stations - 1):
            nodes = np.arange(i * rungs, (i + 1) * rungs)
            cap = _triangulate(rows[i].plane)
            if cap is not None:
                faces = np.concatenate([nodes, nodes[::-1] + b])[cap]
            else:
                p, q = nodes[:-1], nodes[1:]
                faces = np.concatenate([np.stack([p, q, q + b], 1), np.stack([p, q + b, p + b], 1)])
            parts.append(faces[:, ::-1] if i == 0 else faces)
    vertices = np.concatenate([*(row.a for row in rows), *(row.b for row in rows)])
    width = np.concatenate([row.opening for row in rows])
    return vertices, np.concatenate(parts).astype(np.int64), np.concatenate([width, width])


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
