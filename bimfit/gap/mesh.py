"""The as-built gap as one closed mesh, lofted through its sections."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bimfit.gap.corners import with_mitres
from bimfit.gap.ladder import ladder
from bimfit.gap.runs import Span, find_runs
from bimfit.gap.section import GapSection
from bimfit.gap.sheets import close_rows
from bimfit.geometry.mesh import Faces, TriangleMesh
from bimfit.geometry.pose import Array


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
        v, f, w = close_rows(rows, ring=runs.ring and len(rows) > 2)
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
