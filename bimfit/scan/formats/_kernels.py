"""Decimal numbers out of delimited text, correctly rounded, at the speed of reading the bytes.

The rounding is that of D. Lemire, Number parsing at a gigabyte per second, Software: Practice and Experience
51 (2021): digits as a whole number, times a 128-bit power of five; the few cases that this does not settle
are left to whoever calls.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit
from bimfit.geometry.pose import Array

Bytes = NDArray[np.uint8]
Words = NDArray[np.uint64]
Ids = NDArray[np.int64]

LEAST, GREATEST = -64, 64
"""Powers of ten beyond these are left to the caller."""
UNEVEN = -1
_LOW = np.uint64(0xFFFFFFFF)
_ONE, _NIL = np.uint64(1), np.uint64(0)
_HALF = np.uint64(32)
_TOP = np.uint64(1 << 63)
_EXACT = np.uint64(1 << 53)
_FRACTION = np.uint64((1 << 52) - 1)
_UNSURE = np.uint64(0x1FF)
_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
_TENS = np.array([10.0**k for k in range(23)])
_MOST_DIGITS = 19


def fives() -> Words:
    """The top 128 bits of 5^q for q from LEAST to GREATEST, rounded up below 0, shape (n, 2): high, low."""
    out = np.empty((GREATEST - LEAST + 1, 2), np.uint64)
    for q in range(LEAST, GREATEST + 1):
        five = 5 ** abs(q)
        if q >= 0:
            value = (
                five << (128 - five.bit_length())
                if five.bit_length() <= 128
                else five >> (five.bit_length() - 128)
            )
        else:
            z = (five - 1).bit_length()
            value = (1 << (z + 127 if q >= -27 else 2 * z + 128)) // five + 1
            value >>= max(value.bit_length() - 128, 0)
        out[q - LEAST] = value >> 64, value & 0xFFFFFFFFFFFFFFFF
    return out


@jit
def _product(a: np.uint64, b: np.uint64) -> tuple[np.uint64, np.uint64]:
    """High and low word of a product."""
    a1, a0, b1, b0 = a >> _HALF, a & _LOW, b >> _HALF, b & _LOW
    low, cross, other = a0 * b0, a1 * b0, a0 * b1
    middle = (low >> _HALF) + (cross & _LOW) + (other & _LOW)
    high = a1 * b1 + (cross >> _HALF) + (other >> _HALF) + (middle >> _HALF)
    return high, (middle << _HALF) | (low & _LOW)


@jit
def _rounded(digits: np.uint64, q: int, powers: Words) -> np.uint64:
    """Bits of the float64 nearest to digits times 10^q; all ones where that is not settled."""
    shift = _NIL
    while digits & _TOP == _NIL:
        digits = digits << _ONE
        shift += _ONE
    high, low = _product(digits, powers[q - LEAST, 0])
    if high & _UNSURE == _UNSURE:
        more, _ = _product(digits, powers[q - LEAST, 1])
        low = low + more
        if low < more:
            high += _ONE
        if low == _ALL:
            return _ALL
    upper = high >> np.uint64(63)
    mantissa = high >> (upper + np.uint64(9))
    exponent = ((217706 * q) >> 16) + 63 + np.int64(upper) - np.int64(shift) + 1023
    if exponent <= 0 or exponent >= 2047:
        return _ALL
    # just between two numbers: the even one
    between = low <= _ONE and -4 <= q <= 23 and mantissa & np.uint64(3) == _ONE
    if between and (mantissa << (upper + np.uint64(9))) == high:
        mantissa = mantissa & ~_ONE
    mantissa = (mantissa + (mantissa & _ONE)) >> _ONE
    if mantissa >= _EXACT:
        mantissa = _EXACT >> _ONE
        exponent += 1
        if exponent >= 2047:
            return _ALL
    return np.uint64((np.uint64(exponent) << np.uint64(52)) | (mantissa & _FRACTION))


@jit
def _is_nan(text: Bytes, start: int, end: int) -> bool:
    return (
        end - start == 3
        and text[start] | 32 == 110
        and text[start + 1] | 32 == 97
        and text[start + 2] | 32 == 110
    )


@jit
def parse_cells(
    text: Bytes, mark: int, width: int, place: Ids, powers: Words, out: Array, bits: Words, odd: Ids
) -> int:
    """Parse the cells of lines that each end in a line feed.

    Parameters
    ----------
    text : ndarray, shape (n,)
    mark : int
        The delimiter; a space stands for any run of spaces and tabs.
    width : int
        Cells a line.
    place : ndarray, shape (width,)
        Where each column goes in ``out``; -1 for those that are not wanted.
    powers : ndarray
        From :func:`fives`.
    out, bits : ndarray, shape (rows, k)
        The same memory as float64 and as uint64. Empty cells become NaN.
    odd : ndarray, shape (rows * k, 3)
        Filled with start, end and place in ``out`` (flat) of the cells that are no plain decimals.

    Returns
    -------
    int
        How many are odd; -1 where lines are uneven, or not as many as ``out`` has rows.
    """
    n, at, row, count = len(text), 0, 0, 0
    blank = mark == 32
    while at < n:
        if row >= out.shape[0]:
            return UNEVEN
        for column in range(width):
            if blank:
                while at < n and (text[at] == 32 or text[at] == 9):
                    at += 1
            start = at
            target = place[column]
            negative, digits, point, whole, places = False, _NIL, False, 0, 0
            if target >= 0:
                if at < n and (text[at] == 45 or text[at] == 43):
                    negative = text[at] == 45
                    at += 1
                while at < n:
                    c = text[at]
                    if 48 <= c <= 57:
                        if whole < _MOST_DIGITS:
                            digits = digits * np.uint64(10) + np.uint64(c - 48)
                        if digits != _NIL or point:
                            whole += 1
                        if point:
                            places += 1
                    elif c == 46 and not point:
                        point = True
                    else:
                        break
                    at += 1
            seen = at - start - (1 if point else 0)
            plain = at
            while at < n and text[at] != mark and text[at] != 10 and not (blank and text[at] == 9):
                at += 1
            end = at
            if at >= n:
                return UNEVEN
            last = column == width - 1
            if blank:
                if end == start:
                    return UNEVEN
                while at < n and (text[at] == 32 or text[at] == 9):
                    at += 1
                if at >= n or (text[at] == 10) != last:
                    return UNEVEN
                if last:
                    at += 1
            else:
                if (text[at] == 10) != last:
                    return UNEVEN
                at += 1
            if target < 0:
                continue
            if end == start or _is_nan(text, start, end):
                out[row, target] = np.nan
                continue
            good = (
                plain == end and seen > (1 if negative or text[start] == 43 else 0) and whole <= _MOST_DIGITS
            )
            if good:
                if digits == _NIL:
                    out[row, target] = -0.0 if negative else 0.0
                    continue
                if digits <= _EXACT and places <= 22:
                    value = np.float64(digits) / _TENS[places]
                    out[row, target] = -value if negative else value
                    continue
                if places <= -LEAST:
                    found = _rounded(digits, -places, powers)
                    if found != _ALL:
                        bits[row, target] = found | _TOP if negative else found
                        continue
            odd[count, 0], odd[count, 1], odd[count, 2] = start, end, row * out.shape[1] + target
            count += 1
        row += 1
    return count if row == out.shape[0] else UNEVEN
