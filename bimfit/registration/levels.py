"""Which levels of a lattice a search uses, which have quadratic bounds, and for how much rotation."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bimfit.registration.lattice import Integers, Lattice

MAX_CLASSES = 6  # slack classes (rings) a level
QUAD_REACH = 3.2  # widest block that a quadratic serves, in sigma; measured
QUAD_SLACK = 6.0  # most slack by rotation in a level that has quadratics, in sigma
QUAD_LOOSE = 2.0  # slack from which on a finer first level, where it is cheap, is better; in sigma, measured
QUAD_EXACT = 0.35  # half a window within which a quadratic is all but exact, in sigma
NOMINAL = 160  # points that the first level is chosen for, so that it depends on the lattice alone
ROOT_COST = 1_200_000.0  # look-ups that bounding the whole first level may cost


def slacks_of(lattice: Lattice, cell: float, reach: float) -> list[Integers]:
    """Cells of slack that each of a level's at most six classes provides for, up to a point at ``reach``."""
    out = []
    for eta in lattice.half_angle:
        most = math.ceil(2.0 * reach * math.sin(0.5 * min(eta, math.pi)) / cell + 1e-9) if eta > 0.0 else 0
        if most < MAX_CLASSES:
            out.append(np.arange(most + 1))
        else:
            out.append(
                np.unique(np.ceil(most * np.arange(1, MAX_CLASSES + 1) / MAX_CLASSES).astype(np.int64))
            )
    return out


def classes_of(slacks: list[Integers]) -> NDArray[np.uint8]:
    """Which of a level's slack classes serves how many cells of slack, shape (levels, slacks)."""
    longest = max(int(s[-1]) for s in slacks)
    out = np.zeros((len(slacks), longest + 1), np.uint8)
    for level, levels in enumerate(slacks):
        out[level] = np.minimum(np.searchsorted(levels, np.arange(longest + 1)), len(levels) - 1)
    return out


def majorant_levels(lattice: Lattice, slacks: list[Integers], sigma: float) -> tuple[int, ...]:
    """Levels whose nodes are split by quadratic majorants: the fine ones, whose blocks lie within the blur.

    Beyond, a block spans so much of the surface that a quadratic gains nothing over a plain maximum.
    """
    widest = lattice.size[:, :2].max(axis=1)
    levels = [
        h
        for h in range(1, lattice.top + 1)
        if float(widest[h]) <= QUAD_REACH * sigma and float(slacks[h][-1]) <= QUAD_SLACK * sigma
    ]
    while len(levels) > 1 and slacks[levels[-1]][-1] > QUAD_LOOSE * sigma and _cheap(lattice, levels[-2]):
        levels.pop()
    return tuple(levels)


def shared_level(lattice: Lattice, slacks: list[Integers], levels: tuple[int, ...], sigma: float) -> int:
    """The coarsest level whose quadratics are all but exact: finer ones look their nodes up in its tables."""
    fine = [h for h in levels if float(lattice.size[h, :2].max() // 2 + slacks[h][-1]) <= QUAD_EXACT * sigma]
    return max(fine, default=0)


def first_level(lattice: Lattice, lowest: int) -> int:
    """The level that a search starts on: the finest from ``lowest`` on whose nodes are all cheap to bound."""
    best = lattice.top
    for level in range(lattice.top, max(lowest, 1) - 1, -1):
        if not _cheap(lattice, level):
            break
        best = level
    return best


def _cheap(lattice: Lattice, level: int) -> bool:
    """Whether all nodes of a level may be bounded."""
    nodes = lattice.nodes[level]
    nu, nv, nt = (float(x) for x in nodes)
    return nt * NOMINAL * min(12.0, nv) * (1.0 + nu / 8.0) <= ROOT_COST
