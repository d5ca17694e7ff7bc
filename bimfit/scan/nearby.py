"""What a scan shows near some places, gathered in one pass over its pieces, in bounded memory."""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bimfit.geometry.line_scan import LineScan, continued
from bimfit.geometry.pose import Array
from bimfit.scan.boxes import Boxes
from bimfit.scan.cloud import PointCloud
from bimfit.scan.grid import Ids

T = TypeVar("T")
Scan = LineScan | PointCloud

MOST_POINTS = 16_000_000
"""More points than this near the places are thinned out: what bounds the memory."""
MOST_BEAMS = 4_000_000
"""Of line scans of more beams, only sweeps that pass near the places are kept."""
_MOST_BOXES = 64
_MIX = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9)
_BOTTOM = 63


@dataclass(frozen=True, eq=False)
class Nearby:
    """The part of a scan that lies near some places.

    Attributes
    ----------
    scan : LineScan or PointCloud
        A line scan is kept whole, or where it is large without the sweeps that pass no place.
    boxes : Boxes
        The places.
    level : int
        Of 2^level points near the places, one was kept.
    cells : ndarray, shape (n,)
        Which cell of the boxes' grid each point of a cloud lies in.
    eyes : tuple of (int, ndarray (3,) or None)
        From which point on a cloud was seen from where.
    """

    scan: Scan
    boxes: Boxes
    level: int = 0
    cells: Ids = field(default_factory=lambda: np.zeros(0, np.int64))
    eyes: tuple[tuple[int, Array | None], ...] = ()

    @property
    def returns(self) -> int:
        """How many returns lie near the places."""
        if isinstance(self.scan, PointCloud):
            return len(self.scan)
        return int(np.count_nonzero(self.boxes.inside(self.scan.hits)))

    def around(self, boxes: Boxes) -> Scan:
        """What lies in some of the boxes, in the file's order; a line scan is given whole.

        A cloud's viewpoint is the one that most of these points were seen from.
        """
        if isinstance(self.scan, LineScan):
            return self.scan
        order, known, starts = self._index
        cells = np.unique(np.concatenate([self.boxes.cells_of(box) for box in boxes.array]))
        at = np.searchsorted(known, cells)
        at = (
            at[(at < len(known)) & (known[np.minimum(at, len(known) - 1)] == cells)] if len(known) else at[:0]
        )
        parts = [order[a:b] for a, b in zip(starts[at].tolist(), starts[at + 1].tolist(), strict=True)]
        index = np.sort(np.concatenate(parts)) if parts else np.zeros(0, np.int64)
        index = index[boxes.inside(self.scan.points[index])]
        return replace(self.scan, points=self.scan.points[index], viewpoint=self._eye(index))

    def _eye(self, index: Ids) -> Array | None:
        """Where most of these points were seen from; None where that is not known."""
        if not self.eyes:
            return None
        starts = np.array([start for start, _ in self.eyes])
        pieces = np.searchsorted(starts, index, side="right") - 1
        votes: dict[tuple[float, ...] | None, int] = {}
        for piece, count in zip(*(x.tolist() for x in np.unique(pieces, return_counts=True)), strict=True):
            eye = self.eyes[piece][1]
            key = None if eye is None else tuple(eye.tolist())
            votes[key] = votes.get(key, 0) + count
        best = max(votes, key=lambda key: votes[key], default=None)
        return None if best is None else np.array(best)

    @cached_property
    def _index(self) -> tuple[Ids, Ids, Ids]:
        """Points by cell, in order within each: (order, cells that hold any, where each begins)."""
        order = np.argsort(self.cells, kind="stable")
        known, starts = np.unique(self.cells[order], return_index=True)
        return order, known, np.append(starts, len(order))


class Gatherer:
    """Keeps what lies near some places of the pieces that it is shown.

    Where more than ``most`` points lie there, every second is dropped, again and again: which ones follows
    from a point's own coordinates in the file, not from the order or the size of the pieces.

    Parameters
    ----------
    boxes : Boxes
        The places, in world coordinates.
    most : int
    most_beams : int
        Of a line scan of more beams, sweeps none of whose beams passes through a place are left out.
    """

    def __init__(self, boxes: Boxes, most: int = MOST_POINTS, most_beams: int = MOST_BEAMS) -> None:
        self.boxes = boxes
        self.most = most
        self.most_beams = most_beams
        self._level = self._count = self._beams = 0
        self._choosy = False
        self._points: list[Array] = []
        self._cells: list[NDArray[np.int32]] = []
        self._ranks: list[NDArray[np.uint8]] = []
        self._eyes: list[Array | None] = []
        self._lines: list[LineScan] = []
        self._notes: dict[str, None] = {}
        self._source = ""

    def add(self, piece: Scan, file_points: Array | None = None) -> None:
        """Take a piece in world coordinates.

        Parameters
        ----------
        piece : LineScan or PointCloud
        file_points : ndarray, shape (n, 3), optional
            Its points as the file has them, where they have been moved since.
        """
        self._source = piece.source
        self._notes.update(dict.fromkeys(piece.notes))
        if isinstance(piece, LineScan):
            self._add_beams(piece)
            return
        index, cell = self.boxes.find(*piece.points.T)
        points = piece.points[index]
        ranks = _ranks(points if file_points is None else file_points[index])
        keep = ranks >= self._level
        self._points.append(points[keep])
        self._cells.append(cell[keep].astype(np.int32))
        self._ranks.append(ranks[keep])
        self._eyes.append(piece.viewpoint)
        self._count += int(keep.sum())
        while self._count > self.most and self._level < _BOTTOM:
            self._thin()

    def _add_beams(self, piece: LineScan) -> None:
        """Keep a piece whole, or once there are many beams only its sweeps that pass near a place."""
        self._beams += len(piece)
        if self._beams <= self.most_beams:
            self._lines.append(piece)
            return
        if not self._choosy:
            self._choosy = True
            self._lines = [passing_sweeps(line, self.boxes) for line in self._lines]
        self._lines.append(passing_sweeps(piece, self.boxes))

    def _thin(self) -> None:
        self._level += 1
        for k, ranks in enumerate(self._ranks):
            keep = ranks >= self._level
            self._points[k], self._cells[k] = self._points[k][keep], self._cells[k][keep]
            self._ranks[k] = ranks[keep]
        self._count = sum(map(len, self._ranks))

    def done(self) -> Nearby:
        """All that was kept; nothing can be added afterwards."""
        notes = tuple(self._notes)
        if self._lines and not self._points:
            scan = self._lines[0] if len(self._lines) == 1 else continued(self._lines)
            if self._choosy:
                notes = (*notes, f"of {self._beams:,} beams, only sweeps that pass near the joints were kept")
            return Nearby(replace(scan, notes=notes), self.boxes)
        for line in self._lines:  # beams amid clouds count as what they hit
            self.add(PointCloud(line.hits, source=line.source))
        starts = np.cumsum([0, *map(len, self._points)]).tolist()
        points = np.empty((starts[-1], 3))
        for k, (start, end) in enumerate(itertools.pairwise(starts)):
            points[start:end] = self._points[k]
            self._points[k] = points[:0]  # so that points are not held twice
        if self._level:
            notes = (
                *notes,
                f"more than {self.most:,} points lie near the joints: one in {2**self._level} was used",
            )
        return Nearby(
            PointCloud(points, source=self._source, notes=notes),
            self.boxes,
            self._level,
            np.concatenate(self._cells).astype(np.int64) if self._cells else np.zeros(0, np.int64),
            _eyes(starts, self._eyes),
        )


def passing_sweeps(scan: LineScan, boxes: Boxes) -> LineScan:
    """The sweeps of which a beam passes through one of the boxes, whether or not anything came back."""
    near = _pass(scan, boxes.bounds)
    if len(boxes) <= _MOST_BOXES:
        rows = np.flatnonzero(near)
        some = scan.taken(rows)
        near[rows] = np.any([_pass(some, box) for box in boxes.array], axis=0)
    return scan.taken(np.flatnonzero(np.isin(scan.scan, np.unique(scan.scan[near]))))


def _pass(scan: LineScan, box: Array) -> NDArray[np.bool_]:
    """Which beams pass through a box (2, 3), shape (n,); one that nothing sent back goes on for ever."""
    first, last = np.zeros(len(scan)), np.where(scan.returned, scan.ranges, np.inf)
    for axis in range(3):
        start, along = scan.origins[:, axis], scan.directions[:, axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (box[0, axis] - start) / along, (box[1, axis] - start) / along
        level = along == 0.0
        inside = (start >= box[0, axis]) & (start <= box[1, axis])
        a = np.where(level, np.where(inside, -np.inf, np.inf), a)
        b = np.where(level, np.inf, b)
        first, last = np.maximum(first, np.minimum(a, b)), np.minimum(last, np.maximum(a, b))
    return np.asarray(first <= last)


def _eyes(starts: list[int], eyes: list[Array | None]) -> tuple[tuple[int, Array | None], ...]:
    return tuple((start, eye) for start, eye in zip(starts, eyes, strict=False))


def _ranks(points: Array) -> NDArray[np.uint8]:
    """How often each point (n, 3) survives halving: leading zeros of a hash of its coordinates."""
    bits = np.ascontiguousarray(points + 0.0).view(np.uint64)
    mixed = np.zeros(len(points), np.uint64)
    for axis, factor in enumerate(_MIX):
        mixed ^= bits[:, axis] * np.uint64(factor)
        mixed ^= mixed >> np.uint64(29)
        mixed *= np.uint64(0xBF58476D1CE4E5B9)
        mixed ^= mixed >> np.uint64(32)
    exponent = np.frexp(mixed.astype(np.float64))[1]
    return np.asarray(np.clip(64 - exponent, 0, _BOTTOM + 1), np.uint8)


def read_ahead(pieces: Iterable[T]) -> Iterator[T]:
    """The same pieces, the next one being read while the last one is looked through.

    Reading waits for discs and unpacks without the interpreter's lock. Errors come out where they belong;
    the reading ends with the one who draws the pieces.
    """
    room: queue.Queue[tuple[bool, T | BaseException | None]] = queue.Queue(maxsize=1)
    stop = threading.Event()

    def put(item: tuple[bool, T | BaseException | None]) -> bool:
        while not stop.is_set():
            try:
                room.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False

    def read() -> None:
        try:
            for piece in pieces:
                if not put((True, piece)):
                    return
            put((False, None))
        except BaseException as error:  # handed over to whoever draws
            put((False, error))

    worker = threading.Thread(target=read, name="read-ahead", daemon=True)
    worker.start()
    try:
        while True:
            more, item = room.get()
            if more:
                yield item  # type: ignore[misc]
            elif isinstance(item, BaseException):
                raise item
            else:
                return
    finally:
        stop.set()
        worker.join()
