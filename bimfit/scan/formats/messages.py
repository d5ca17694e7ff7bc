"""LaserScan and PointCloud2 messages of ROS, in the sensor's own coordinates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.cloud import PointCloud, usable
from bimfit.scan.formats.frames import Times
from bimfit.scan.formats.packed import cloud_of

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_OFFSETS = ("t", "time", "time_offset")
"""Fields that tell when a point was measured after the message's stamp: whole numbers are ns, decimals s."""
_LONGEST = 10_000_000_000
"""A message's points lie within 10 s."""


def beams_of_message(message: Any, stamp: int, number: int) -> tuple[LineScan, Times]:
    """A LaserScan as beams from the origin, x ahead and z up, and when each was measured (ns).

    Ranges that are infinite, not numbers, or not between ``range_min`` and ``range_max`` are beams that did
    not come back. ``time`` and ``intensity`` are further columns.

    Parameters
    ----------
    message : sensor_msgs/LaserScan
    stamp : int
        Of the first beam, ns.
    number : int
        Of the sweep.
    """
    ranges = np.asarray(message.ranges, np.float64)
    count = len(ranges)
    k = np.arange(count)
    first, step = float(message.angle_min), float(message.angle_increment)
    if not (np.isfinite(first) and np.isfinite(step) and abs(first) < 1e3 and abs(step) < 1e3):
        raise ValueError("a LaserScan without angles")
    # single precision has rounded the step; the two ends say what it was, if they hold together
    last = float(message.angle_max)
    if count > 1 and abs(last - first - (count - 1) * step) < 0.25 * abs(step):
        step = (last - first) / (count - 1)
    angle = first + k * step
    low, high = float(message.range_min), float(message.range_max)
    with np.errstate(invalid="ignore"):
        good = np.isfinite(ranges) & (ranges >= low) & (ranges > 0.0) & ((ranges <= high) | ~(high > 0.0))
    scan = LineScan.of(
        np.full(count, number),
        np.zeros((count, 3)),
        np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1),
        np.where(good, ranges, np.nan),
    )
    pace = float(message.time_increment)
    pace = pace if np.isfinite(pace) and abs(pace) * count < 10.0 else 0.0
    times = stamp + np.round(k * (pace * 1e9)).astype(np.int64)
    extra: dict[str, NDArray[np.generic]] = {"time": times * 1e-9}
    bright = np.asarray(message.intensities, np.float64)
    if len(bright) == count and count:
        extra["intensity"] = bright
    return replace(scan, extra=extra), times


def points_of_message(path: Path, message: Any, stamp: int) -> tuple[PointCloud, Times | None]:
    """The points of a PointCloud2, those without coordinates left out, and when each was measured.

    Parameters
    ----------
    path : Path
        For messages.
    message : sensor_msgs/PointCloud2
    stamp : int
        ns.

    Returns
    -------
    cloud : PointCloud
        Empty where the message holds nothing.
    times : ndarray, shape (n,), or None
        ns, where the points know.
    """
    columns = _columns(path, message)
    points = np.stack([columns[name].astype(np.float64) for name in ("x", "y", "z")], axis=1)
    keep = usable(points) & (points != 0.0).any(axis=1)
    if not keep.any():
        return PointCloud(np.zeros((0, 3))), None
    columns = {name: values[keep] for name, values in columns.items()}
    times = _times(columns, stamp)
    cloud = cloud_of(path, columns, None)
    return cloud, times


def _columns(path: Path, message: Any) -> dict[str, NDArray[Any]]:
    """The message's fields of one number a point."""
    order = ">" if message.is_bigendian else "<"
    width, height, step = int(message.width), int(message.height), int(message.point_step)
    row = int(message.row_step) if height > 1 else width * step
    data = np.asarray(message.data, np.uint8)
    if width * height and (step <= 0 or row < width * step or (height - 1) * row + width * step > len(data)):
        raise ScanError("a PointCloud2 is cut short", file=path)
    fields = {}
    for field in message.fields:
        kind, offset = _KINDS.get(int(field.datatype)), int(field.offset)
        if kind and int(field.count) <= 1 and offset + np.dtype(kind).itemsize <= step:
            fields[str(field.name)] = (order + kind, offset)
    if not {"x", "y", "z"} <= fields.keys():
        raise ScanError("a PointCloud2 without x, y and z", file=path)
    layout = np.dtype(
        {
            "names": list(fields),
            "formats": [kind for kind, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": step,
        }
    )
    if not width * height:
        return {name: np.zeros(0, layout[name].newbyteorder("=")) for name in fields}
    rows = np.lib.stride_tricks.as_strided(
        data, (height, width * step), (row * data.strides[0], data.strides[0]), writeable=False
    )
    table = np.ascontiguousarray(rows).reshape(-1).view(layout)
    return {name: table[name].astype(layout[name].newbyteorder("=")) for name in fields}


def _times(columns: dict[str, NDArray[Any]], stamp: int) -> Times | None:
    """When each point was measured, ns; None where they do not say, or cannot be right."""
    name = next((name for name in _OFFSETS if name in columns), "")
    if name:
        values = columns[name]
        after = values.astype(np.float64) * (1e9 if values.dtype.kind == "f" else 1.0)
    elif "timestamp" in columns:
        values = columns["timestamp"].astype(np.float64)
        after = np.asarray(values * (1.0 if np.median(values) > 1e14 else 1e9) - stamp)
    else:
        return None
    if not (np.abs(after) < _LONGEST).all():
        return None
    return stamp + np.round(after).astype(np.int64)
