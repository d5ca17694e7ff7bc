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
_GAP_BOXES, _GAP_SHARE, _MOST_GROUPS = 100.0, 0.3, 4
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
        room = np.empty(min(len(x), _BLOCK), np.int64)
        found: list[list[Ids]] = [[] for _ in self._grids]
        for start in range(0, len(x), _BLOCK):
            part = slice(start, start + _BLOCK)
            # what lies side by side in the cache is looked through several times faster
            columns = [np.ascontiguousarray(column[part]) for column in (x, y, z)]
            ends = [end * scale[0] + offset[0] for end in (columns[0].min(), columns[0].max())]
            for grid, its in zip(self._grids, found, strict=True):
                if max(ends) < grid.reach[0] or min(ends) > grid.reach[1]:
                    continue
                slope, shift = scale * grid.per_cell, (offset - grid.origin) * grid.per_cell
                count = kernels.candidates(*columns, slope, shift, grid.shape, grid.marks, room)
                if count:
                    its.append(room[:count] + start)
        indices, cells = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        for grid, its in zip(self._grids, found, strict=True):
            if its:
                index = np.concatenate(its)
                points = np.stack([c[index].astype(np.float64) for c in (x, y, z)], axis=1) * scale + offset
                cell = grid.cells(points)
                indices.append(index[cell >= 0])
                cells.append(cell[cell >= 0])
        index, cell = np.concatenate(indices), np.concatenate(cells)
        if len(indices) > 2:
            order = np.argsort(index, kind="stable")
            index, cell = index[order], cell[order]
        return index, cell

    def cells_of(self, box: Array) -> Ids:
        """Every cell that a box (2, 3) reaches into, shape (m,), ascending."""
        return np.concatenate([grid.reached(box) for grid in self._grids])

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
    def _grids(self) -> tuple[_Grid, ...]:
        """A grid each for groups of boxes far from one another, as in project and map coordinates."""
        grids: list[_Grid] = []
        for group in _groups(self.array):
            first = grids[-1].first + int(np.prod(grids[-1].shape)) if grids else 0
            grids.append(_Grid.of(self.array[group], first))
        return tuple(grids)


@dataclass(frozen=True, eq=False)
class _Grid:
    """A regular grid over boxes.

    Attributes
    ----------
    low, high : ndarray, shape (k, 3)
        The boxes.
    origin : ndarray, shape (3,)
    per_cell : float
        Cells a unit of length.
    shape : ndarray, shape (3,)
    marks : ndarray of uint8
        A bit for each cell that a box reaches into.
    starts, members : ndarray
        The boxes of every cell.
    first : int
        Number of the first cell.
    """

    low: Array
    high: Array
    origin: Array
    per_cell: float
    shape: Ids
    marks: NDArray[np.uint8]
    starts: Ids
    members: NDArray[np.int32]
    first: int

    @classmethod
    def of(cls, boxes: Array, first: int) -> _Grid:
        """Lay a grid over boxes (k, 2, 3)."""
        low, high = np.ascontiguousarray(boxes[:, 0]), np.ascontiguousarray(boxes[:, 1])
        least = low.min(axis=0)
        extent = np.maximum(high.max(axis=0) - least, 1e-12)
        size = max(float(np.median(high - low)) / _CELLS_A_BOX, float(extent.max()) / _MOST_PER_AXIS, 1e-9)
        while np.prod(np.ceil(extent / size) + 2.0) > _MOST_CELLS:
            size *= 1.25
        shape = np.ceil(extent / size).astype(np.int64) + 2
        origin = least - 0.5 * size
        # a little wider, since the cells of a file's integers are rounded otherwise
        slack = 1e-6 + 1e-14 * np.abs(boxes).max() / size
        spans = [
            np.clip(np.floor((corner - origin) / size + side * slack), 0, shape - 1).astype(np.int32)
            for side, corner in ((-1.0, low), (1.0, high))
        ]
        counts = np.zeros(int(np.prod(shape)) + 1, np.int64)
        kernels.count_boxes(*spans, shape, counts)
        starts = np.cumsum(counts)
        members = np.zeros(int(starts[-1]), np.int32)
        kernels.list_boxes(*spans, shape, starts[:-1].copy(), members)
        marks = np.packbits(counts[1:] > 0, bitorder="little")
        return cls(low, high, origin, 1.0 / size, shape, marks, starts, members, first)

    @cached_property
    def reach(self) -> tuple[float, float]:
        """From where to where the grid reaches along x."""
        start = float(self.origin[0])
        return start, start + float(self.shape[0]) / self.per_cell

    def cells(self, points: Array) -> Ids:
        """The cell of every point (n, 3), -1 where it lies in no box; shape (n,)."""
        out = np.empty(len(points), np.int64)
        kernels.cells_inside(
            points,
            self.origin,
            self.per_cell,
            self.shape,
            self.starts,
            self.members,
            self.low,
            self.high,
            out,
        )
        return np.where(out >= 0, out + self.first, -1)

    def reached(self, box: Array) -> Ids:
        """Every cell that a box (2, 3) reaches into, ascending, shape (m,)."""
        low, high = (np.floor((corner - self.origin) * self.per_cell).astype(np.int64) for corner in box)
        low, high = np.clip(low, 0, self.shape), np.clip(high, -1, self.shape - 1)
        i, j, k = (np.arange(a, b + 1) for a, b in zip(low.tolist(), high.tolist(), strict=True))
        cells = (i[:, None, None] * self.shape[1] + j[:, None]) * self.shape[2] + k
        return np.asarray(cells.reshape(-1) + self.first)


def _groups(boxes: Array) -> list[Ids]:
    """Split boxes (k, 2, 3) at gaps that are wide against the boxes and the whole, again and again."""
    todo: list[Ids] = [np.arange(len(boxes))]
    done: list[Ids] = []
    while todo:
        group = todo.pop()
        low, high = boxes[group, 0], boxes[group, 1]
        extent, usual = np.ptp(np.concatenate([low, high]), axis=0), float(np.median(high - low))
        best: tuple[float, Ids, int] | None = None
        for axis in range(3):
            order = np.argsort(low[:, axis], kind="stable")
            gaps = low[order[1:], axis] - np.maximum.accumulate(high[order, axis])[:-1]
            wide = int(np.argmax(gaps)) if len(gaps) else 0
            worth = len(gaps) > 0 and gaps[wide] > max(_GAP_BOXES * usual, _GAP_SHARE * extent[axis])
            if worth and (best is None or gaps[wide] > best[0]):
                best = float(gaps[wide]), order, wide + 1
        if best is None or len(done) + len(todo) >= _MOST_GROUPS - 1:
            done.append(group)
        else:
            todo += [group[best[1][: best[2]]], group[best[1][best[2] :]]]
    return done
