"""What people record with Hokuyo rangefinders: UrgBenri's UBH, and BreezySLAM's tables.

Ranges are millimetres; codes below 20 say why there is none. Both are sweeps in the sensor's own coordinates:
x ahead, y left, z up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.geometry.range_codes import FIRST_MEASUREMENT, counted_reasons
from bimfit.scan.formats.text import read_table

BREEZY_COLUMNS, BREEZY_FIRST = 707, 24
"""BreezySLAM: time (us), a place, wheel ticks, 20 more, 682 ranges, and one that is not used."""
_BREEZY_RANGES = 682
_BREEZY_STEP = 2.0 * math.pi / 1024.0
_BREEZY_AHEAD = 340
"""Steps 44 to 725 of a URG-04LX, which looks ahead at step 384."""
_BREEZY_TURN, _BREEZY_STEPS = 0.1, 1024
_FARTHEST_CODE = 65533
"""What the UTM and UST series send where nothing comes back, and codes beyond it."""
_MOST_VALUES = 100_000


# -- UrgBenri --------------------------------------------------------------------------------------


def looks_like_ubh(head: bytes) -> bool:
    """Whether the start of a file is a UBH log."""
    lines = [line.strip() for line in head[:4000].splitlines() if line.strip()]
    return (
        bool(lines)
        and lines[0].startswith(b"[")
        and any(
            line in (b"[frontStep]", b"[totalSteps]", b"[scanMsec]", b"[captureMode]", b"[scan]")
            for line in lines
        )
    )


@dataclass(frozen=True)
class _Head:
    front: int
    total: int
    start: int
    end: int
    turn: float
    farthest: float


def read_ubh(path: Path) -> LineScan:
    """Read the sweeps of a UBH log; of several echoes, the first. Intensities and codes are kept.

    Raises
    ------
    ScanError
        Naming the line of a value that is none; for a header without its steps, or a log without sweeps.
    """
    settings: dict[str, str] = {}
    head: _Head | None = None
    sweeps: list[tuple[float, Array, Array]] = []
    stamp = math.nan
    for line, key, value in _entries(path):
        if key == "timestamp":
            stamp = _number(path, line, key, value) * 1e-3
        elif key == "scan":
            head = head or _head(path, settings)
            sweeps.append((stamp, *_values(path, line, value)))
        else:
            settings[key] = value
    if head is None:
        raise ScanError("the log holds no [scan]", file=path)
    return _ubh_scan(path, head, sweeps)


def _entries(path: Path) -> Iterator[tuple[int, str, str]]:
    """Line, key and value of every entry."""
    key = ""
    with path.open("rb") as stream:
        for number, raw in enumerate(stream, start=1):
            text = raw.decode("utf-8-sig" if number == 1 else "utf-8", errors="replace").strip()
            if text.startswith("[") and text.endswith("]"):
                key = text[1:-1].strip()
            elif key and text:
                yield number, key, text
                key = ""


def _head(path: Path, settings: dict[str, str]) -> _Head:
    def whole(name: str, default: int | None = None) -> int:
        text = settings.get(name, "" if default is None else str(default))
        try:
            return int(text)
        except ValueError as error:
            raise ScanError(f"the header has no number for [{name}]", file=path) from error

    front, total = whole("frontStep"), whole("totalSteps")
    start, end = whole("startStep"), whole("endStep")
    if not (0 < total <= _MOST_VALUES and 0 <= start <= end <= 2 * total and 0 <= front <= 2 * total):
        raise ScanError("the header's steps do not hold together", file=path)
    turn = whole("scanMsec", 0) * 1e-3
    farthest = whole("maxDistance", _FARTHEST_CODE - 1)
    return _Head(front, total, start, end, turn, farthest if farthest > 0 else _FARTHEST_CODE - 1)


def _number(path: Path, line: int, key: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise ScanError(f"{text[:40]!r} is no number for [{key}]", file=path, place=f"line {line}") from error
    if not math.isfinite(value):
        raise ScanError(f"{text[:40]!r} is no number for [{key}]", file=path, place=f"line {line}")
    return value


def _values(path: Path, line: int, text: str) -> tuple[Array, Array]:
    """First echoes and their intensities (NaN where there is none), shape (n,) each."""
    cells = text.rstrip(";").split(";")
    if len(cells) > _MOST_VALUES:
        raise ScanError(f"a sweep of {len(cells)} values", file=path, place=f"line {line}")
    first = [cell.split("&", 1)[0] for cell in cells]
    pairs = [cell.partition("|") for cell in first]
    try:
        ranges = np.array([int(near) for near, _, _ in pairs], np.float64)
        bright = np.array([float(more) if more else math.nan for _, _, more in pairs])
    except (ValueError, OverflowError) as error:
        raise ScanError(
            f"[scan] with something that is no number: {error}", file=path, place=f"line {line}"
        ) from error
    return ranges, bright


def _ubh_scan(path: Path, head: _Head, sweeps: list[tuple[float, Array, Array]]) -> LineScan:
    steps, numbers, times = [], [], []
    for number, (stamp, values, _) in enumerate(sweeps):
        step = _steps(path, head, len(values), number)
        steps.append(step)
        numbers.append(np.full(len(values), number))
        times.append(stamp + step / head.total * head.turn)
    codes = np.concatenate([values for _, values, _ in sweeps])
    bright = np.concatenate([values for _, _, values in sweeps])
    extra = {"time": np.concatenate(times), "code": codes}
    if np.isfinite(bright).any():
        extra["intensity"] = bright
    bearing = (np.concatenate(steps) - head.front) * (2.0 * math.pi / head.total)
    return _sweeps(path, np.concatenate(numbers), bearing, codes, head.farthest, extra)


def _steps(path: Path, head: _Head, count: int, sweep: int) -> Array:
    """The middle step of each of ``count`` values; several steps may be merged to one value."""
    steps = head.end - head.start + 1
    cluster = -(-steps // count)
    if -(-steps // cluster) != count:
        raise ScanError(
            f"{count} values for the steps {head.start} to {head.end}", file=path, place=f"sweep {sweep + 1}"
        )
    low = head.start + cluster * np.arange(count)
    return np.asarray(0.5 * (low + np.minimum(low + cluster - 1, head.end)))


# -- BreezySLAM ------------------------------------------------------------------------------------


def looks_like_breezy(head: bytes) -> bool:
    """Whether the start of a file is a BreezySLAM table."""
    line, _, rest = head.partition(b"\n")
    words = line.split()
    return (
        bool(rest)
        and len(words) == BREEZY_COLUMNS
        and all(word.lstrip(b"-").replace(b".", b"", 1).isdigit() for word in words)
    )


def read_breezy(path: Path) -> LineScan:
    """Read a BreezySLAM table: a sweep of 682 ranges of a URG-04LX a line.

    The wheels' ticks are no pose; the sweeps stay in the sensor's own coordinates.

    Raises
    ------
    ScanError
        Naming line and column of what is no number, or a row of another length.
    """
    names = [f"{k + 1}" for k in range(BREEZY_COLUMNS)]
    wanted = [0, *range(BREEZY_FIRST, BREEZY_FIRST + _BREEZY_RANGES)]
    table = read_table(path, 0, " ", names, wanted)
    if not len(table):
        raise ScanError("the file holds no sweep", file=path)
    codes = table[:, 1:].reshape(-1)
    k = np.tile(np.arange(_BREEZY_RANGES), len(table))
    number = np.repeat(np.arange(len(table)), _BREEZY_RANGES)
    bearing = (k - _BREEZY_AHEAD) * _BREEZY_STEP
    # a stamp is that of step 0, as the device's own is, and a turn takes a tenth of a second
    delay = (k + 44) / _BREEZY_STEPS * _BREEZY_TURN
    extra = {"time": table[number, 0] * 1e-6 + delay, "code": codes}
    return _sweeps(path, number, bearing, codes, float(_FARTHEST_CODE - 1), extra)


# -- both ------------------------------------------------------------------------------------------


def _sweeps(
    path: Path,
    number: NDArray[np.int64],
    bearing: NDArray[np.floating],
    codes: Array,
    farthest: float,
    extra: dict[str, Array],
) -> LineScan:
    """Sweeps in the sensor's own coordinates, with mm as the unit of length."""
    zero = np.zeros(len(codes))
    hit = (codes >= FIRST_MEASUREMENT) & (codes <= farthest)
    scan = LineScan.of(
        number,
        np.zeros((len(codes), 3)),
        np.stack([np.cos(bearing), np.sin(bearing), zero], axis=1),
        np.where(hit, codes, np.nan),
        str(path),
    )
    why = counted_reasons(codes[~hit & (codes < FIRST_MEASUREMENT)])
    beyond = int((codes > farthest).sum())
    parts = [part for part in (why, f"{beyond:,} beyond the sensor's range" if beyond else "") if part]
    notes = (f"beams without return: {', '.join(parts)}",) if parts else ()
    return LineScan(scan.scan, scan.origins, scan.directions, scan.ranges, scan.source, notes, extra)
