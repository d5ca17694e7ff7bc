"""Coordinate frames that move against one another, as ROS records them (tf): chained and interpolated."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bimfit.geometry.pose import Array

Times = NDArray[np.int64]
Sample = tuple[int, str, str, tuple[float, ...], tuple[float, ...]]
"""Time (ns), parent, child, translation (x, y, z), rotation (x, y, z, w)."""

_SECOND = 1e-9


@dataclass(frozen=True)
class Edge:
    """Where a frame is in its parent.

    Attributes
    ----------
    parent, child : str
    times : ndarray, shape (n,)
        ns, ascending.
    shifts, turns : ndarray, shape (n, 3) and (n, 4)
        m, and unit quaternions (x, y, z, w).
    fixed : bool
        Whether it never moves; then there is one row.
    """

    parent: str
    child: str
    times: Times
    shifts: Array
    turns: Array
    fixed: bool

    def poses(self, times: Times) -> tuple[Array, NDArray[np.bool_]]:
        """T_parent_child at ``times`` (m,), shape (m, 4, 4), and which of them lie within what was recorded.

        A time beyond either end by no more than the usual interval takes the pose at that end.
        """
        from scipy.spatial.transform import Rotation, Slerp

        out = np.tile(np.eye(4), (len(times), 1, 1))
        if self.fixed or len(self.times) == 1:
            out[:, :3, :3] = Rotation.from_quat(self.turns[0]).as_matrix()
            out[:, :3, 3] = self.shifts[0]
            return out, np.ones(len(times), bool)
        slack = int(np.median(np.diff(self.times)))
        known = (times >= self.times[0] - slack) & (times <= self.times[-1] + slack)
        # seconds since the first, so that a float64 holds them to the nanosecond
        at = (np.clip(times, self.times[0], self.times[-1]) - self.times[0]) * _SECOND
        grid = (self.times - self.times[0]) * _SECOND
        out[:, :3, :3] = Slerp(grid, Rotation.from_quat(self.turns))(at).as_matrix()
        for axis in range(3):
            out[:, axis, 3] = np.interp(at, grid, self.shifts[:, axis])
        return out, known


class Frames:
    """All frames of a recording.

    Parameters
    ----------
    fixed, moving : iterable of Sample
        From ``tf_static`` and ``tf``. What is no rigid motion is left out.
    """

    def __init__(self, fixed: Iterable[Sample], moving: Iterable[Sample]) -> None:
        self._edges: dict[str, Edge] = {}
        for samples, still in ((moving, False), (fixed, True)):
            of_child: dict[str, list[Sample]] = {}
            for sample in samples:
                if _usable(sample):
                    of_child.setdefault(sample[2], []).append(sample)
            for child, rows in of_child.items():
                self._edges[child] = _edge(rows, still)

    def chain(self, frame: str, base: str = "") -> list[Edge] | None:
        """Edges from a frame up to ``base``, or as far up as they go; None where ``base`` is not above it."""
        out: list[Edge] = []
        seen = {frame}
        while frame != base and frame in self._edges:
            edge = self._edges[frame]
            if edge.parent in seen:  # frames that hang on one another
                break
            seen.add(edge.parent)
            out.append(edge)
            frame = edge.parent
        return None if base and frame != base else out

    @property
    def names(self) -> list[str]:
        """Every frame's name, sorted."""
        return sorted({name for edge in self._edges.values() for name in (edge.parent, edge.child)})


def chained(edges: Sequence[Edge], times: Times) -> tuple[Array, NDArray[np.bool_]]:
    """T_base_frame along a chain at ``times`` (m,), shape (m, 4, 4), and which are known throughout."""
    T = np.tile(np.eye(4), (len(times), 1, 1))
    known = np.ones(len(times), bool)
    for edge in edges:
        up, there = edge.poses(times)
        T = up @ T
        known &= there
    return T, known


def _usable(sample: Sample) -> bool:
    numbers = np.array([*sample[3], *sample[4]])
    return bool(
        len(numbers) == 7
        and np.isfinite(numbers).all()
        and (np.abs(numbers) < 1e12).all()
        and 0.9 < float(np.linalg.norm(numbers[3:])) < 1.1
    )


def _edge(rows: list[Sample], still: bool) -> Edge:
    parent = rows[-1][1]  # a frame that changed hands belongs to whom it was given last
    rows = [row for row in rows if row[1] == parent]
    if still:
        rows = rows[-1:]
    times = np.array([row[0] for row in rows], np.int64)
    times, first = np.unique(times, return_index=True)
    shifts = np.array([rows[k][3] for k in first.tolist()], np.float64)
    turns = np.array([rows[k][4] for k in first.tolist()], np.float64)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return Edge(parent, rows[0][2], times, shifts, turns, still)
