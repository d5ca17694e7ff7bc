"""What a scan shows in one section plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bimfit.geometry.pose import Array


@dataclass(frozen=True)
class Beams:
    """Range measurements in a section plane.

    Attributes
    ----------
    origins, directions : ndarray, shape (n, 2)
        In section coordinates; directions are of unit length.
    ranges : ndarray, shape (n,)
        In the plane, m; NaN where nothing came back.
    """

    origins: Array
    directions: Array
    ranges: Array

    @property
    def hit(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which beams returned, shape (n,)."""
        return np.isfinite(self.ranges)

    @property
    def points(self) -> Array:
        """Where the beams that returned ended, shape (m, 2)."""
        k = self.hit
        return np.asarray(self.origins[k] + self.directions[k] * self.ranges[k, None])


@dataclass(frozen=True)
class Slice:
    """The part of a scan that belongs to one station, in its section frame.

    Attributes
    ----------
    s : float
        The station, m along the joint.
    points : ndarray, shape (n, 2)
        Returns (u, v), m.
    beams : Beams or None
        The measurements behind the points, missing returns included, where the scan knows them; then
        ``points`` equals ``beams.points``.
    viewpoint : ndarray, shape (2,), or None
        Where the sensor stood, in the section plane (mean over sweeps); may be outside it in n.
    sweeps : int
        How many sweeps went in.
    """

    s: float
    points: Array
    beams: Beams | None = None
    viewpoint: Array | None = None
    sweeps: int = 1
