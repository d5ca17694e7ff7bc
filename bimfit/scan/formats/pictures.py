"""Height maps: 16-bit PNG or TIFF, NumPy arrays (.npy), and the JSON that SICK's sensors save.

Pixel (row, column) holds a height; the sizes of a pixel come from the file where it has them, else from the
options. In whole numbers 0 is nothing measured; in decimals NaN is, or 0 where there is no NaN at all.
"""

from __future__ import annotations

import base64
import binascii
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.cloud import FARTHEST, PointCloud, usable
from bimfit.scan.formats.heights import beams_of_heights
from bimfit.scan.formats.options import ReadOptions

_SICK_UNIT = 1e-3
_MOST_PIXELS = 200_000_000
_MOST_PACKING = 1100
"""Deflate and LZW make data smaller by this factor at most."""
_PIXEL = "give --pixel ACROSS,ALONG,HEIGHT, such as --pixel 0.1mm,0.1mm,0.005mm"
_NODATA, _SCALE = 42113, 33550  # TIFF tags: GDAL_NODATA, ModelPixelScale
_SICK_TYPES = {
    "uint8": "u1", "int8": "i1", "uint16": "u2", "int16": "i2", "uint32": "u4", "int32": "i4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class _Map:
    """Pixels as stored; their sizes, m, None where the file does not say; and where pixel (0, 0) lies."""

    pixels: NDArray[Any]
    sizes: tuple[float | None, float | None, float | None] = (None, None, None)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    nothing: float | None = None


# -- readers -----------------------------------------------------------------------------------------


def read_png(path: Path, options: ReadOptions) -> LineScan:
    """Read a grey PNG of 16 bits as a height map.

    Raises
    ------
    ScanError
        When it is damaged or no grey picture, or the sizes of its pixels are not given.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=["PNG"]) as picture:
                if not picture.mode.startswith("I"):
                    raise ScanError(
                        f"a picture of kind {picture.mode} is no height map", file=path,
                        remedy="expected one grey channel of 16 bits",
                    )  # fmt: skip
                pixels = np.asarray(picture)
    except ScanError:
        raise
    except Exception as error:
        # Pillow hands on whatever its decoders make of damage: struct, zlib, syntax, value, memory.
        raise ScanError(f"not a PNG picture, or damaged: {error}", file=path) from error
    return _scan(path, _Map(pixels), options)


def read_tiff(path: Path, options: ReadOptions) -> LineScan:
    """Read the first page of a TIFF file as a height map; GeoTIFF names its pixels' sizes.

    Raises
    ------
    ScanError
        When it is damaged or has several channels, the sizes of its pixels are not given, or tifffile is not
        installed.
    """
    try:
        import tifffile
    except ImportError as error:
        raise ScanError(
            "reading TIFF needs the package tifffile", file=path, remedy='pip install "bimfit[tiff]"'
        ) from error
    try:
        with _quiet("tifffile"), tifffile.TiffFile(path) as file:
            page = file.pages.first
            shape, kind = tuple(page.shape), page.dtype
            size = path.stat().st_size
            if kind is None or len(shape) != 2:
                raise ScanError(f"a picture of shape {shape} is no height map", file=path)
            if np.prod(shape, dtype=float) * kind.itemsize > _MOST_PACKING * size or 0 in shape:
                raise ScanError("damaged: its size does not fit its header", file=path)
            _check_size(path, shape)
            tags = {tag.code: tag.value for tag in page.tags.values()}
            pixels = np.asarray(page.asarray())
    except ScanError:
        raise
    except Exception as error:
        # tifffile hands on whatever its parts make of damage: struct, zlib, key, index, value, memory.
        raise ScanError(f"not a TIFF picture, or damaged: {error}", file=path) from error
    return _scan(path, _tiff_map(pixels, tags, options.unit or 1.0), options)


def read_npy(path: Path, options: ReadOptions) -> LineScan | PointCloud:
    """Read an array: points of shape (n, 3), or a height map of shape (rows, columns).

    Raises
    ------
    ScanError
        When it is no such array or is cut short, or the sizes of its pixels are not given.
    """
    try:
        # mapped, so that a header that promises too much is refused before anything is taken
        values = np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    except OSError as error:
        raise ScanError(f"cannot be read: {error.strerror or error}", file=path) from error
    except Exception as error:
        raise ScanError("not an .npy array, or cut short", file=path) from error
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        raise ScanError(
            f"an array of {values.dtype} and shape {values.shape}", file=path,
            remedy="expected heights (rows, columns) or points (n, 3)",
        )  # fmt: skip
    if values.shape[1] == 3:
        points = values.astype(np.float64) * (options.unit or 1.0)
        keep = usable(points)
        if not keep.any():
            raise ScanError("the file holds no point", file=path)
        return PointCloud(points[keep], source=str(path))
    return _scan(path, _Map(values), options)


def looks_like_sick(head: bytes) -> bool:
    """Whether the start of a file is a height map in SICK's JSON."""
    return head.lstrip()[:1] == b"{" and b'"PixelSize"' in head and b'"class"' in head


def read_sick(path: Path, options: ReadOptions) -> LineScan:
    """Read a height map in the JSON of SICK's AppSpace; its sizes are millimetres.

    Raises
    ------
    ScanError
        When it is no such file, or is cut short.
    """
    try:
        data = json.loads(path.read_bytes())["data"]
        image = data["Data"]
        stored = image["Pixels"]
        kind = np.dtype(_SICK_TYPES[image["ImageType"]]).newbyteorder(
            ">" if stored["endian"] == "big" else "<"
        )
        raw = base64.b64decode(stored["data"], validate=True)
        shape = (int(image["Height"]), int(image["Width"]))
        if min(shape) < 1 or shape[0] * shape[1] * kind.itemsize != len(raw):
            raise ScanError(f"{len(raw)} bytes are not {shape[0]} x {shape[1]} pixels", file=path)
        unit = options.unit or _SICK_UNIT
        sizes = [float(data["PixelSize"][axis]) * unit for axis in "xyz"]
        origin = [float(data.get("Origin", {}).get(axis, 0.0)) * unit for axis in "xyz"]
        holes = data.get("HandleZeroPixels", "MissingData") == "MissingData"
    except ScanError:
        raise
    except (json.JSONDecodeError, UnicodeDecodeError, binascii.Error, RecursionError) as error:
        raise ScanError(f"not JSON, or cut short: {error}", file=path) from error
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        what = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        remedy = "name a scan; the truth and the results of bimfit are none"
        raise ScanError(f"not a height map of SICK: {what}", file=path, remedy=remedy) from error
    if not all(np.isfinite(size) and size != 0.0 for size in sizes) or not np.isfinite(origin).all():
        raise ScanError("the pixels have no size", file=path)
    pixels = np.frombuffer(raw, kind).reshape(shape)
    return _scan(
        path,
        _Map(
            pixels, (sizes[0], sizes[1], sizes[2]), (origin[0], origin[1], origin[2]), 0.0 if holes else None
        ),
        replace(options, unit=None),
    )


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Keep a logger from saying in several lines what our error says in one."""
    logger = logging.getLogger(name)
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


# -- what they have in common ------------------------------------------------------------------------


def _tiff_map(pixels: NDArray[Any], tags: dict[int, Any], unit: float) -> _Map:
    sizes: tuple[float | None, float | None, float | None] = (None, None, None)
    scale = tags.get(_SCALE)
    if isinstance(scale, tuple) and len(scale) >= 2 and min(scale[:2]) > 0.0:
        # GeoTIFF counts rows southwards; heights are in the same unit unless the third scale says otherwise
        up = scale[2] if len(scale) > 2 and scale[2] > 0.0 else 1.0
        sizes = (scale[0] * unit, -scale[1] * unit, up * unit)
    try:
        nothing = float(str(tags[_NODATA]).strip("\x00 "))
    except (KeyError, ValueError):
        nothing = None
    return _Map(pixels, sizes, nothing=nothing)


def _check_size(path: Path, shape: tuple[int, ...]) -> None:
    if shape[0] * shape[1] > _MOST_PIXELS:
        raise ScanError(
            f"{shape[1]} x {shape[0]} pixels are more than {_MOST_PIXELS:,}",
            file=path,
            remedy="cut it to pieces",
        )


def _scan(path: Path, map_: _Map, options: ReadOptions) -> LineScan:
    _check_size(path, map_.pixels.shape)
    sizes = [given or own for given, own in zip(options.pixel, map_.sizes, strict=True)]
    if sizes[2] is None and map_.pixels.dtype.kind == "f":
        sizes[2] = options.unit or 1.0  # decimals are lengths already
    across, along, up = sizes
    if across is None or along is None or up is None:
        raise ScanError("the file does not say how large its pixels are", file=path, remedy=_PIXEL)
    heights, zeros = _heights(map_)
    if not np.isfinite(heights).any():
        raise ScanError("the file holds no height", file=path)
    rows, columns = heights.shape
    xs = map_.origin[0] + across * np.arange(columns)
    ys = map_.origin[1] + along * np.arange(rows)
    notes = [f"height map of {columns} x {rows} pixels of {across * 1e3:.6g} x {along * 1e3:.6g} mm"]
    notes[0] += f", {up * 1e3:.6g} mm a count" if map_.pixels.dtype.kind in "iu" else ""
    if zeros:
        notes.append(f"{zeros:,} heights are 0 and count as not measured")
    return beams_of_heights(map_.origin[2] + up * heights, xs, ys, str(path), tuple(notes))


def _heights(map_: _Map) -> tuple[Array, int]:
    """Heights in counts with NaN for nothing, and how many zeros among decimals were taken for nothing."""
    out = map_.pixels.astype(np.float64)
    out[~(np.abs(out) <= FARTHEST)] = np.nan
    if map_.nothing is not None:
        out[out == map_.nothing] = np.nan
        return out, 0
    if map_.pixels.dtype.kind in "iu":
        out[out == 0.0] = np.nan
        return out, 0
    zero = out == 0.0
    if zero.any() and not zero.all() and not np.isnan(out).any():
        out[zero] = np.nan
        return out, int(zero.sum())
    return out, 0
