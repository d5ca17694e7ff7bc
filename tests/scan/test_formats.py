import shutil
from pathlib import Path

import numpy as np
import pytest

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import FORMATS, read_scan, scan_chunks, write_scan
from bimfit.scan.formats.pcd import lzf_decompress

SHARED = Path(__file__).parents[3] / "shared" / "data" / "scans"


def shared(name):
    if not (SHARED / name).exists():
        pytest.skip(f"{name} is not at hand")
    return SHARED / name


# -- round trips -------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["csv", "npz", "ply", "pcd", "xyz"])
def test_clouds_keep_every_bit_of_their_map_coordinates(tmp_path, cloud, suffix):
    before = cloud.points.copy()
    write_scan(cloud, tmp_path / f"c.{suffix}")
    back = read_scan(tmp_path / f"c.{suffix}")
    assert isinstance(back, PointCloud)
    assert np.array_equal(back.points, before)
    assert np.array_equal(cloud.points, before)
    assert back.source.endswith(suffix)


@pytest.mark.parametrize("suffix", ["npz", "ply", "pcd"])
def test_clouds_keep_what_goes_with_their_points(tmp_path, cloud, suffix):
    write_scan(cloud, tmp_path / f"c.{suffix}")
    back = read_scan(tmp_path / f"c.{suffix}")
    assert np.array_equal(back.viewpoint, cloud.viewpoint)
    assert np.array_equal(back.normals, cloud.normals)
    assert np.array_equal(back.intensity, cloud.intensity)
    if suffix != "pcd":
        assert np.array_equal(back.colors, cloud.colors)


def test_line_scans_keep_every_bit_as_arrays(tmp_path, line_scan):
    write_scan(line_scan, tmp_path / "s.npz")
    back = read_scan(tmp_path / "s.npz")
    assert isinstance(back, LineScan)
    for name in ("scan", "origins", "directions", "ranges"):
        assert np.array_equal(getattr(back, name), getattr(line_scan, name), equal_nan=True)
    with np.load(tmp_path / "s.npz") as arrays:
        assert set(arrays.files) == {"scan", "ox", "oy", "oz", "dx", "dy", "dz", "range"}


# -- files by other hands ----------------------------------------------------------------------------


@pytest.mark.parametrize("ascii_", [True, False])
@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("double", [True, False])
def test_pcd_by_open3d(tmp_path, cloud, ascii_, compressed, double):
    """Its tensor writer keeps double precision; the tolerance is that of what it stored."""
    import open3d

    kind = np.float64 if double else np.float32
    near = cloud.points - cloud.points.mean(axis=0)
    out = open3d.t.geometry.PointCloud(open3d.core.Tensor(np.ascontiguousarray(near.astype(kind))))
    out.point.intensity = open3d.core.Tensor(np.ascontiguousarray(cloud.intensity[:, None].astype(kind)))
    file = str(tmp_path / "o.pcd")
    assert open3d.t.io.write_point_cloud(file, out, write_ascii=ascii_, compressed=compressed)
    back = read_scan(file)
    tolerance = 1e-6 if ascii_ else (0.0 if double else 1e-6)
    assert np.allclose(back.points, near, rtol=0, atol=tolerance)
    assert np.allclose(back.intensity, cloud.intensity, atol=1e-6)
    assert back.viewpoint is None


@pytest.mark.parametrize("ascii_", [True, False])
def test_ply_by_open3d(tmp_path, cloud, ascii_):
    import open3d

    out = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points - cloud.points.mean(axis=0)))
    out.normals = open3d.utility.Vector3dVector(cloud.normals)
    out.colors = open3d.utility.Vector3dVector(cloud.colors / 255.0)
    assert open3d.io.write_point_cloud(str(tmp_path / "o.ply"), out, write_ascii=ascii_)
    back = read_scan(tmp_path / "o.ply")
    assert np.allclose(back.points, np.asarray(out.points), rtol=0, atol=1e-5 if ascii_ else 0.0)
    assert np.allclose(back.normals, cloud.normals, atol=1e-5)
    assert np.abs(back.colors.astype(int) - cloud.colors).max() <= 1


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_meshes_by_trimesh_are_read_as_their_vertices(tmp_path, encoding):
    import trimesh

    box = trimesh.creation.box((1, 2, 3))
    (tmp_path / "b.ply").write_bytes(trimesh.exchange.ply.export_ply(box, encoding=encoding))
    back = read_scan(tmp_path / "b.ply")
    assert np.allclose(back.points, box.vertices)
    assert "12 faces are not" in back.notes[0]


def test_big_endian_ply_with_lists_before_its_vertices(tmp_path):
    head = (
        b"ply\nformat binary_big_endian 1.0\nelement face 2\nproperty list uchar int vertex_indices\n"
        b"element vertex 2\nproperty double x\nproperty uchar tag\nproperty double y\n"
        b"property double z\nend_header\n"
    )
    faces = b"\x03" + np.arange(3).astype(">i4").tobytes() + b"\x04" + np.arange(4).astype(">i4").tobytes()
    kind = np.dtype([("x", ">f8"), ("tag", "u1"), ("y", ">f8"), ("z", ">f8")])
    rows = np.array([(1.5, 1, 2.5, 3.5), (5438232.12345, 2, 5.5, 6.5)], kind).tobytes()
    (tmp_path / "b.ply").write_bytes(head + faces + rows)
    assert np.array_equal(read_scan(tmp_path / "b.ply").points, [[1.5, 2.5, 3.5], [5438232.12345, 5.5, 6.5]])


def test_pcd_with_padding_packed_colours_and_holes(tmp_path):
    head = (
        "VERSION .7\nFIELDS x y z _ rgb\nSIZE 4 4 4 1 4\nTYPE F F F U F\nCOUNT 1 1 1 4 1\nWIDTH 3\nHEIGHT 1\n"
        "VIEWPOINT 1 2 3 1 0 0 0\nPOINTS 3\nDATA binary\n"
    )
    kind = np.dtype([("xyz", "<f4", 3), ("_", "u1", 4), ("rgb", "<u4")])
    rows = np.zeros(3, kind)
    rows["xyz"] = [[1, 2, 3], [np.nan] * 3, [4, 5, 6]]
    rows["rgb"] = 0x102030
    (tmp_path / "p.pcd").write_bytes(head.encode() + rows.tobytes())
    back = read_scan(tmp_path / "p.pcd")
    assert np.array_equal(back.points, [[1, 2, 3], [4, 5, 6]])
    assert np.array_equal(back.colors, [[16, 32, 48]] * 2)
    assert np.array_equal(back.viewpoint, [1, 2, 3])
    assert "1 points without coordinates" in back.notes[0]


def test_single_precision_at_map_coordinates_is_pointed_out(tmp_path, cloud):
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 300\nHEIGHT 1\nPOINTS 300\nDATA binary\n"
    (tmp_path / "f.pcd").write_bytes(head.encode() + cloud.points.astype("<f4").tobytes())
    assert "single precision, in steps of 0.5 units" in read_scan(tmp_path / "f.pcd").notes[0]
    near = (cloud.points - cloud.points.mean(axis=0)).astype("<f4")
    (tmp_path / "n.pcd").write_bytes(head.encode() + near.tobytes())
    assert not any("single precision" in note for note in read_scan(tmp_path / "n.pcd").notes)


@pytest.mark.parametrize("count", ["99999999999", "2147483647", "-1", "0"])
def test_pcd_points_of_no_size_that_can_be(tmp_path, count):
    head = (
        f"FIELDS x y z a\nSIZE 4 4 4 8\nTYPE F F F F\nCOUNT 1 1 1 {count}\nWIDTH 3\nHEIGHT 1\nDATA binary\n"
    )
    (tmp_path / "p.pcd").write_bytes(head.encode() + bytes(100))
    with pytest.raises(ScanError, match="does not hold together"):
        read_scan(tmp_path / "p.pcd")


def test_lzf_undoes_what_it_says():
    # literal run, a copy, a long copy that runs into itself
    assert lzf_decompress(bytes([2, 97, 98, 99, 0x20, 2]), 6) == b"abcabc"
    assert lzf_decompress(bytes([0, 97, 0xE0, 10, 0]), 20) == b"a" * 20
    assert lzf_decompress(bytes([0, 97, 0x20, 5]), 4) is None
    assert lzf_decompress(bytes([2, 97]), 3) is None


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las_by_laspy(tmp_path, cloud, suffix):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 1e-4), np.floor(cloud.points.min(axis=0))
    out = laspy.LasData(header)
    out.x, out.y, out.z = cloud.points.T
    out.intensity = np.arange(len(cloud))
    file = tmp_path / f"c.{suffix}"
    out.write(file)
    back = read_scan(file)
    # half a step of the file's own scale, 0.1 mm
    assert np.allclose(back.points, cloud.points, rtol=0, atol=0.51e-4)
    assert np.array_equal(back.intensity, np.arange(len(cloud)))
    data = file.read_bytes()
    for share in (0.01, 0.3, 0.9):
        file.write_bytes(data[: int(share * len(data))])
        with pytest.raises(ScanError):
            read_scan(file)


def test_las_without_laspy_names_the_extra(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "laspy", None)
    (tmp_path / "c.las").write_bytes(b"LASF" + bytes(400))
    with pytest.raises(ScanError, match=r"bimfit\[las\]"):
        read_scan(tmp_path / "c.las")


# -- organised clouds --------------------------------------------------------------------------------


def organised(tmp_path, grid, eye, name="o.pcd"):
    height, width, _ = grid.shape
    head = (
        f"VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {width}\nHEIGHT {height}\n"
        f"VIEWPOINT {eye[0]} {eye[1]} {eye[2]} 1 0 0 0\nPOINTS {height * width}\nDATA binary\n"
    )
    (tmp_path / name).write_bytes(head.encode() + np.ascontiguousarray(grid, "<f8").tobytes())
    return tmp_path / name


def spinning(eye, elevations, azimuths):
    """Unit directions (h, w, 3) of a spinning scanner: a row is a cone, a column a plane."""
    e, a = np.meshgrid(elevations, azimuths, indexing="ij")
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=2)


@pytest.mark.parametrize("by_column", [True, False])
def test_an_organised_cloud_becomes_beams_and_its_holes_missing_returns(tmp_path, by_column):
    eye = np.array([458657.0, 5438232.0, 1.5])
    way = spinning(eye, np.radians(np.linspace(-20, 20, 41)), np.radians(np.linspace(0, 60, 31)))
    if not by_column:
        way = way.transpose(1, 0, 2)
    ranges = np.random.default_rng(0).uniform(2.0, 6.0, way.shape[:2])
    hole = np.zeros(ranges.shape, bool)
    along = (slice(18, 23), slice(None)) if by_column else (slice(None), slice(18, 23))
    hole[along] = True
    grid = np.where(hole[..., None], np.nan, eye + way * ranges[..., None])
    scan = read_scan(organised(tmp_path, grid, eye))
    assert isinstance(scan, LineScan)
    assert len(scan) == way.shape[0] * way.shape[1]
    assert len(scan.sweeps) == 31
    assert np.count_nonzero(~scan.returned) == hole.sum()
    order = (1, 0) if by_column else (0, 1)
    expected = way.transpose(*order, 2).reshape(-1, 3)
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", scan.directions, expected), -1, 1))
    assert np.degrees(angle.max()) < 0.05
    assert np.allclose(scan.ranges[scan.returned], ranges.transpose(order)[~hole.transpose(order)], atol=1e-8)
    assert "beams without return" in scan.notes[0]


def test_a_viewpoint_that_cannot_be_right_leaves_a_cloud(tmp_path):
    way = spinning(np.zeros(3), np.radians(np.linspace(-20, 20, 41)), np.radians(np.linspace(0, 60, 31)))
    ranges = np.random.default_rng(0).uniform(2.0, 6.0, way.shape[:2])
    scan = read_scan(organised(tmp_path, way * ranges[..., None], (1.0, -1.0, 2.0)))
    assert isinstance(scan, PointCloud)
    assert len(scan) == 41 * 31


def ptx(way, ranges, T):
    """One scan as PTX; way (columns, rows, 3), ranges NaN where nothing came back."""
    local = np.nan_to_num(way * ranges[..., None]).reshape(-1, 3)
    lines = [str(way.shape[0]), str(way.shape[1]), " ".join(map(repr, T[:3, 3].tolist()))]
    lines += [" ".join(map(repr, row)) for row in T[:3, :3].T.tolist()]
    lines += [" ".join(map(repr, row)) for row in T.T.tolist()]
    lines += [f"{x!r} {y!r} {z!r} 0.5 10 20 30" for x, y, z in local.tolist()]
    return "\n".join(lines) + "\n"


def test_ptx_keeps_scanner_poses_and_missing_returns(tmp_path):
    way = spinning(None, np.radians(np.linspace(-20, 20, 41)), np.radians(np.linspace(0, 60, 31)))
    way = way.transpose(1, 0, 2)
    rng = np.random.default_rng(0)
    text, hits, eyes = "", [], []
    for angle, shift in ((0.3, (458657.0, 5438232.0, 1.5)), (-1.0, (458660.0, 5438230.0, 1.7))):
        T = np.eye(4)
        T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        T[:3, 3] = shift
        ranges = rng.uniform(2.0, 6.0, way.shape[:2])
        ranges[:, 18:23] = np.nan
        text += ptx(way, ranges, T)
        local = (way * ranges[..., None]).reshape(-1, 3)
        hits.append(local[np.isfinite(local).all(axis=1)] @ T[:3, :3].T + T[:3, 3])
        eyes.append(shift)
    (tmp_path / "s.ptx").write_text(text)
    scan = read_scan(tmp_path / "s.ptx")
    assert isinstance(scan, LineScan)
    assert len(scan.sweeps) == 62
    assert np.count_nonzero(~scan.returned) == 2 * 31 * 5
    assert np.allclose(scan.hits, np.concatenate(hits), rtol=0, atol=1e-8)
    assert np.allclose(np.unique(scan.origins, axis=0), eyes)
    pieces = list(scan_chunks(tmp_path / "s.ptx"))
    assert len(pieces) == 2
    assert np.array_equal(np.concatenate([piece.scan for piece in pieces]), scan.scan)
    assert np.array_equal(np.concatenate([piece.hits for piece in pieces]), scan.hits)
    lines = text.splitlines()
    for bad, complaint in (
        (lines[:-1], "cut short"),
        (lines[:5], "header"),
        (["x", *lines[1:]], "no header"),
        ([*lines[:6], "2 0 0 0", *lines[7:]], "not a rigid motion"),
        ([*lines[:6], "1e308 0 0 0", *lines[7:]], "not a rigid motion"),
        ([*lines[:20], "1 2 zwei 0.5 1 2 3", *lines[21:]], "line 21, column z"),
    ):
        (tmp_path / "b.ptx").write_text("\n".join(bad) + "\n")
        with pytest.raises(ScanError, match=complaint):
            read_scan(tmp_path / "b.ptx")


# -- text --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.xyz", "1 2 3\n4 5 6\n"),
        ("a.txt", "//X Y Z\n1, 2, 3\n4, 5, 6\n"),
        ("a.txt", "# made up\n\n1;2;3\n4;5;6"),
        ("a.asc", "\t1   2\t3  \r\n4 5 6\r\n"),
        ("a.pts", "2\n1 2 3 -100 10 20 30\n4 5 6 7 40 50 60\n"),
        ("a.xyz", "1 2 3 0 0 1\n4 5 6 0.6 0 0.8\n"),
        ("a.xyz", "1 2 3\nnan nan nan\n4 5 6\n"),
        ("a.txt", "x,y,z\n1,2,3\n4,5,6\n"),
        ("a", "1 2 3\n4 5 6\n"),
        ("a", "x,y,z\n1,2,3\n4,5,6\n"),
    ],
)
def test_dialects_of_plain_points(tmp_path, name, content):
    (tmp_path / name).write_text(content, newline="")
    cloud = read_scan(tmp_path / name)
    assert np.array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    if name.endswith("pts"):
        assert np.array_equal(cloud.intensity, [-100, 7])
        assert np.array_equal(cloud.colors, [[10, 20, 30], [40, 50, 60]])
    if "0.6" in content:
        assert np.array_equal(cloud.normals, [[0, 0, 1], [0.6, 0, 0.8]])


def test_a_line_scan_in_a_text_file_is_one(tmp_path, line_scan):
    write_scan(line_scan, tmp_path / "s.csv")
    shutil.copy(tmp_path / "s.csv", tmp_path / "s.txt")
    assert np.array_equal(read_scan(tmp_path / "s.txt").ranges, line_scan.ranges, equal_nan=True)
    shutil.copy(tmp_path / "s.csv", tmp_path / "s")
    assert isinstance(read_scan(tmp_path / "s"), LineScan)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("1 2 3\n4 5\n", "line 2: 2 cells where 3"),
        ("1 2 3\n4 x 6\n", "line 2, column y"),
        ("hello\n", "no row"),
    ],
)
def test_bad_rows_are_named(tmp_path, content, complaint):
    (tmp_path / "a.xyz").write_text(content)
    with pytest.raises(ScanError, match=complaint):
        read_scan(tmp_path / "a.xyz")


# -- damage ------------------------------------------------------------------------------------------


@pytest.fixture
def samples(tmp_path, cloud, line_scan):
    import open3d

    for form in FORMATS:
        if form.write is not None:
            write_scan(cloud, tmp_path / f"cloud{form.extensions[0]}")
    write_scan(line_scan, tmp_path / "beams.csv")
    write_scan(line_scan, tmp_path / "beams.npz")
    tensor = open3d.t.geometry.PointCloud(open3d.core.Tensor(np.round(cloud.points)))
    open3d.t.io.write_point_cloud(str(tmp_path / "packed.pcd"), tensor, compressed=True)
    open3d.t.io.write_point_cloud(str(tmp_path / "ascii.ply"), tensor, write_ascii=True)
    grid = spinning(np.zeros(3), np.linspace(-0.3, 0.3, 15), np.linspace(0, 1, 12)) * 3.0
    organised(tmp_path, grid, (0, 0, 0), "grid.pcd")
    way = spinning(None, np.linspace(-0.3, 0.3, 15), np.linspace(0, 1, 12)).transpose(1, 0, 2)
    (tmp_path / "scan.ptx").write_text(ptx(way, np.full((12, 15), 3.0), np.eye(4)))
    return sorted(tmp_path.iterdir())


def test_binary_files_cut_short_are_refused(samples, tmp_path):
    part = tmp_path / "part"
    part.mkdir()
    for file in samples:
        if file.suffix in (".csv", ".xyz") or file.name == "ascii.ply":
            continue  # a shorter text is a text
        data = file.read_bytes()
        for share in (0.0, 0.001, 0.02, 0.3, 0.9, 0.99):
            (part / file.name).write_bytes(data[: int(share * len(data))])
            with pytest.raises(ScanError) as error:
                read_scan(part / file.name)
            assert "\n" not in str(error.value)
            assert file.name in str(error.value)


@pytest.mark.filterwarnings("error")
def test_damaged_files_are_read_or_refused_but_never_crash(samples, tmp_path):
    rng = np.random.default_rng(4)
    part = tmp_path / "part"
    part.mkdir()
    refused = 0
    for file in samples:
        data = np.frombuffer(file.read_bytes(), np.uint8)
        for k in range(40):
            bad = data.copy()
            # half of the damage near the start, where the headers are
            reach = len(bad) if k % 2 else min(len(bad), 300)
            places = rng.integers(0, reach, rng.integers(1, 6))
            bad[places] = rng.integers(0, 256, len(places))
            (part / file.name).write_bytes(bad.tobytes())
            try:
                scan = read_scan(part / file.name)
            except ScanError as error:
                assert "\n" not in str(error)
                refused += 1
            else:
                assert len(scan) > 0
                if isinstance(scan, PointCloud):
                    assert np.isfinite(scan.points).all()
    assert refused > 100


def test_contents_that_belie_their_name(samples, tmp_path):
    part = tmp_path / "part"
    part.mkdir()
    for suffix in (".ply", ".pcd", ".npz", ".csv", ".xyz"):
        for file in samples:
            shutil.copy(file, part / f"x{suffix}")
            if suffix == file.suffix or {suffix, file.suffix} <= {".csv", ".xyz"}:
                continue
            if file.suffix in (".csv", ".xyz", ".ptx"):
                with pytest.raises(ScanError):
                    read_scan(part / f"x{suffix}")
            else:  # these say themselves what they are
                assert len(read_scan(part / f"x{suffix}")) == len(read_scan(file))


def test_contents_tell_where_the_name_does_not(samples, tmp_path):
    for file in samples:
        if file.suffix in (".npz", ".ply", ".pcd"):
            bare = tmp_path / "bare"
            shutil.copy(file, bare)
            assert len(read_scan(bare)) == len(read_scan(file))


# -- real files --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "count"), [("tee_lidar.pcd", 1837), ("shape1_lidar.pcd", 3266)])
def test_real_lidar_clouds(name, count):
    import open3d

    cloud = read_scan(shared(name))
    assert isinstance(cloud, PointCloud)
    assert len(cloud) == count
    other = np.asarray(open3d.io.read_point_cloud(str(shared(name))).points)
    assert np.allclose(cloud.points, other, rtol=0, atol=1e-9)


def test_the_tees_cad_mesh():
    cloud = read_scan(shared("tee_cad.ply"))
    assert len(cloud) == 32
    # two square tubes of 50.8 mm, in metres
    assert np.isclose(np.ptp(cloud.points[:, 1]), 0.0508, atol=1e-6)
