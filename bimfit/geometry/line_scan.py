"""A line scan: beams, whether or not anything came back.

It lives here because files, the live sensor and the virtual one all make it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bimfit.geometry.pose import Array, transform_points

Ids = NDArray[np.int64]


@dataclass(frozen=True)
class LineScan:
    """Beams of a laser rangefinder in world coordinates.

    Attributes
    ----------
    scan : ndarray, shape (n,), int64
        Which sweep a beam belongs to.
    origins, directions : ndarray, shape (n, 3)
        Where a beam starts, m, and its unit direction.
    ranges : ndarray, shape (n,)
        How far it went, m; NaN where nothing came back.
    source : str
        The file or the sensor that it is from.
    notes : tuple of str
        What a user should know of how it was read.
    extra : mapping of str to ndarray, shape (n,)
        Further columns of the file, such as time or intensity, by name.
    """

    scan: Ids
    origins: Array
    directions: Array
    ranges: Array
    source: str = ""
    notes: tuple[str, ...] = ()
    extra: Mapping[str, NDArray[np.generic]] = field(default_factory=dict)

    @classmethod
    def of(
        cls, scan: ArrayLike, origins: ArrayLike, directions: ArrayLike, ranges: ArrayLike, source: str = ""
    ) -> LineScan:
        """Make a scan from anything array-like; infinite ranges become NaN.

        Raises
        ------
        ValueError
            When the shapes do not belong together.
        """
        ids = np.ascontiguousarray(scan, np.int64).reshape(-1)
        o = np.ascontiguousarray(np.asarray(origins, np.float64).reshape(-1, 3))
        d = np.ascontiguousarray(np.asarray(directions, np.float64).reshape(-1, 3))
        r = np.array(ranges, np.float64).reshape(-1)
        if not len(ids) == len(o) == len(d) == len(r):
            raise ValueError(
                f"{len(ids)} sweep numbers, {len(o)} origins, {len(d)} directions, {len(r)} ranges"
            )
        r[~np.isfinite(r)] = np.nan
        return cls(ids, o, d, r, source)

    def __len__(self) -> int:
        return len(self.scan)

    @property
    def returned(self) -> NDArray[np.bool_]:
        """Which beams came back, shape (n,)."""
        return np.isfinite(self.ranges)

    @cached_property
    def sweeps(self) -> Ids:
        """The numbers of the sweeps, ascending, shape (k,)."""
        return np.unique(self.scan)

    @property
    def hits(self) -> Array:
        """Where the beams that came back ended, shape (m, 3)."""
        k = self.returned
        return np.asarray(self.origins[k] + self.directions[k] * self.ranges[k, None])

    @cached_property
    def bounds(self) -> Array:
        """Least and greatest corner of what was hit, shape (2, 3); NaN where nothing was."""
        points = self.hits
        if not len(points):
            return np.full((2, 3), np.nan)
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def split(self) -> Iterator[LineScan]:
        """Every sweep as a scan of its own, in the order of their numbers."""
        order = np.argsort(self.scan, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(self.scan[order])) + 1) if len(order) else ():
            yield self.taken(rows)

    def taken(self, rows: Ids) -> LineScan:
        """Some of the beams, by their places (k,)."""
        return replace(
            self,
            scan=self.scan[rows],
            origins=self.origins[rows],
            directions=self.directions[rows],
            ranges=self.ranges[rows],
            extra={name: column[rows] for name, column in self.extra.items()},
        )

    def transformed(self, T: ArrayLike) -> LineScan:
        """The scan moved by a rigid 4 x 4 matrix, such as T_world_scanner."""
        m = np.asarray(T, float)
        return replace(
            self,
            origins=transform_points(m, self.origins),
            directions=np.asarray(self.directions @ m[:3, :3].T),
        )

    def laid_out(self, poses: Array) -> LineScan:
        """A scan in a moving sensor's own coordinates, laid out in the world by one pose a beam.

        Parameters
        ----------
        poses : ndarray, shape (n, 4, 4)
            T_world_sensor while each beam was measured.
        """
        turns = poses[:, :3, :3]
        return replace(
            self,
            origins=np.einsum("nij,nj->ni", turns, self.origins) + poses[:, :3, 3],
            directions=np.einsum("nij,nj->ni", turns, self.directions),
        )


def joined(scans: Sequence[LineScan], source: str = "") -> LineScan:
    """One scan out of several, the sweeps numbered on from one to the next, starting at 0."""
    numbers, start = [], 0
    for scan in scans:
        _, index = np.unique(scan.scan, return_inverse=True)
        numbers.append(index.reshape(-1).astype(np.int64) + start)
        start += len(scan.sweeps)
    if not scans:
        return LineScan.of([], [], [], [], source)
    return LineScan(
        np.concatenate(numbers),
        np.concatenate([s.origins for s in scans]),
        np.concatenate([s.directions for s in scans]),
        np.concatenate([s.ranges for s in scans]),
        source,
        tuple(dict.fromkeys(note for s in scans for note in s.notes)),
    )


def continued(pieces: Sequence[LineScan]) -> LineScan:
    """Pieces of one line scan, at least one, whose sweeps are numbered for the whole of it."""
    first = pieces[0]
    extra = {
        name: np.concatenate([piece.extra[name] for piece in pieces])
        for name in first.extra
        if all(name in piece.extra for piece in pieces)
    }
    return LineScan(
        np.concatenate([piece.scan for piece in pieces]),
        np.concatenate([piece.origins for piece in pieces]),
        np.concatenate([piece.directions for piece in pieces]),
        np.concatenate([piece.ranges for piece in pieces]),
        first.source,
        tuple(dict.fromkeys(note for piece in pieces for note in piece.notes)),
        extra,
    )
