"""COPC: LAZ whose points lie in an octree (https://copc.io), of which only what is wanted is unpacked.

The hierarchy is walked here, since what a file says of itself must not make a reader loop or take memory; its
nodes are unpacked by lazrs, which laspy builds on.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.scan.boxes import Boxes
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats.las import las_chunks, las_errors, las_piece, step_note
from bimfit.scan.formats.las_header import check_header
from bimfit.scan.formats.options import ReadOptions

PIECE = 500_000
_SIGNATURE = slice(377, 381)
_ENTRY = np.dtype([("level", "<i4"), ("key", "<i4", 3), ("offset", "<u8"), ("size", "<i4"), ("count", "<i4")])
_DEEPEST = 30
_MOST_POINTS = 1000
"""No byte of a node holds more points; a fraction of one is usual."""


def looks_like_copc(head: bytes) -> bool:
    """Whether the start of a file is COPC."""
    return head.startswith(b"LASF") and head[_SIGNATURE] == b"copc"


def copc_chunks(path: Path, options: ReadOptions) -> Iterator[PointCloud]:
    """Read a COPC file in pieces; with boxes, only the octree's nodes that meet one are unpacked.

    Raises
    ------
    ScanError
        When it is no such file, is cut short or damaged, holds no point, or laspy is not installed.
    """
    boxes = options.file_boxes(1.0)
    if boxes is None:
        yield from las_chunks(path, options)
        return
    try:
        import lazrs
        from laspy import DecompressionSelection, LasHeader, PackedPointRecord, ScaleAwarePointRecord
    except ImportError as error:
        raise ScanError(
            "reading COPC needs the packages laspy and lazrs", file=path, remedy='pip install "bimfit[las]"'
        ) from error
    wanted = Boxes.of(boxes)
    chosen = DecompressionSelection.base().decompress_z().decompress_intensity().to_lazrs()
    check_header(path)
    with las_errors(path), path.open("rb") as stream:
        header = LasHeader.read_from(stream)
        if not header.point_count:
            raise ScanError("the file holds no point", file=path)
        scale, offset = np.asarray(header.scales, float), np.asarray(header.offsets, float)
        notes = step_note(scale, options)
        packing = header.vlrs.get("LasZipVlr")[0].record_data
        nodes = _nodes(path, stream, header, wanted)
        width = header.point_format.size
        for part in _parts(nodes["count"]):
            data = b"".join(_bytes(path, stream, node) for node in nodes[part])
            table = [(int(node["count"]), int(node["size"])) for node in nodes[part]]
            raw = np.zeros(sum(count for count, _ in table) * width, np.uint8)
            lazrs.decompress_points_with_chunk_table(data, packing, raw, table, chosen)
            packed = PackedPointRecord.from_buffer(raw, header.point_format)
            record = ScaleAwarePointRecord(packed.array, header.point_format, scale, offset)
            yield las_piece(path, record, scale, offset, wanted, notes)


def _nodes(path: Path, stream: BinaryIO, header: Any, wanted: Boxes) -> NDArray[Any]:
    """The octree's nodes that hold points and meet a box, in the file's order; only their pages are read."""
    info = header.vlrs[0]
    if type(info).__name__ != "CopcInfoVlr":
        raise ScanError("not a COPC file: its first record is another", file=path)
    low, side = np.asarray(info.center, float) - info.halfsize, 2.0 * float(info.halfsize)
    if not (np.isfinite(low).all() and side >= 0.0):
        raise ScanError("not a COPC file, or damaged: its octree lies nowhere", file=path)
    slack = 2.0 * np.abs(np.asarray(header.scales, float))
    size = path.stat().st_size
    pages = [(int(info.hierarchy_root_offset), int(info.hierarchy_root_size))]
    seen: set[int] = set()
    found = []
    while pages:
        offset, length = pages.pop()
        if offset in seen or length < 0 or offset + length > size:
            raise ScanError("cut short, or its octree is damaged", file=path)
        seen.add(offset)
        stream.seek(offset)
        entries = np.frombuffer(stream.read(length // _ENTRY.itemsize * _ENTRY.itemsize), _ENTRY)
        if ((entries["level"] < 0) | (entries["level"] > _DEEPEST) | (entries["count"] < -1)).any():
            raise ScanError("damaged: its octree makes no sense", file=path)
        cell = side / 2.0 ** entries["level"][:, None]
        corner = low + entries["key"] * cell
        entries = entries[wanted.meets(corner - slack, corner + cell + slack)]
        pages += [(int(e["offset"]), int(e["size"])) for e in entries[entries["count"] == -1]]
        found.append(entries[entries["count"] > 0])
    nodes = np.concatenate(found)
    nodes = nodes[np.argsort(nodes["offset"], kind="stable")]
    crowded = nodes["count"].astype(np.int64) > _MOST_POINTS * nodes["size"].astype(np.int64)
    if crowded.any() or int(nodes["count"].sum(dtype=np.int64)) > header.point_count:
        raise ScanError("damaged: its octree holds more points than the file", file=path)
    return nodes


def _parts(counts: NDArray[Any]) -> Iterator[slice]:
    """Runs of nodes with about a piece's points."""
    start = held = 0
    for k, count in enumerate(counts.tolist()):
        if held and held + count > PIECE:
            yield slice(start, k)
            start, held = k, 0
        held += count
    if held:
        yield slice(start, len(counts))


def _bytes(path: Path, stream: BinaryIO, node: Any) -> bytes:
    offset, size = int(node["offset"]), int(node["size"])
    stream.seek(offset)
    data = stream.read(max(size, 0))
    if size <= 0 or len(data) < size:
        raise ScanError("cut short within its points", file=path)
    return data
