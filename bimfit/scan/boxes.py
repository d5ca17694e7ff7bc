"""Axis-aligned boxes: the part of a scan that is worth reading."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bimfit.geometry.pose import Array, transform_points
from bimfit.scan import _kernels as kernels
from bimfit.scan.grid import Ids, Mask

_BLOCK = 1 << 15
_MOST_CELLS = 4_000_000
_MOST_PER_AXIS = 2_000
_CELLS_A_BOX = 3.0
_ONE, _NIL = np.ones(3), np.zeros(3)


@dataclass(frozen=True, eq=False)
class Boxes:
    """Axis-aligned boxes that may overlap.

    Attributes
    ----------
    array : ndarray, shape (k, 2, 3)
        Least and greatest corner of each, k at least 1; a box holds its own faces.
    """

    array: Array

    @classmethod
    def of(cls, boxes: ArrayLike) -> Boxes:
        """Make boxes of an array (k, 2, 3).

        Raises
        ------
        ValueError
            When the shape is another, there is none, or a corner is not finite.
        """
        array = np.ascontiguousarray(boxes, np.float64)
        if array.ndim != 3 or array.shape[1:] != (2, 3) or not len(array) or not np.isfinite(array).all():
            raise ValueError(f"boxes take a finite array (k, 2, 3) with k at least 1, got {array.shape}")
        return cls(np.stack([array.min(axis=1), array.max(axis=1)], axis=1))

    def __len__(self) -> int:
        return len(self.array)

    @cached_property
    def bounds(self) -> Array:
        """The box around all of them, shape (2, 3)."""
        return np.stack([self.array[:, 0].min(axis=0), self.array[:, 1].max(axis=0)])

    def moved(self, T: ArrayLike) -> Boxes:
        """Boxes around the boxes moved by a 4 x 4 affine matrix."""
        m = np.asarray(T, float)
        middle = transform_points(m, self.array.mean(axis=1))
        half = 0.5 * (self.array[:, 1] - self.array[:, 0]) @ np.abs(m[:3, :3]).T
        slack = 1e-9 * np.maximum(1.0, np.abs(middle))
        return Boxes(np.stack([middle - half - slack, middle + half + slack], axis=1))

    def joined(self, other: Boxes) -> Boxes:
        """These and those."""
        return Boxes(np.concatenate([self.array, other.array]))

    def grown(self, margin: float) -> Boxes:
        """Boxes that reach ``margin`` farther every way."""
        return Boxes(self.array + np.array([[-margin], [margin]]))

    def scaled(self, factor: float) -> Boxes:
        """Boxes with all coordinates times a positive factor."""
        return Boxes(self.array * factor)

    def inside(self, points: Array) -> Mask:
        """Which points (n, 3) lie in any box, shape (n,); a point with NaN lies in none."""
        out = np.zeros(len(points), bool)
        out[self.find(points[:, 0], points[:, 1], points[:, 2])[0]] = True
        return out

    def find(
        self,
        x: NDArray[np.generic],
        y: NDArray[np.generic],
        z: NDArray[np.generic],
        scale: Array = _ONE,
        offset: Array = _NIL,
    ) -> tuple[Ids, Ids]:
        """The points (x, y, z) * scale + offset that lie in any box, and the cells of a grid they lie in.

        Parameters
        ----------
        x, y, z : ndarray, shape (n,)
            Of any number type and stride, so that a file's own integers need not be made floats first.
        scale, offset : ndarray, shape (3,)

        Returns
        -------
        index, cell : ndarray, shape (m,)
            Ascending numbers of the points. Points of one cell share its number.
        """
        origin, per_cell, shape, marks, starts, members = self._grid
        slope, shift = scale * per_cell, (offset - origin) * per_cell
        room = np.empty(min(len(x), _BLOCK), np.int64)
        found = []
        for start in range(0, len(x), _BLOCK):
            part = slice(start, start + _BLOCK)
            # what lies side by side in the cache is looked through several times faster
            columns = (np.ascontiguousarray(column[part]) for column in (x, y, z))
            count = kernels.candidates(*columns, slope, shift, shape, marks, room)
            found.append(room[:count] + start)
        index = np.concatenate(found) if found else np.zeros(0, np.int64)
        points = np.stack([c[index].astype(np.float64) for c in (x, y, z)], axis=1) * scale + offset
        cell = np.empty(len(index), np.int64)
        kernels.cells_inside(points, origin, per_cell, shape, starts, members, self._low, self._high, cell)
        keep = cell >= 0
        return index[keep], cell[keep]

    def cells_of(self, box: Array) -> Ids:
        """Every cell that a box (2, 3) reaches into, shape (m,), ascending."""
        origin, per_cell, shape = self._grid[:3]
        low, high = (np.floor((corner - origin) * per_cell).astype(np.int64) for corner in box)
        low, high = np.clip(low, 0, shape - 1), np.clip(high, -1, shape - 1)
        i, j, k = (np.arange(a, b + 1) for a, b in zip(low.tolist(), high.tolist(), strict=True))
        return np.asarray(((i[:, None, None] * shape[1] + j[:, None]) * shape[2] + k).reshape(-1))

    def meets(self, low: Array, high: Array) -> Mask:
        """Which of other boxes, ``low`` to ``high`` (m, 3) each, touch any of these; shape (m,)."""
        out = np.zeros(len(low), bool)
        for a, b in zip(self._low, self._high, strict=True):
            out |= ((low <= b) & (high >= a)).all(axis=1)
        return out

    @cached_property
    def _low(self) -> Array:
        return np.ascontiguousarray(self.array[:, 0])

    @cached_property
    def _high(self) -> Array:
        return np.ascontiguousarray(self.array[:, 1])

    @cached_property
    def _grid(self) -> tuple[Array, float, Ids, NDArray[np.uint8], Ids, NDArray[np.int32]]:
        """Origin, cells a unit of length, shape, a bit for each cell with a box, and the boxes in each."""
        low, high = self.bounds
        extent = np.maximum(high - low, 1e-12)
        size = max(
            float(np.median(self.array[:, 1] - self.array[:, 0])) / _CELLS_A_BOX,
            float(extent.max()) / _MOST_PER_AXIS,
            1e-9,
        )
        while np.prod(np.ceil(extent / size) + 2.0) > _MOST_CELLS:
            size *= 1.25
        shape = np.ceil(extent / size).astype(np.int64) + 2
        origin = low - 0.5 * size
        # a little wider, since the cells of a file's integers are rounded otherwise
        slack = 1e-6 + 1e-14 * np.abs(self.array).max() / size
        spans = [
            np.clip(np.floor((corner - origin) / size + side * slack), 0, shape - 1).astype(np.int32)
            for side, corner in ((-1.0, self._low), (1.0, self._high))
        ]
        counts = np.zeros(int(np.prod(shape)) + 1, np.int64)
        kernels.count_boxes(*spans, shape, counts)
        starts = np.cumsum(counts)
        members = np.zeros(int(starts[-1]), np.int32)
        kernels.list_boxes(*spans, shape, starts[:-1].copy(), members)
        marks = np.packbits(counts[1:] > 0, bitorder="little")
        return origin, 1.0 / size, shape, marks, starts, members
