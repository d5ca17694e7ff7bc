"""CARMEN logs: the laser messages of a robot that drives over a floor (http://carmen.sourceforge.net).

Metres and radians. ``FLASER n r1 .. rn x y theta odom_x odom_y odom_theta stamp host logger_stamp`` with the
laser's pose x, y, theta; ``ROBOTLASER1`` also names the laser's field of view and its greatest range.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.cloud import FARTHEST

_LASERS = ("FLASER", "ROBOTLASER1")
_OTHERS = ("RLASER", "ROBOTLASER2", "RAWLASER1", "RAWLASER2", "RAWLASER3", "RAWLASER4", "LASER3", "LASER4")
_KNOWN = (*_LASERS, *_OTHERS, "PARAM", "SYNC", "ODOM", "TRUEPOS", "NEFF")
_HALF_TURN = math.pi
_REPEATED = 20
"""A greatest reading that occurs so often, and is so far beyond the next, means that nothing came back."""
_BEYOND = 1.5
_MOST_READINGS = 100_000


@dataclass(frozen=True)
class _Sweep:
    ranges: Array
    first: float
    step: float
    pose: tuple[float, float, float]
    stamp: float
    greatest: float


def looks_like_carmen(head: bytes) -> bool:
    """Whether the start of a file is a CARMEN log."""
    lines = head[:20_000].split(b"\n")
    words = [line.split(None, 2)[:2] for line in lines if line.strip() and not line.startswith(b"#")]
    names = [word[0].decode("latin-1") for word in words]
    return len(names) > 0 and sum(name in _KNOWN for name in names) > len(names) / 2


def read_carmen(path: Path) -> LineScan:
    """Read the front laser's sweeps, each from its pose in the plane z = 0.

    Readings at the laser's greatest range are beams that did not come back. ``FLASER`` does not name that
    range; there it is the greatest reading of the log, if it is repeated and far beyond all others.

    Raises
    ------
    ScanError
        Naming the line that is cut short or holds something else than numbers; for a log without sweeps.
    """
    sweeps: list[_Sweep] = []
    skipped: Counter[str] = Counter()
    with path.open("rb") as stream:
        for number, line in enumerate(stream, start=1):
            name = line[:12].split(None, 1)[0].decode("latin-1") if line.strip() else ""
            if name in _LASERS:
                sweeps.append(_sweep(path, number, line.decode("latin-1").split()))
            elif name in _OTHERS:
                skipped[name] += 1
    if not sweeps:
        others = f"; it has {', '.join(skipped)}" if skipped else ""
        raise ScanError(f"the log holds no FLASER or ROBOTLASER1 message{others}", file=path)
    scan = _scan(sweeps, str(path))
    notes = [f"{count} {name} messages left out" for name, count in sorted(skipped.items())]
    return replace(scan, notes=(*scan.notes, *notes))


def _sweep(path: Path, number: int, words: list[str]) -> _Sweep:
    place = f"line {number}"
    name = words[0]
    head = 2 if name == "FLASER" else 9
    try:
        settings = [float(word) for word in words[1:head]]
        count = int(words[head - 1])
    except (ValueError, IndexError) as error:
        raise ScanError(f"{name} does not begin with numbers", file=path, place=place) from error
    if not 0 < count <= _MOST_READINGS:
        raise ScanError(f"{name} with {count} readings", file=path, place=place)
    tail = words[head + count :]
    if name == "ROBOTLASER1":
        tail = _without_remissions(tail)
    if len(words) < head + count or len(tail) < 9:
        raise ScanError(f"{name} is cut short: {len(words)} words", file=path, place=place)
    try:
        ranges = np.array(words[head : head + count], np.float64)
        x, y, theta = (float(word) for word in tail[:3])
        stamp = float(tail[-3])
    except ValueError as error:
        raise ScanError(
            f"{name} with something that is no number: {error}", file=path, place=place
        ) from error
    if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST and math.isfinite(theta) and abs(theta) < 1e6):
        raise ScanError(f"{name} from no place in any world", file=path, place=place)
    if name == "FLASER":
        # an odd number of readings has one at both ends of the half turn
        step = _HALF_TURN / (count - 1) if count % 2 and count > 1 else _HALF_TURN / count
        return _Sweep(ranges, -0.5 * _HALF_TURN, step, (x, y, theta), stamp, math.inf)
    first, field, step, greatest = settings[1], settings[2], settings[3], settings[4]
    if not (math.isfinite(first) and 0.0 < field <= 2.1 * math.pi and 0.0 <= step < math.pi):
        raise ScanError("ROBOTLASER1 with a field of view that is none", file=path, place=place)
    step = step or field / max(count - 1, 1)
    return _Sweep(ranges, first, step, (x, y, theta), stamp, greatest if greatest > 0.0 else math.inf)


def _without_remissions(tail: list[str]) -> list[str]:
    """What follows the readings: in later logs a count of remissions and those come first."""
    if tail and tail[0].isdigit():
        rest = tail[1 + int(tail[0]) :]
        if len(rest) in (13, 14):
            return rest
    return tail


def _scan(sweeps: list[_Sweep], source: str) -> LineScan:
    ranges = np.concatenate([sweep.ranges for sweep in sweeps])
    counts = np.array([len(sweep.ranges) for sweep in sweeps])
    number = np.repeat(np.arange(len(sweeps)), counts)
    pose = np.array([sweep.pose for sweep in sweeps])[number]
    within = np.arange(len(ranges)) - np.repeat(np.cumsum(counts) - counts, counts)
    first, step, greatest = (
        np.array([getattr(sweep, name) for sweep in sweeps])[number] for name in ("first", "step", "greatest")
    )
    bearing = pose[:, 2] + first + within * step
    notes = []
    limit = _limit(ranges)
    if np.isinf(greatest).any() and math.isfinite(limit):
        greatest = np.minimum(greatest, limit)
        notes.append(f"readings of {limit:g} m count as nothing came back")
    with np.errstate(invalid="ignore"):
        missing = ~(ranges > 0.0) | (ranges >= greatest) | ~(ranges <= FARTHEST)
    zero = np.zeros(len(ranges))
    scan = LineScan.of(
        number,
        np.stack([pose[:, 0], pose[:, 1], zero], axis=1),
        np.stack([np.cos(bearing), np.sin(bearing), zero], axis=1),
        np.where(missing, np.nan, ranges),
        source,
    )
    stamps = np.array([sweep.stamp for sweep in sweeps])[number]
    return replace(scan, extra={"time": stamps}, notes=tuple(notes))


def _limit(ranges: Array) -> float:
    """The reading that stands for nothing; inf where none does."""
    finite = ranges[np.isfinite(ranges)]
    if not len(finite):
        return math.inf
    top = float(finite.max())
    rest = finite[finite < top]
    repeated = len(finite) - len(rest) >= _REPEATED
    return top if repeated and (not len(rest) or top > _BEYOND * float(rest.max())) else math.inf
