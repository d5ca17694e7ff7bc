"""A joint as designed, cut at one station."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.pose import Array
from bimfit.geometry.profile import Profile


@dataclass(frozen=True)
class GapOutline:
    """The two sides of a designed gap, in section coordinates.

    Each chain follows a component's boundary along the gap from its mouth corner (first row) to its root
    corner (last row). The chains belong to their components: as built, each moves with its own.

    Attributes
    ----------
    side_a, side_b : ndarray, shape (k, 2) and (m, 2)
        Vertices (u, v), m; at least two rows each.
    """

    side_a: Array
    side_b: Array

    @property
    def mouth(self) -> tuple[Array, Array]:
        """The mouth corners of A and B."""
        return self.side_a[0], self.side_b[0]

    @property
    def root(self) -> tuple[Array, Array]:
        """The root corners of A and B."""
        return self.side_a[-1], self.side_b[-1]

    @cached_property
    def width(self) -> float:
        """Designed width between the mouth corners, m."""
        a, b = self.mouth
        return math.hypot(b[0] - a[0], b[1] - a[1])

    @cached_property
    def corners(self) -> Array:
        """The mouth corners of A and B, shape (2, 2); never changed."""
        return np.array([self.side_a[0], self.side_b[0]], np.float64)


@dataclass(frozen=True)
class JointSection:
    """A joint's design at one station: what matching, estimation, gap and simulation all start from.

    Attributes
    ----------
    s : float
        Distance along the joint, m.
    frame : SectionFrame
        Its origin is midway between the designed mouth corners.
    components : tuple of two Profile
        Cross-sections of A and B in ``frame``.
    gap : GapOutline
        The designed gap in ``frame``.
    """

    s: float
    frame: SectionFrame
    components: tuple[Profile, Profile]
    gap: GapOutline
