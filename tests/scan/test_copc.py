"""COPC: written by copclib, and by lazrs in many nodes and pages; laspy's own readers as second opinions.

``data/copclib.copc.laz`` was written once with copclib 2.6.3 from made-up points: 9 nodes on two levels at
map coordinates, four of them in hierarchy pages of their own.
"""

import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.errors import ScanError
from bimfit.scan.formats import copc, read_scan, scan_chunks
from bimfit.scan.formats.options import ReadOptions

laspy = pytest.importorskip("laspy")
lazrs = pytest.importorskip("lazrs")

BY_COPCLIB = Path(__file__).parent / "data" / "copclib.copc.laz"
LOW, SIDE = np.array([458652.0, 5438227.0, 7.0]), 16.0


def write_copc(path, points, *, depth=3, pages=True, seed=0):
    """An octree of LAZ chunks, each node with what its parent did not take; a page a child of the root.

    After the specification: header of 375 bytes, info record first, chunks of any size, the hierarchy last.
    """
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-4), np.floor(LOW)
    rng = np.random.default_rng(seed)
    level = rng.integers(0, depth, len(points))
    nodes = {}
    for d in range(depth):
        cells = np.floor((points[level == d] - LOW) / (SIDE / 2**d)).astype(int)
        for cell in np.unique(cells, axis=0):
            nodes[(d, *cell.tolist())] = points[level == d][(cells == cell).all(axis=1)]
    for d, *cell in list(nodes):  # an octree holds the parents of its nodes
        for up in range(d):
            nodes.setdefault((up, *[c >> (d - up) for c in cell]), np.zeros((0, 3)))
    vlr = lazrs.LazVlr.new_for_compression(6, 0, True)
    info = bytearray(160)
    records = [(b"copc", 1, info), (b"laszip encoded", 22204, bytes(vlr.record_data()))]
    start = 375 + sum(54 + len(data) for *_, data in records)
    with path.open("wb") as stream:
        stream.write(bytes(start))
        packer = lazrs.LasZipCompressor(stream, vlr)
        packer.reserve_offset_to_chunk_table()
        entries = {}
        for key, own in sorted(nodes.items()):
            if len(own):
                record = laspy.ScaleAwarePointRecord.zeros(len(own), header=header)
                record.x, record.y, record.z = own.T
                record.intensity = np.arange(len(own))
                begin = stream.tell()
                packer.compress_many(np.frombuffer(record.memoryview(), np.uint8))
                packer.finish_current_chunk()
                entries[key] = (begin, stream.tell() - begin, len(own))
            else:
                entries[key] = (0, 0, 0)
        packer.done()
        stream.seek(0, 2)
        end = stream.tell()
        stream.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, 0, b""))
        root = {k: v for k, v in entries.items() if k[0] == 0 or not pages}
        for key in [k for k in entries if k[0] == 1 and pages]:
            below = {
                k: v for k, v in entries.items() if k[0] and tuple(c >> (k[0] - 1) for c in k[1:]) == key[1:]
            }
            root[key] = (stream.tell(), 32 * len(below), -1)
            stream.write(b"".join(struct.pack("<4iQ2i", *k, *v) for k, v in below.items()))
        info[:72] = struct.pack(
            "<5d2Q2d", *(LOW + SIDE / 2), SIDE / 2, 1.0, stream.tell(), 32 * len(root), 0, 0
        )
        stream.write(b"".join(struct.pack("<4iQ2i", *k, *v) for k, v in root.items()))
        size = stream.tell()
        stream.seek(end + 20)
        stream.write(struct.pack("<Q", size - end - 60))
        head = bytearray(375)
        head[:4], head[24:26] = b"LASF", bytes([1, 4])
        struct.pack_into("<HII", head, 94, 375, start, len(records))
        struct.pack_into("<BH", head, 104, 6 | 128, 30)
        struct.pack_into("<6d", head, 131, *header.scales, *header.offsets)
        box = np.stack([points.max(axis=0), points.min(axis=0)], axis=1).reshape(-1)
        struct.pack_into("<6d", head, 179, *box)
        struct.pack_into("<QIQ", head, 235, end, 1, len(points))
        stream.seek(0)
        stream.write(head)
        for owner, number, data in records:
            stream.write(struct.pack("<H16sHH32s", 0, owner, number, len(data), b"") + data)


@pytest.fixture
def points():
    rng = np.random.default_rng(4)
    return np.round(LOW + rng.uniform(0.0, SIDE, (6000, 3)), 4)


def naive(points, boxes):
    return ((points[:, None] >= boxes[:, 0]) & (points[:, None] <= boxes[:, 1])).all(2).any(1)


def some_boxes(points, half=0.7):
    return np.stack([points[:4] - half, points[:4] + half], axis=1)


def ordered(points):
    return points[np.lexsort(points.T)]


@pytest.mark.parametrize("source", ["copclib", "paged", "one page"])
def test_boxes_give_just_the_points_that_lie_in_them(tmp_path, points, source):
    file = BY_COPCLIB
    if source != "copclib":
        file = tmp_path / "c.copc.laz"
        write_copc(file, points, pages=source == "paged")
    whole = read_scan(file)
    assert whole.notes[-1].startswith("COPC: ")
    las = laspy.read(file)
    assert np.array_equal(whole.points, np.stack([las.x, las.y, las.z], axis=1))
    if source != "copclib":  # half a step
        assert np.allclose(ordered(whole.points), ordered(points), rtol=0, atol=0.51e-4)
    boxes = some_boxes(whole.points, 1.5 if source == "copclib" else 0.7)
    pieces = list(scan_chunks(file, ReadOptions(boxes=boxes)))
    got = np.concatenate([piece.points for piece in pieces])
    keep = naive(whole.points, boxes)
    assert 10 < keep.sum() < len(keep) / 2
    assert np.array_equal(ordered(got), ordered(whole.points[keep]))
    with laspy.CopcReader.open(file) as reader:
        theirs = reader.query(laspy.copc.Bounds(boxes[0, 0], boxes[0, 1]))
    one = np.concatenate([p.points for p in scan_chunks(file, ReadOptions(boxes=boxes[:1]))])
    assert np.array_equal(ordered(one), ordered(np.stack([theirs.x, theirs.y, theirs.z], axis=1)))
    assert not sum(map(len, scan_chunks(file, ReadOptions(boxes=boxes + 1000.0))))
    # without boxes, everything
    assert np.array_equal(np.concatenate([p.points for p in scan_chunks(file)]), whole.points)


def test_only_the_nodes_that_meet_a_box_are_unpacked(tmp_path, monkeypatch, points):
    write_copc(tmp_path / "c.copc.laz", points)
    unpacked = []
    own = lazrs.decompress_points_with_chunk_table

    def counted(data, vlr, out, table, *more):
        unpacked.extend(count for count, _ in table)
        return own(data, vlr, out, table, *more)

    monkeypatch.setattr(lazrs, "decompress_points_with_chunk_table", counted)
    monkeypatch.setattr(copc, "PIECE", 500)
    corner = np.array([[LOW, LOW + 0.5]])
    assert len(list(scan_chunks(tmp_path / "c.copc.laz", ReadOptions(boxes=corner)))) > 1
    # of each of three levels, the one node in the corner: a third, a 24th and a 192nd of the points
    assert sum(unpacked) == pytest.approx(len(points) / 3 * (1 + 1 / 8 + 1 / 64), rel=0.1)


def test_copc_without_laspy_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "lazrs", None)
    with pytest.raises(ScanError, match=r"bimfit\[las\]"):
        list(scan_chunks(BY_COPCLIB, ReadOptions(boxes=np.array([[LOW, LOW + 1]]))))


def test_damaged_copc_is_read_or_refused_but_never_hangs(tmp_path, points):
    write_copc(tmp_path / "c.copc.laz", points[:800])
    rng = np.random.default_rng(6)
    everything = ReadOptions(boxes=np.array([[LOW - 100, LOW + 100]]))
    refused = 0
    for source in (BY_COPCLIB, tmp_path / "c.copc.laz"):
        data = np.frombuffer(source.read_bytes(), np.uint8)
        file = tmp_path / "bad.copc.laz"
        for share in (0.02, 0.1, 0.5, 0.9, 0.99):
            file.write_bytes(data[: int(share * len(data))].tobytes())
            with pytest.raises(ScanError) as error:
                list(scan_chunks(file, everything))
            assert "\n" not in str(error.value) and "bad.copc.laz" in str(error.value)
        for k in range(80):
            bad = data.copy()
            # the header, the records, the hierarchy at the end, and anywhere
            low, high = [(0, 375), (375, 700), (len(bad) - 600, len(bad)), (0, len(bad))][k % 4]
            places = rng.integers(low, high, rng.integers(1, 4))
            bad[places] = rng.integers(0, 256, len(places))
            file.write_bytes(bad.tobytes())
            try:
                assert all(np.isfinite(piece.points).all() for piece in scan_chunks(file, everything))
            except ScanError as error:
                assert "\n" not in str(error)
                refused += 1
    assert refused > 20


def test_pages_that_point_at_one_another_are_refused(tmp_path, points):
    write_copc(tmp_path / "c.copc.laz", points)
    data = bytearray((tmp_path / "c.copc.laz").read_bytes())
    root, length = struct.unpack_from("<QQ", data, 375 + 54 + 40)
    for at in range(root, root + length, 32):
        if struct.unpack_from("<i", data, at + 28)[0] == -1:
            struct.pack_into("<Qi", data, at + 16, root, length)
    (tmp_path / "c.copc.laz").write_bytes(data)
    with pytest.raises(ScanError, match="octree is damaged"):
        list(scan_chunks(tmp_path / "c.copc.laz", ReadOptions(boxes=some_boxes(points))))
