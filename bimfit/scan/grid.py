"""The section frames of a joint, ready for many points at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.pose import Array

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Ids = NDArray[np.int64]
Mask = NDArray[np.bool_]

_PARALLEL = 1e-9


@dataclass(frozen=True)
class StationGrid:
    """Stations in order along a joint, with their frames as arrays.

    Attributes
    ----------
    s : ndarray, shape (k,)
        Distance along the joint, m.
    origins, u, v, n : ndarray, shape (k, 3)
    """

    s: Array
    origins: Array
    u: Array
    v: Array
    n: Array

    @classmethod
    def of(cls, frames: Sequence[SectionFrame], stations: ArrayLike) -> StationGrid:
        """Make a grid from frames and their distances along the joint.

        Raises
        ------
        ValueError
            When they differ in number.
        """
        s = np.asarray(stations, float).reshape(-1)
        if len(s) != len(frames):
            raise ValueError(f"{len(frames)} frames but {len(s)} stations")
        axes = [
            np.array([getattr(f, name) for f in frames]).reshape(-1, 3) for name in ("origin", "u", "v", "n")
        ]
        return cls(s, *axes)

    def __len__(self) -> int:
        return len(self.s)

    @property
    def spacing(self) -> float:
        """Median distance between neighbours, m; NaN for a single station."""
        return float(np.median(np.diff(self.s))) if len(self) > 1 else float("nan")

    def box(self, margin: float) -> Array:
        """Least and greatest corner of all origins, widened by ``margin``; shape (2, 3)."""
        return np.stack([self.origins.min(axis=0) - margin, self.origins.max(axis=0) + margin])

    def nearest(self, points: Array) -> Ids:
        """Station that each point (m, 3) lies nearest to, shape (m,)."""
        if self._cuts is not None:
            along = (points - self.origins[0]) @ self.n[0]
            return np.asarray(np.searchsorted(self._cuts, along), np.int64)
        return np.asarray(self._tree.query(points)[1], np.int64)

    def local(self, points: Array, k: Ids) -> Array:
        """Section coordinates (u, v, n) of points (m, 3) in the frames ``k`` (m,), shape (m, 3)."""
        if self._common is not None:
            # a shared origin goes first, in float64: at map coordinates the rest would drown
            return np.asarray((points - self.origins[0]) @ self._common - self._offsets[k])
        return self.turn(points - self.origins[k], k)

    def turn(self, vectors: Array, k: Ids) -> Array:
        """Components along u, v, n of vectors (m, 3) in the frames ``k`` (m,), shape (m, 3)."""
        if self._common is not None:
            return np.asarray(vectors @ self._common)
        return np.asarray(np.matmul(vectors[:, None, :], self._rotations[k])[:, 0])

    @property
    def straight(self) -> bool:
        """Whether all sections are parallel and in order."""
        return self._cuts is not None

    @cached_property
    def _rotations(self) -> Array:
        """Columns u, v, n of every station, shape (k, 3, 3)."""
        return np.stack([self.u, self.v, self.n], axis=2)

    @cached_property
    def _common(self) -> Array | None:
        """The one rotation of all stations, shape (3, 3), where they share it."""
        turns = self._rotations
        return turns[0] if np.abs(turns - turns[0]).max() < _PARALLEL else None

    @cached_property
    def _offsets(self) -> Array:
        """The origins in the first station's frame, shape (k, 3)."""
        return np.asarray((self.origins - self.origins[0]) @ self._rotations[0])

    @cached_property
    def _cuts(self) -> Array | None:
        """Midway between neighbours along the common normal, where there is one."""
        if np.linalg.norm(self.n - self.n[0], axis=1).max() > _PARALLEL:
            return None
        along = (self.origins - self.origins[0]) @ self.n[0]
        if np.any(np.diff(along) <= 0.0):
            return None
        return np.asarray(0.5 * (along[1:] + along[:-1]))

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.origins)


def ray_enters(origins: Array, directions: Array, low: ArrayLike, high: ArrayLike) -> Array:
    """How far along each ray a box begins, 0 inside it and inf where the ray misses it.

    The slab method, in any number of dimensions.

    Parameters
    ----------
    origins, directions : ndarray, shape (m, d)
    low, high : array_like, shape (d,)
    """
    near, far = np.zeros(len(origins)), np.full(len(origins), np.inf)
    least, greatest = np.asarray(low, float), np.asarray(high, float)
    for axis in range(len(least)):
        o, d = origins[:, axis], directions[:, axis]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            a, b = (least[axis] - o) / d, (greatest[axis] - o) / d
        # fmin and fmax pass over NaN: a ray within a face's plane (0 / 0) is not limited by that slab
        near = np.fmax(near, np.fmin(a, b))
        far = np.fmin(far, np.fmax(a, b))
    return np.where(near <= far, near, np.inf)


def within(points: Array, low: ArrayLike, high: ArrayLike) -> Mask:
    """Which points (m, d) lie in a box, shape (m,). A column at a time, which is several times faster."""
    out = np.ones(len(points), bool)
    for axis, (a, b) in enumerate(zip(np.asarray(low).tolist(), np.asarray(high).tolist(), strict=True)):
        out &= (points[:, axis] >= a) & (points[:, axis] <= b)
    return out


def grouped(k: Ids, count: int) -> tuple[Ids, Ids]:
    """Stable order of group numbers ``k`` (m,) in [0, count), and where each group starts (count + 1,)."""
    # 16-bit keys are sorted by radix, an order of magnitude faster
    keys = k.astype(np.int16) if count < 2**15 else k
    order = np.argsort(keys, kind="stable")
    return order, np.concatenate([[0], np.cumsum(np.bincount(k, minlength=count))])
