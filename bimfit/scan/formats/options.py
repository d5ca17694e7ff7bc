"""What a user says of a scan file that the file itself may leave open."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bimfit.errors import ScanError
from bimfit.geometry.pose import Array

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "ft": 0.3048, "usft": 1200.0 / 3937.0, "in": 0.0254}
"""Metres a unit of length, by the name that ``--scan-unit`` takes."""
_NAMES = {
    "m": "metres", "mm": "millimetres", "cm": "centimetres", "ft": "feet", "usft": "US survey feet",
    "in": "inches",
}  # fmt: skip


@dataclass(frozen=True)
class ReadOptions:
    """How to read a scan file, where it does not say so itself.

    Attributes
    ----------
    unit : float or None
        Metres a unit of length in the file. None: what the file or its format says, else metres.
    topic : str
        Which topic of a ROS bag; empty takes the only one.
    frame : str
        The frame of a ROS bag in whose coordinates the scan is wanted; empty takes the one above all others.
    pixel : tuple of 3 float or None
        Of height maps and profiles: distance between columns, distance between rows, and height of one
        count, m; None for those that the file names itself. A negative distance mirrors the map.
    boxes : ndarray, shape (k, 2, 3), or None
        Least and greatest corners, m, of the places that matter; formats that have an index leave the rest
        of the file alone. Other formats read everything.
    """

    unit: float | None = None
    topic: str = ""
    frame: str = ""
    pixel: tuple[float | None, float | None, float | None] = (None, None, None)
    boxes: Array | None = None

    def __post_init__(self) -> None:
        if self.unit is not None and not (math.isfinite(self.unit) and self.unit > 0.0):
            raise ScanError(f"a unit must be a positive number of metres, got {self.unit}")
        for size in self.pixel:
            if size is not None and not (math.isfinite(size) and size != 0.0):
                raise ScanError(f"a pixel's sizes must be numbers of metres and not 0, got {size}")
        if self.boxes is not None and np.asarray(self.boxes).shape[1:] != (2, 3):
            raise ScanError("boxes must have the shape (k, 2, 3)")

    def file_boxes(self, unit: float) -> Array | None:
        """The boxes in the file's own unit of length."""
        return None if self.boxes is None else np.asarray(self.boxes, float) / (self.unit or unit)


ANY = ReadOptions()
"""Nothing is said."""


def unit_named(text: str) -> float:
    """Metres a unit of length, from its name.

    Raises
    ------
    ScanError
        Naming the units that are known.
    """
    if text not in UNITS:
        raise ScanError(f"unknown unit {text}", remedy=f"choose from {', '.join(UNITS)}")
    return UNITS[text]


def unit_name(unit: float) -> str:
    """What a unit of so many metres is called."""
    for name, size in UNITS.items():
        if math.isclose(size, unit, rel_tol=1e-9):
            return _NAMES[name]
    return f"units of {unit:g} m"
