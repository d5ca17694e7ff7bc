"""A triangle mesh as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bimfit.geometry.pose import Array, transform_points

Faces = NDArray[np.int64]


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles in metres; outward is counter-clockwise.

    Attributes
    ----------
    vertices : ndarray, shape (n, 3), float64
    faces : ndarray, shape (m, 3), int64
        Indices into ``vertices``.
    """

    vertices: Array
    faces: Faces

    @classmethod
    def of(cls, vertices: ArrayLike, faces: ArrayLike) -> TriangleMesh:
        """Make a mesh from anything array-like."""
        v = np.ascontiguousarray(np.asarray(vertices, np.float64).reshape(-1, 3))
        f = np.ascontiguousarray(np.asarray(faces, np.int64).reshape(-1, 3))
        return cls(v, f)

    @property
    def triangles(self) -> Array:
        """Corner points, shape (m, 3, 3)."""
        return self.vertices[self.faces]

    @property
    def bounds(self) -> Array:
        """Least and greatest corner, shape (2, 3)."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def face_vectors(self) -> Array:
        """Outward normals scaled by the triangles' areas, shape (m, 3)."""
        t = self.triangles
        return np.asarray(0.5 * np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]))

    @property
    def volume(self) -> float:
        """Enclosed volume, m^3 (signed; meaningful where the mesh is closed)."""
        t = self.triangles - self.vertices.mean(axis=0)
        return float(np.einsum("ij,ij->", t[:, 0], np.cross(t[:, 1], t[:, 2])) / 6.0)

    def transformed(self, T: ArrayLike) -> TriangleMesh:
        """The mesh moved by a 4 x 4 matrix."""
        return TriangleMesh(transform_points(T, self.vertices), self.faces)
