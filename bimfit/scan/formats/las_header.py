"""What a LAS or LAZ header promises, held against the size of its file.

laspy reads on for as many records as a header names, and lazrs takes as much memory as a chunk table asks
for, which ends the whole process. So both are looked at first (LAS 1.4 R15; the LASzip specification).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from bimfit.errors import ScanError

_SHORTEST, _LONGEST = 227, 375
_RECORD, _LONG_RECORD = 54, 60
_PACKED = 0xC0
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1, 14: 0}
"""Layers of each kind of item that is packed in layers; 0 for one a byte."""
_ANY_SIZE = 0xFFFFFFFF
_MOST_CHUNK = 50_000_000
"""Points a chunk; writers take 50,000."""


def check_header(path: Path) -> None:
    """Refuse a header that promises more than the file has room for.

    Raises
    ------
    ScanError
        Saying what does not fit.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            head = stream.read(_LONGEST)
            if len(head) < _SHORTEST or not head.startswith(b"LASF"):
                raise ScanError("not a LAS file, or cut short", file=path)
            _check(path, stream, head, size)
    except OSError as error:
        raise ScanError(f"cannot be read: {error.strerror or error}", file=path) from error
    except struct.error as error:
        raise ScanError("not a LAS file, or cut short", file=path) from error


def _check(path: Path, stream: BinaryIO, head: bytes, size: int) -> None:
    begin, points, records = struct.unpack_from("<HII", head, 94)
    later = head[24:26] == b"\x01\x04" and len(head) >= _LONGEST
    further = struct.unpack_from("<I", head, 243)[0] if later else 0
    if records * _RECORD + further * _LONG_RECORD > size or points > size:
        raise ScanError("not a LAS file, or damaged: more records than it has room for", file=path)
    if not head[104] & _PACKED:
        length, old = struct.unpack_from("<HI", head, 105)
        count = struct.unpack_from("<Q", head, 247)[0] if later else old
        room = (size - points) // max(length, 1)
        if room < count:
            raise ScanError(
                f"cut short: {room:,} of {count:,} points", file=path, remedy="copy or export it again"
            )
    else:
        stream.seek(begin)
        packing = _packing(stream, records)
        if packing is None:
            raise ScanError("damaged: packed points without the record that says how", file=path)
        (chunk,) = struct.unpack_from("<I", packing, 12)
        count = _chunks(stream, points, size)
        if not 0 < chunk <= _MOST_CHUNK and chunk != _ANY_SIZE:
            raise ScanError(f"damaged: chunks of {chunk:,} points", file=path)
        if count > size:
            raise ScanError("damaged, or cut short: its chunk table has no room in it", file=path)
        _check_layers(path, stream, packing, points, size)


def _check_layers(path: Path, stream: BinaryIO, packing: bytes, points: int, size: int) -> None:
    """Refuse chunks whose layers are larger than they: lazrs takes as much memory as a layer claims."""
    (count,) = struct.unpack_from("<H", packing, 32)
    items = [struct.unpack_from("<HHH", packing, 34 + 6 * k)[:2] for k in range(count)]
    if not items or any(kind not in _LAYERS for kind, _ in items):
        return  # packed the older way, without layers
    try:
        import lazrs
    except ImportError:
        return  # whoever reads the points says what is not installed
    layers = sum(_LAYERS[kind] or length for kind, length in items)
    first = sum(length for _, length in items)
    stream.seek(points)
    try:
        table = lazrs.read_chunk_table(stream, lazrs.LazVlr(packing))
    except Exception as error:  # lazrs has one of its own, and hands on those of the stream
        raise ScanError(f"damaged: its chunk table cannot be read: {error}", file=path) from error
    at = points + 8
    for number, length in table:
        stream.seek(at + first)
        head = stream.read(4 * (1 + layers)) if number else b""
        claimed = sum(struct.unpack_from(f"<{layers}I", head, 4)) if number else 0
        at += length
        if claimed > length or at > size:
            raise ScanError("damaged: a chunk of points is larger than its room", file=path)


def _packing(stream: BinaryIO, records: int) -> bytes | None:
    """The record that tells how points are packed."""
    for _ in range(records):
        head = stream.read(_RECORD)
        owner, number, length = struct.unpack_from("<16sHH", head, 2)
        data = stream.read(length)
        if owner.rstrip(b"\0") == b"laszip encoded" and number == 22204:
            return data
    return None


def _chunks(stream: BinaryIO, points: int, size: int) -> int:
    """How many chunks the table names; more than the file's size where there is no table."""
    stream.seek(points)
    (table,) = struct.unpack("<q", stream.read(8))
    if table == -1:  # written without going back: the place is at the end
        stream.seek(max(size - 8, 0))
        (table,) = struct.unpack("<q", stream.read(8))
    if not points <= table <= size - 8:
        return size + 1
    stream.seek(table + 4)
    return int(struct.unpack("<I", stream.read(4))[0])
