"""Decimal numbers out of delimited text, whole columns at a time and correctly rounded.

NumPy's own reader takes some 4 s for a million beams in full precision. Here eight digits are turned into a
number by three multiplications (Lemire's ``parse_eight_digits_unrolled``) on whole columns; whatever is not a
plain decimal of at most 19 digits goes through ``float``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bimfit.geometry.pose import Array

Ids = NDArray[np.int64]
Words = NDArray[np.uint64]

PIECE = 1 << 22
"""Bytes taken at a time: eight times that is held."""
_PAD = 32
_ZEROS = np.uint64(0x3030303030303030)
_MOST_DIGITS = 19
_EXACT = np.uint64(1 << 53)
_WIDE = np.finfo(np.longdouble).nmant >= 63


def parse_columns(block: bytes, mark: int, width: int, wanted: Sequence[int]) -> Array | None:
    """Read columns of decimal numbers.

    Parameters
    ----------
    block : bytes
        Whole lines, each ending in a line feed and with ``width`` cells; none blank.
    mark : int
        The delimiter's byte.
    width : int
    wanted : sequence of int

    Returns
    -------
    ndarray, shape (lines, len(wanted)), or None
        Empty cells are NaN. None where a cell is no number, or rows are uneven.
    """
    parts, at = [], 0
    while at < len(block):
        stop = block.rfind(b"\n", at, at + PIECE) + 1
        if not stop:
            stop = block.find(b"\n", at) + 1
        if not stop:
            return None
        part = _piece(block[at:stop], mark, width, wanted)
        if part is None:
            return None
        parts.append(part)
        at = stop
    return np.concatenate(parts) if parts else np.zeros((0, len(wanted)))


def _piece(block: bytes, mark: int, width: int, wanted: Sequence[int]) -> Array | None:
    length = -(-(len(block) + 2 * _PAD) // 8) * 8
    text = np.full(length + 8, 48, np.uint8)
    text[_PAD : _PAD + len(block)] = np.frombuffer(block, np.uint8)
    marks = np.flatnonzero((text == mark) | (text == 10))
    if len(marks) != width * block.count(b"\n") or np.any(text[marks[width - 1 :: width]] != 10):
        return None  # each line has width cells only if every width-th mark ends a line, and no other does
    starts = np.concatenate([[_PAD], marks[:-1] + 1]).reshape(-1, width)
    ends = marks.reshape(-1, width)
    dots = np.append(np.flatnonzero(text == 46), len(text))
    # the eight bytes from every place of the text, as one little-endian word each
    words = np.ndarray((length,), "<u8", text, strides=(1,)).copy()
    out = np.empty((len(ends), len(wanted)))
    for k, column in enumerate(wanted):
        values = _column(text, words, dots, starts[:, column], ends[:, column])
        if values is None:
            return None
        out[:, k] = values
    return out


def _column(text: NDArray[np.uint8], words: Words, dots: Ids, start: Ids, end: Ids) -> Array | None:
    first = text[start]
    negative = first == 45
    begin = start + (negative | (first == 43))
    dot = np.minimum(dots[np.searchsorted(dots, begin)], end)
    whole = dot - begin
    decimals = np.maximum(end - dot - 1, 0)
    plain = (whole <= 8) & (whole + decimals <= _MOST_DIGITS) & (whole + decimals > 0) & (end > begin)

    number, good = _digits(words, dot, np.clip(whole, 0, 8))
    plain &= good
    shift = np.clip(decimals, 0, _MOST_DIGITS)
    mantissa = number * _POWERS[shift]
    for k, scale in enumerate((1, 10**8, 10**16)):
        if k and not np.any(shift > 8 * k):
            break
        number, good = _digits(words, end - 8 * k, np.clip(shift - 8 * k, 0, 8))
        plain &= good
        mantissa = mantissa + number * np.uint64(scale)
    values, sure = _divided(mantissa, shift)
    values = np.where(negative, -values, values)
    values[end == start] = np.nan
    for row in np.flatnonzero(~(plain & sure) & (end > start)).tolist():
        try:
            values[row] = float(text[start[row] : end[row]].tobytes())
        except ValueError:
            return None
    return values


_POWERS = np.array([10**k for k in range(_MOST_DIGITS + 1)], np.uint64)


def _digits(words: Words, end: Ids, count: Ids) -> tuple[Words, NDArray[np.bool_]]:
    """The number that ``count`` digits (at most 8) before ``end`` make, and whether they are digits."""
    gap = (8 * (8 - count)).astype(np.uint64)
    word = words[end - 8]
    # what stands before the digits becomes zeros
    word = ((word >> gap) << gap) | ~((_ALL >> gap) << gap) & _ZEROS
    high = np.uint64(0xF0F0F0F0F0F0F0F0)
    good = ((word & high) | (((word + np.uint64(0x0606060606060606)) & high) >> np.uint64(4))) == np.uint64(
        0x3333333333333333
    )
    word = word - _ZEROS
    word = word * np.uint64(10) + (word >> np.uint64(8))
    mask = np.uint64(0x000000FF000000FF)
    word = (word & mask) * np.uint64(0x000F424000000064) + ((word >> np.uint64(16)) & mask) * np.uint64(
        0x0000271000000001
    )
    return word >> np.uint64(32), good


_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)


def _divided(mantissa: Words, decimals: Ids) -> tuple[Array, NDArray[np.bool_]]:
    """The quotient mantissa / 10^decimals, correctly rounded, and where that is certain."""
    values = mantissa.astype(np.float64) / _POWERS[decimals].astype(np.float64)
    sure = mantissa <= _EXACT  # then both are exact, and so is the rounding of their quotient
    rest = np.flatnonzero(~sure)
    if len(rest) and _WIDE:
        wide = mantissa[rest].astype(np.longdouble) / _POWERS[decimals[rest]].astype(np.longdouble)
        near = wide.astype(np.float64)
        # Rounding twice differs from rounding once only next to the middle between two float64.
        off = np.abs((wide - near.astype(np.longdouble)).astype(np.float64)) / np.spacing(near)
        values[rest] = near
        sure[rest] = (off < 0.498) & (np.frexp(near)[0] != 0.5)
    return values, sure
