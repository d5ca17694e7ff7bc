"""Decimal numbers out of delimited text, whole columns at a time and correctly rounded."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from bimfit.geometry.pose import Array
from bimfit.scan.formats import _kernels as kernels


def parse_columns(block: bytes, mark: int, width: int, wanted: Sequence[int]) -> Array | None:
    """Read columns of decimal numbers.

    Parameters
    ----------
    block : bytes
        Whole lines, each ending in a line feed and with ``width`` cells; none blank.
    mark : int
        The delimiter's byte; a space stands for any run of spaces and tabs.
    width : int
    wanted : sequence of int

    Returns
    -------
    ndarray, shape (lines, len(wanted)), or None
        Empty cells are NaN. None where a cell is no number, or rows are uneven.
    """
    columns = list(dict.fromkeys(wanted))
    place = np.full(width, -1, np.int64)
    place[columns] = np.arange(len(columns))
    out = np.empty((block.count(b"\n"), len(columns)))
    odd = np.empty((out.size, 3), np.int64)
    text = np.frombuffer(block, np.uint8)
    count = kernels.parse_cells(text, mark, width, place, _fives(), out, out.view(np.uint64), odd)
    if count < 0:
        return None
    flat = out.reshape(-1)
    for start, end, where in odd[:count].tolist():
        cell = block[start:end]
        if b"_" in cell:  # which float() takes for part of a number
            return None
        try:
            flat[where] = float(cell)
        except ValueError:
            return None
    return out if columns == list(wanted) else out[:, [columns.index(column) for column in wanted]]


@cache
def _fives() -> kernels.Words:
    return kernels.fives()
