"""The lattice that a search runs over: Eq. 1, 2 and 4 of the paper, an axis each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bimfit.config import SearchConfig
from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array

Integers = NDArray[np.int64]
T = TypeVar("T")
MAX_COUNT = 1 << 20  # a node's code holds 20 bits an index


@dataclass(frozen=True)
class Lattice:
    """Poses tried, as motions of the *data* about a pivot: axes u, v (m) and theta (rad).

    An axis of full width w is cut into c = s^L intervals of q = w / c; the poses are their centres.

    Attributes
    ----------
    half : tuple of 3 float
        Half window.
    step : tuple of 3 float
        q (Eq. 4); where the window is narrower than the tolerance there is one pose, and the step only
        sets the table's cell.
    tests, levels : tuple of 3 int
        s and L (Eq. 2).
    wait : tuple of 3 int
        Levels, counted from the leaves, at which an axis is not split yet. Where one step turns the data
        by more cells than one step shifts it, theta waits: a node is then about as wide in every direction.
    """

    half: tuple[float, float, float]
    step: tuple[float, float, float]
    tests: tuple[int, int, int]
    levels: tuple[int, int, int]
    wait: tuple[int, int, int] = (0, 0, 0)

    @classmethod
    def of(cls, config: SearchConfig) -> Lattice:
        """Derive the lattice from windows, tolerances, s and L.

        Raises
        ------
        ConfigError
            When an axis would need more than a million poses.
        """
        tests, levels, steps = [], [], []
        for axis in range(3):
            width, tolerance = 2.0 * config.window[axis], config.tolerance[axis]
            s = config.axis_tests[axis] if config.axis_tests else config.tests_per_level
            asked = config.axis_levels[axis] if config.axis_levels else config.levels
            ratio = width / tolerance  # Eq. 1
            if ratio <= 1.0:
                level = 0
            elif asked is None:
                level = math.ceil(math.log(ratio) / math.log(s) - 1e-9)  # Eq. 2
            else:
                level = asked
                if not config.axis_tests:
                    s = max(2, math.ceil(ratio ** (1.0 / asked) - 1e-9))
            if s**level > MAX_COUNT:
                raise ConfigError(
                    f"a window of {width:g} at a tolerance of {tolerance:g} needs {s**level} poses",
                    remedy="narrow the window or loosen the tolerance",
                )
            tests.append(s)
            levels.append(level)
            steps.append(width / s**level if level else tolerance)  # Eq. 3 and 4
        return cls(_three(config.window), _three(steps), _three(tests), _three(levels))

    @cached_property
    def count(self) -> tuple[int, int, int]:
        """Poses an axis, c (Eq. 3)."""
        return _three([s**level for s, level in zip(self.tests, self.levels, strict=True)])

    @cached_property
    def first(self) -> tuple[float, float, float]:
        """The motion of index 0 on each axis."""
        return _three([-0.5 * q * (c - 1) for q, c in zip(self.step, self.count, strict=True)])

    @cached_property
    def top(self) -> int:
        """Levels above the leaves."""
        return max(n + o for n, o in zip(self.levels, self.wait, strict=True))

    @cached_property
    def size(self) -> Integers:
        """Leaves an axis in a node of each level, shape (top + 1, 3)."""
        return np.array(
            [
                [
                    s ** min(max(h - o, 0), n)
                    for s, n, o in zip(self.tests, self.levels, self.wait, strict=True)
                ]
                for h in range(self.top + 1)
            ],
            np.int64,
        ).reshape(-1, 3)

    @cached_property
    def nodes(self) -> Integers:
        """Nodes an axis on each level, shape (top + 1, 3)."""
        return np.asarray(np.array(self.count, np.int64)[None, :] // self.size)

    @cached_property
    def angles(self) -> Array:
        """Every angle of the lattice, rad."""
        return np.asarray(self.first[2] + self.step[2] * np.arange(self.count[2]), np.float64)

    @cached_property
    def half_angle(self) -> Array:
        """Half a node's angle on each level, seen from its middle leaf, rad; shape (top + 1,)."""
        half: Array = np.multiply(self.size[:, 2] // 2, self.step[2], dtype=np.float64)
        return half

    def balanced(self, arm: float) -> Lattice:
        """The same poses, theta waiting until a node turns points at ``arm`` (m) as far as it shifts them."""
        if min(self.levels) == 0:
            return self
        ratio = arm * self.step[2] / min(self.step[:2])
        wait = max(0, round(math.log(max(ratio, 1e-9)) / math.log(self.tests[2])))
        return replace(self, wait=(0, 0, min(wait, max(self.levels[:2]))))

    def motion(self, index: tuple[int, int, int]) -> tuple[float, float, float]:
        """The motion (u, v, theta) of a leaf."""
        return _three([f + q * i for f, q, i in zip(self.first, self.step, index, strict=True)])

    def nearest(self, motion: tuple[float, float, float]) -> tuple[int, int, int] | None:
        """The leaf nearest to a motion, or None outside the window."""
        index = [round((m - f) / q) for m, f, q in zip(motion, self.first, self.step, strict=True)]
        if any(i < 0 or i >= c for i, c in zip(index, self.count, strict=True)):
            return None
        return index[0], index[1], index[2]


def _three(values: Sequence[T]) -> tuple[T, T, T]:
    a, b, c = values
    return a, b, c
