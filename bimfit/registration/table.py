"""Look-up tables of a model, and the target that keeps them."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bimfit.config import Bound
from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array
from bimfit.registration import _kernels_table as _kernels
from bimfit.registration._kernels import Model
from bimfit.registration.lattice import Integers, Lattice
from bimfit.registration.levels import (
    MAX_CLASSES,
    classes_of,
    first_level,
    majorant_levels,
    shared_level,
    slacks_of,
)
from bimfit.registration.majorant import majorant_tables

MAX_CELLS = 1 << 26
BLUR_REACH = math.sqrt(2.0 * math.log(2.0 * _kernels.FULL)) * 1.0001  # in sigma: farther, a cell holds 0


@dataclass(frozen=True)
class Tables:
    """Everything that a search reads about the model, for one lattice.

    Attributes
    ----------
    lattice : Lattice
    bound : {"majorant", "overlap", "block"}
    first : int
        The level that a search starts on: all its nodes are bounded.
    origin : ndarray, shape (2,)
        Outer corner of cell (0, 0), m, in the model's frame.
    leaf : ndarray of uint8, shape (rows, columns)
        255 times the blurred surface; row = v, column = u; 0 outside.
    lanes : ndarray of uint64
        ``leaf`` with three neighbours a word, for the kernels.
    blocks, block_place : ndarray
        Block maxima, flat, and where each level's and class's lie.
    quads, quad_place, quad_scale : ndarray
        Quadratic majorants, flat; where each level's lie (offset, rows, columns, log2 of the cells that a
        record serves in u and v, rim in cells in u and v, angles of the levels below; -1 where a level has
        none); and the units of slope and curvature, of a constant, and the greatest sum of a record's terms.
    class_of : ndarray of uint8, shape (levels, slacks)
        Slack class that serves so many cells of slack.
    reach : float
        Largest distance of a point from the pivot that the classes cover, m.
    cosine, sine : ndarray
        Of the lattice's angles.
    seconds : float
        What building took.
    frames : dict
        What ``batch.py`` keeps here, by eps.
    """

    lattice: Lattice
    bound: Bound
    first: int
    origin: Array
    leaf: NDArray[np.uint8]
    lanes: NDArray[np.uint64]
    blocks: NDArray[np.uint8]
    block_place: Integers
    quads: NDArray[np.uint64]
    quad_place: Integers
    quad_scale: Array
    class_of: NDArray[np.uint8]
    reach: float
    cosine: Array
    sine: Array
    seconds: float
    frames: dict[float, Array] = field(default_factory=dict, repr=False, compare=False)

    @cached_property
    def model(self) -> Model:
        """What the kernels read of all this."""
        lattice = self.lattice
        slots = np.concatenate([[0], lattice.nodes[:-1, 2].cumsum()]).astype(np.int64)
        return Model(
            self.cosine, self.sine, np.array(lattice.step), lattice.size, lattice.nodes, lattice.half_angle,
            self.lanes, self.blocks, self.block_place, self.quads, self.quad_place, self.quad_scale,
            self.class_of, slots,
        )  # fmt: skip

    @property
    def nbytes(self) -> int:
        """Memory of all tables, bytes."""
        parts = (self.leaf, self.lanes, self.blocks, self.quads, self.class_of, self.cosine, self.sine)
        return int(sum(part.nbytes for part in parts))


def build_tables(edges: Array, blur: float, lattice: Lattice, bound: Bound, reach: float) -> Tables:
    """Rasterise, blur and take the bounds of every level.

    Parameters
    ----------
    edges : ndarray, shape (n, 2, 2)
        Surface pieces, m.
    blur : float
        Standard deviation of the radial Gaussian, m.
    lattice : Lattice
    bound : {"majorant", "overlap", "block"}
        Which bounds to prepare.
    reach : float
        Largest distance of a point from the pivot to provide for, m.

    Raises
    ------
    ConfigError
        When the model is too large for its cells.
    """
    started = time.perf_counter()
    cell = np.array(lattice.step[:2])
    leaf, origin = _leaf(edges, blur, cell, np.array(lattice.half[:2]))
    made = tables_of_leaf(
        leaf, origin, (blur / float(cell.min()), blur / float(cell.max())), lattice, bound, reach
    )
    return replace(made, seconds=time.perf_counter() - started)


def tables_of_leaf(
    leaf: NDArray[np.uint8],
    origin: Array,
    sigma: tuple[float, float],
    lattice: Lattice,
    bound: Bound,
    reach: float,
) -> Tables:
    """Bounds of every level over any leaf table; ``sigma``: blur in cells of the finer and coarser axis."""
    slacks = slacks_of(lattice, min(lattice.step[:2]), reach)
    majorant = majorant_levels(lattice, slacks, sigma[1]) if bound == "majorant" else ()
    first = first_level(lattice, max(majorant, default=1))
    shared = shared_level(lattice, slacks, majorant, sigma[0])
    slacks = [slacks[max(h, shared)] if h in majorant else own for h, own in enumerate(slacks)]
    class_of = classes_of(slacks)
    if bound == "block":
        blocks, block_place = _printed_blocks(leaf, origin, lattice)
    else:
        wanted = {first} | {h - 1 for h in range(2, first + 1) if h not in majorant}
        blocks, block_place = _overlapped_blocks(leaf, lattice, slacks, wanted, first)
    quads, quad_place, quad_scale = majorant_tables(leaf, lattice, slacks, majorant, shared, sigma[0])
    angles = lattice.angles
    return Tables(
        lattice, bound, first, origin, leaf, _kernels.lane_table(leaf), blocks, block_place, quads,
        quad_place, quad_scale, class_of, reach, np.cos(angles), np.sin(angles), 0.0,
    )  # fmt: skip


def _leaf(edges: Array, blur: float, cell: Array, half: Array) -> tuple[NDArray[np.uint8], Array]:
    margin = BLUR_REACH * blur + cell
    low, high = edges.min(axis=(0, 1)) - margin, edges.max(axis=(0, 1)) + margin
    # whole cells from the window's low corner, so that every table of a lattice shares its grid
    origin = -half + np.floor((low + half) / cell) * cell
    width, height = (int(x) for x in np.ceil((high - origin) / cell))
    if width * height > MAX_CELLS:
        raise ConfigError(
            f"a look-up table of {width} x {height} cells is too large",
            remedy="loosen the tolerance or shorten the reach of the cross-section",
        )
    table = _kernels.raster(
        np.ascontiguousarray(edges, np.float64), blur, origin[0], origin[1], cell[0], cell[1], height, width
    )
    return table, origin


def _overlapped_blocks(
    leaf: NDArray[np.uint8], lattice: Lattice, slacks: list[Integers], levels: set[int], first: int
) -> tuple[NDArray[np.uint8], Integers]:
    """Block maxima of some levels; rows of the ``first`` end in zeros for all its nodes."""
    height, width = leaf.shape
    place = np.zeros((lattice.top + 1, MAX_CLASSES, 6), np.int64)
    wide = int(lattice.nodes[first, 0])
    parts: list[NDArray[np.uint8]] = [np.zeros(wide, np.uint8)]
    offset = wide
    for level in sorted(levels):
        bu, bv = int(lattice.size[level, 0]), int(lattice.size[level, 1])
        most = int(slacks[level][-1])
        for c, slack in enumerate(slacks[level].tolist()):
            low_u, low_v = -((2 * bu - 2 + slack) // bu), -((2 * bv - 2 + slack) // bv)
            columns = (width - 1 + slack) // bu - low_u + 1
            rows = (height - 1 + slack) // bv - low_v + 1
            rim = _kernels.RIM
            if level == first:  # all classes' rows are as long as those of the greatest slack
                longest = (width - 1 + most) // bu + (2 * bu - 2 + most) // bu + 1
                rim = longest - columns + max(wide, _kernels.RIM)
            out = np.zeros((rows, columns + rim), np.uint8)
            _kernels.block_table(leaf, bu, bv, slack, low_u, low_v, rim, out)
            place[level, c] = offset, rows, columns, low_u, low_v, columns + rim
            parts.append(out.ravel())
            offset += out.size
    parts.append(np.zeros(wide + 2 * _kernels.RIM, np.uint8))
    return np.concatenate(parts), place


def _printed_blocks(
    leaf: NDArray[np.uint8], origin: Array, lattice: Lattice
) -> tuple[NDArray[np.uint8], Integers]:
    """Block maxima of s^h cells, aligned with the window (Eq. 3 to 5); level 0 is the leaf table."""
    height, width = leaf.shape
    shift = aligned(origin, lattice)
    place = np.zeros((lattice.top + 1, 5), np.int64)
    parts: list[NDArray[np.uint8]] = []
    offset = 0
    for level in range(lattice.top + 1):
        bu, bv = int(lattice.size[level, 0]), int(lattice.size[level, 1])
        low_u, low_v = int(shift[0]) // bu, int(shift[1]) // bv
        rows = (int(shift[1]) + height - 1) // bv - low_v + 1
        columns = (int(shift[0]) + width - 1) // bu - low_u + 1
        padded = np.zeros((rows * bv, columns * bu), np.uint8)
        i, j = int(shift[1]) - low_v * bv, int(shift[0]) - low_u * bu
        padded[i : i + height, j : j + width] = leaf
        out = padded.reshape(rows, bv, columns, bu).max(axis=(1, 3))
        place[level] = offset, rows, columns, low_u, low_v
        parts.append(out.ravel())
        offset += out.size
    return np.concatenate(parts), place


def aligned(origin: Array, lattice: Lattice) -> Integers:
    """Cell (u, v) of a table's corner, counted from the window's low corner, where printed blocks begin."""
    cells = (origin + np.array(lattice.half[:2])) / np.array(lattice.step[:2])
    return np.asarray(np.rint(cells), np.int64)


@dataclass(frozen=True, eq=False)
class Target:
    """A model prepared for matching: its visible surface, its blur, and tables built once for each lattice.

    Attributes
    ----------
    edges : ndarray, shape (n, 2, 2)
        Visible surface pieces in the section frame, m (``geometry.visibility.visible_edges``), or all
        edges for the paper's closed outlines.
    blur : float
        Standard deviation of the radial Gaussian about the surface, m.
    kept : dict
        Tables built so far, by lattice and bound; guarded by ``lock``.
    """

    edges: Array
    blur: float
    kept: dict[Any, Any] = field(default_factory=dict, repr=False)
    lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @classmethod
    def of(cls, edges: ArrayLike, blur: float) -> Target:
        """Make a target from anything array-like.

        Raises
        ------
        ConfigError
            When the blur is not positive or a coordinate is not a number.
        """
        pieces = np.ascontiguousarray(np.asarray(edges, np.float64).reshape(-1, 2, 2))
        if not (math.isfinite(blur) and blur > 0.0):
            raise ConfigError(f"blur must be a positive number, got {blur}")
        if not np.all(np.isfinite(pieces)):
            raise ConfigError("the model's edges hold a coordinate that is not a number")
        return cls(pieces, float(blur))

    @cached_property
    def box(self) -> tuple[float, float, float, float]:
        """Least u and v, greatest u and v of the edges, m."""
        low, high = self.edges.min(axis=(0, 1)), self.edges.max(axis=(0, 1))
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    @property
    def empty(self) -> bool:
        """Whether no surface is visible at all."""
        return len(self.edges) == 0

    def cells(self, side_u: float, side_v: float) -> float:
        """About how many cells of those sides (m) a table of the model has."""
        if self.empty:
            return 0.0
        low_u, low_v, high_u, high_v = self.box
        rim = 2.0 * BLUR_REACH * self.blur
        return (high_u - low_u + rim) * (high_v - low_v + rim) / (side_u * side_v)

    def reach(self, reach: float) -> None:
        """Build what points up to ``reach`` (m) from the pivot will need, for every lattice known so far."""
        for key, found in list(self.kept.items()):
            if isinstance(found, Tables):
                lattice, bound, _ = key
                self.tables(lattice, bound, reach)

    def tables(self, lattice: Lattice, bound: Bound, reach: float) -> Tables:
        """Tables for a lattice and for points up to ``reach`` (m) from the pivot; built once and kept.

        They reach as far as the model itself, or a power of 1.5 farther: a slice is given the same ones
        whatever was searched before it.
        """
        low_u, low_v, high_u, high_v = self.box
        own = 0.5 * math.hypot(high_u - low_u, high_v - low_v)
        steps = 0
        while own * 1.5**steps < reach and own > 0.0:
            steps += 1
        key = (lattice, bound, steps if own > 0.0 else reach)
        found: Tables | None = self.kept.get(key)
        if found is None:
            with self.lock:
                found = self.kept.get(key)
                if found is None:
                    farthest = own * 1.5**steps if own > 0.0 else reach
                    found = build_tables(self.edges, self.blur, lattice, bound, farthest)
                    self.kept[key] = found
        return found
