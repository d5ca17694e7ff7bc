"""Point clouds: returns without the beams that made them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bimfit.geometry.pose import Array, transform_points

FARTHEST = 1e12
"""No coordinate is greater than this in any unit: what a file says beyond it is damage."""


def usable(points: Array) -> NDArray[np.bool_]:
    """Which points (n, 3) have coordinates that can be calculated with, shape (n,)."""
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(points) <= FARTHEST).all(axis=1))


@dataclass(frozen=True)
class PointCloud:
    """Points in world coordinates.

    Attributes
    ----------
    points : ndarray, shape (n, 3), float64
        Finite, m.
    viewpoint : ndarray, shape (3,), or None
        Where the sensor stood, where the file says so.
    normals : ndarray, shape (n, 3), or None
    colors : ndarray, shape (n, 3), uint8, or None
    intensity : ndarray, shape (n,), or None
    source : str
        The file that it is from.
    notes : tuple of str
        What a user should know of how it was read.
    """

    points: Array
    viewpoint: Array | None = None
    normals: Array | None = None
    colors: NDArray[np.uint8] | None = None
    intensity: Array | None = None
    source: str = ""
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def bounds(self) -> Array:
        """Least and greatest corner, shape (2, 3); NaN where there is no point."""
        if not len(self.points):
            return np.full((2, 3), np.nan)
        return np.stack([self.points.min(axis=0), self.points.max(axis=0)])

    def transformed(self, T: ArrayLike) -> PointCloud:
        """The cloud moved by a rigid 4 x 4 matrix, such as T_world_scanner."""
        m = np.asarray(T, float)
        turn = m[:3, :3].T
        return replace(
            self,
            points=transform_points(m, self.points),
            viewpoint=None if self.viewpoint is None else transform_points(m, self.viewpoint),
            normals=None if self.normals is None else np.asarray(self.normals @ turn),
        )


def joined_clouds(clouds: Sequence[PointCloud]) -> PointCloud:
    """One cloud out of at least one; what not all of them know is left out.

    Where they were seen from different places, which point was seen from where is lost, and said so.
    """
    eyes = [cloud.viewpoint for cloud in clouds]
    notes = tuple(dict.fromkeys(note for cloud in clouds for note in cloud.notes))
    places = {tuple(eye.tolist()) for eye in eyes if eye is not None}
    one = len(places) == 1 and all(eye is not None for eye in eyes)
    if places and not one:
        notes = (*notes, f"seen from {len(places)} places; read whole, its points do not know which")

    def column(name: str) -> NDArray[Any] | None:
        values = [getattr(cloud, name) for cloud in clouds]
        return None if any(value is None for value in values) else np.concatenate(values)

    return replace(
        clouds[0],
        points=np.concatenate([cloud.points for cloud in clouds]),
        viewpoint=eyes[0] if one else None,
        normals=column("normals"),
        colors=column("colors"),
        intensity=column("intensity"),
        notes=notes,
    )
