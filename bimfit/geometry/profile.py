"""The cross-section of one component."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bimfit.geometry.pose import Array, Pose2D

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Profile:
    """A component cut by a section plane: closed loops in section coordinates.

    Material lies to the left of every edge: outer loops run counter-clockwise, holes clockwise.

    Attributes
    ----------
    loops : tuple of ndarray, shape (k, 2)
        Vertices (u, v) in metres; the last joins the first without being repeated.
    guessed_length : float
        Length of boundary that closes a hole in an open mesh and is a guess, m.
    artificial : tuple of ndarray of bool, shape (k,)
        A loop each: which of its edges are no surface of the component, because they close an open mesh or
        come from clipping. Empty where there are none.
    """

    loops: tuple[Array, ...]
    guessed_length: float = 0.0
    artificial: tuple[Mask, ...] = ()

    @classmethod
    def polygon(cls, vertices: ArrayLike, *, holes: Sequence[ArrayLike] = ()) -> Profile:
        """Make a profile from one outer loop and its holes, in any winding."""
        outer = _wound(np.asarray(vertices, float), counter_clockwise=True)
        inner = tuple(_wound(np.asarray(h, float), counter_clockwise=False) for h in holes)
        return cls((outer, *inner))

    @property
    def empty(self) -> bool:
        """Whether the section plane misses the component."""
        return not self.loops

    @cached_property
    def edges(self) -> Array:
        """Directed edges, shape (n, 2, 2): edge, end, coordinate."""
        if not self.loops:
            return np.zeros((0, 2, 2))
        ends = [np.concatenate([loop[1:], loop[:1]]) for loop in self.loops]
        return np.stack([np.concatenate(self.loops), np.concatenate(ends)], axis=1)

    @cached_property
    def normals(self) -> Array:
        """Outward unit normals of ``edges``, shape (n, 2)."""
        d = self.edges[:, 1] - self.edges[:, 0]
        size = np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-300)
        return np.asarray(np.stack([d[:, 1], -d[:, 0]], axis=1) / size)

    @cached_property
    def rows(self) -> Array:
        """Ends and outward unit normal of every edge, shape (n, 6), as kernels take them; never changed."""
        return np.ascontiguousarray(np.concatenate([self.edges.reshape(-1, 4), self.normals], axis=1))

    @cached_property
    def surface(self) -> Mask:
        """Which of ``edges`` are surface of the component, shape (n,)."""
        if not self.artificial:
            return np.ones(len(self.edges), bool)
        return ~np.concatenate(self.artificial)

    @property
    def area(self) -> float:
        """Area, m^2; holes count negative."""
        return float(sum(signed_area(loop) for loop in self.loops))

    @property
    def bounds(self) -> Array:
        """Least and greatest (u, v), shape (2, 2)."""
        points = np.concatenate(self.loops)
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def moved(self, pose: Pose2D) -> Profile:
        """The profile after a rigid motion of the section plane."""
        return Profile(tuple(pose.apply(loop) for loop in self.loops), self.guessed_length, self.artificial)


def signed_area(loop: ArrayLike) -> float:
    """Shoelace area of a closed loop (k, 2): positive when counter-clockwise."""
    p = np.asarray(loop, float)
    if len(p) < 3:
        return 0.0
    x, y = (p - p[0]).T
    # about the first vertex, so that the closing edge adds nothing and map coordinates cancel
    return float(0.5 * (np.dot(x[:-1], y[1:]) - np.dot(y[:-1], x[1:])))


def _wound(loop: Array, *, counter_clockwise: bool) -> Array:
    if loop.ndim != 2 or loop.shape[1] != 2 or len(loop) < 3:
        raise ValueError(f"a loop is an array of at least three (u, v) rows, got shape {loop.shape}")
    if np.array_equal(loop[0], loop[-1]):
        loop = loop[:-1]
    return loop if (signed_area(loop) > 0.0) == counter_clockwise else loop[::-1].copy()
