"""Height maps and profile tables: made here, written by the libraries that own the formats."""

import base64
import json
import sys

import numpy as np
import pytest

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import read_scan
from bimfit.scan.formats.options import ReadOptions

PIXEL = ReadOptions(pixel=(1e-4, 2e-4, 5e-6))
SHAPE = (30, 40)


@pytest.fixture
def counts():
    """A sloping plate with a groove where nothing came back, in counts."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    out = (20_000 + 37 * columns - 11 * rows).astype(np.uint16)
    out[:, 18:22] = 0
    out[7, :] = 0
    return out


def expected(counts, sizes=(1e-4, 2e-4, 5e-6), origin=(0.0, 0.0, 0.0)):
    rows, columns = np.nonzero(counts)
    heights = counts[rows, columns].astype(float)
    return np.stack([columns, rows, heights], axis=1) * sizes + origin


def check(scan, counts, atol=1e-12, **at):
    assert isinstance(scan, LineScan)
    assert len(scan) == counts.size and len(scan.sweeps) == counts.shape[0]
    assert np.array_equal(scan.returned, counts.reshape(-1) > 0)
    assert np.allclose(scan.hits, expected(counts, **at), rtol=0, atol=atol)
    assert np.allclose(np.linalg.norm(scan.directions, axis=1), 1.0)


def test_png_by_pillow(tmp_path, counts):
    from PIL import Image

    Image.fromarray(counts).save(tmp_path / "h.png")
    scan = read_scan(tmp_path / "h.png", options=PIXEL)
    check(scan, counts)
    # beams are parallel to within a quarter of a pixel over the relief
    lean = np.hypot(*scan.directions[:, :2].T) / -scan.directions[:, 2]
    assert lean.max() * np.ptp(scan.hits[:, 2]) < 0.25 * 1e-4
    # a beam without return passes its own place, at about its neighbours' height
    silent = np.flatnonzero(~scan.returned & (scan.scan == 3))
    drop = (scan.origins[silent, 2] - (20_000 + 37 * 19.5 - 33) * 5e-6) / -scan.directions[silent, 2]
    there = scan.origins[silent] + scan.directions[silent] * drop[:, None]
    assert np.allclose(there[:, 0], np.arange(18, 22) * 1e-4, atol=2e-6)
    mirrored = read_scan(tmp_path / "h.png", options=ReadOptions(pixel=(1e-4, -2e-4, 5e-6)))
    check(mirrored, counts, sizes=(1e-4, -2e-4, 5e-6))
    with pytest.raises(ScanError, match="how large its pixels are; give --pixel"):
        read_scan(tmp_path / "h.png")
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "c.png")
    with pytest.raises(ScanError, match="RGB is no height map"):
        read_scan(tmp_path / "c.png", options=PIXEL)


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_tiff_by_tifffile(tmp_path, counts, compression):
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(tmp_path / "h.tif", counts, compression=compression)
    check(read_scan(tmp_path / "h.tif", options=PIXEL), counts)
    heights = np.where(counts == 0, np.nan, counts * 5e-6).astype(np.float32)
    tifffile.imwrite(tmp_path / "f.tif", heights, compression=compression)
    # single precision of 0.1 m
    check(read_scan(tmp_path / "f.tif", options=ReadOptions(pixel=(1e-4, 2e-4, None))), counts, atol=1e-8)
    tifffile.imwrite(tmp_path / "c.tif", np.zeros((4, 5, 3), np.uint8), photometric="rgb")
    with pytest.raises(ScanError, match="is no height map"):
        read_scan(tmp_path / "c.tif", options=PIXEL)


def test_geotiff_names_its_pixels_and_its_holes(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    heights = np.full((4, 5), 12.5)
    heights[1, 2] = -9999.0
    tags = [(33550, "d", 3, (0.5, 0.25, 0.0), True), (42113, "s", 0, "-9999", True)]
    tifffile.imwrite(tmp_path / "g.tif", heights, extratags=tags)
    scan = read_scan(tmp_path / "g.tif")
    assert np.count_nonzero(~scan.returned) == 1
    assert np.allclose(np.ptp(scan.hits, axis=0), (2.0, 0.75, 0.0))
    assert np.allclose(scan.hits[:, 2], 12.5)
    assert scan.hits[-1, 1] < scan.hits[0, 1]  # rows go south


def test_tiff_without_tifffile_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tifffile", None)
    (tmp_path / "h.tif").write_bytes(b"II*\0" + bytes(100))
    with pytest.raises(ScanError, match=r"bimfit\[tiff\]"):
        read_scan(tmp_path / "h.tif", options=PIXEL)


def test_arrays(tmp_path, counts):
    np.save(tmp_path / "h.npy", counts)
    check(read_scan(tmp_path / "h.npy", options=PIXEL), counts)
    np.save(tmp_path / "f.npy", np.where(counts == 0, np.nan, counts * 5e-6))
    check(read_scan(tmp_path / "f.npy", options=ReadOptions(pixel=(1e-4, 2e-4, None))), counts)
    zeros = counts * 5e-3
    np.save(tmp_path / "z.npy", zeros)
    scan = read_scan(tmp_path / "z.npy", options=ReadOptions(pixel=(1e-4, 2e-4, None), unit=1e-3))
    check(scan, counts)
    assert f"{(counts == 0).sum():,} heights are 0" in scan.notes[1]
    np.save(tmp_path / "p.npy", expected(counts))
    cloud = read_scan(tmp_path / "p.npy")
    assert isinstance(cloud, PointCloud) and np.array_equal(cloud.points, expected(counts))
    np.save(tmp_path / "q.npy", np.zeros(5))
    with pytest.raises(ScanError, match=r"shape \(5,\)"):
        read_scan(tmp_path / "q.npy")


def sick(counts, endian=">"):
    return {
        "class": "Image",
        "data": {
            "PixelSize": {"x": 0.1, "y": 0.2, "z": 0.005},
            "Origin": {"x": -20, "y": 3, "z": 1},
            "HandleZeroPixels": "MissingData",
            "Data": {
                "ImageType": "uint16", "Width": counts.shape[1], "Height": counts.shape[0],
                "Pixels": {
                    "numOfElems": counts.size, "elemSz": 2, "endian": "big" if endian == ">" else "little",
                    "data": base64.b64encode(counts.astype(f"{endian}u2").tobytes()).decode(),
                },
            },
        },
    }  # fmt: skip


@pytest.mark.parametrize("endian", "<>")
def test_the_json_of_sick(tmp_path, counts, endian):
    (tmp_path / "s.json").write_text(json.dumps(sick(counts, endian)))
    check(read_scan(tmp_path / "s.json"), counts, origin=(-0.02, 0.003, 0.001))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda d: d["data"]["PixelSize"].pop("z"), "not a height map of SICK: it has no 'z'"),
        (lambda d: d["data"]["PixelSize"].update(z=0), "the pixels have no size"),
        (lambda d: d["data"]["Data"].update(Width=41), "are not 30 x 41 pixels"),
        (lambda d: d["data"]["Data"].update(Width=10**30), "are not 30 x"),
        (lambda d: d["data"]["Data"].update(ImageType="rgb"), "not a height map of SICK"),
        (lambda d: d["data"]["Data"]["Pixels"].update(data="!!"), "not JSON, or cut short"),
        (lambda d: d["data"]["Data"].update(Pixels=7), "not a height map of SICK"),
    ],
)
def test_damaged_json(tmp_path, counts, change, complaint):
    data = sick(counts)
    change(data)
    (tmp_path / "s.json").write_text(json.dumps(data))
    with pytest.raises(ScanError, match=complaint):
        read_scan(tmp_path / "s.json")


def test_the_height_map_of_the_slotted_part(shared):
    scan = read_scan(shared / "scans" / "sick_gap_heightmap.json")
    assert len(scan) == 160_000 and np.count_nonzero(~scan.returned) == 47_591
    low, high = scan.bounds
    assert np.allclose(low[:2], (-0.020, 0.0)) and np.allclose(high[:2], (0.020, 0.0399), atol=1e-4)
    assert low[2] == pytest.approx(4530 * 0.00454545e-3, rel=1e-5)


# -- profile tables ----------------------------------------------------------------------------------


def table(counts, delimiter=",", empty="", scale=5e-3):
    rows = [[repr(v * scale) if v else empty for v in row] for row in counts.tolist()]
    return "\n".join(delimiter.join(row) for row in rows) + "\n"


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("empty", ["", "0", "nan", "-99999.9999", "-9999"])
def test_profile_tables(tmp_path, counts, delimiter, empty):
    (tmp_path / "p.csv").write_text(table(counts, delimiter, empty))
    check(read_scan(tmp_path / "p.csv", options=ReadOptions(pixel=(1e-4, 2e-4, None))), counts)


@pytest.mark.parametrize(
    "head",
    [
        "pitch_x,0.1\npitch_y,0.2\n",
        "# x_pitch = 0.1\n# y_pitch = 0.2\n",
        "Sensor,ABC-1,2026\nX pitch (mm),0.1\nY step (mm),0.2\n\n",
        "unit,cm\nx spacing: 0.01\ny interval: 0.02\n",
    ],
)
def test_profile_tables_that_name_their_pitch(tmp_path, counts, head):
    scale = 5e-4 if "cm" in head else 5e-3
    (tmp_path / "p.csv").write_text(head + table(counts, scale=scale))
    check(read_scan(tmp_path / "p.csv"), counts)


def test_profile_tables_with_places_in_their_first_row_and_column(tmp_path, counts):
    lines = table(counts).splitlines()
    head = "y," + ",".join(repr(0.1 * k) for k in range(SHAPE[1]))
    body = [f"{0.2 * k!r},{line}" for k, line in enumerate(lines)]
    (tmp_path / "p.csv").write_text("\n".join([head, *body]))
    check(read_scan(tmp_path / "p.csv"), counts)


def test_damaged_profile_tables(tmp_path, counts):
    lines = table(counts).splitlines()
    options = ReadOptions(pixel=(1e-4, 2e-4, None))
    for k, bad, complaint in (
        (9, lines[9].rsplit(",", 1)[0], "line 10: 39 cells where 40"),
        (9, "x" + lines[9][1:], "line 10, column 1: "),
        (29, lines[29][: len(lines[29]) // 2], "line 30: .* cells where 40"),
    ):
        (tmp_path / "p.csv").write_text("\n".join([*lines[:k], bad, *lines[k + 1 :]]))
        with pytest.raises(ScanError, match=complaint):
            read_scan(tmp_path / "p.csv", options=options)
    (tmp_path / "p.csv").write_text("\n".join(lines))
    with pytest.raises(ScanError, match="how far apart its columns are; give --pixel"):
        read_scan(tmp_path / "p.csv")
    (tmp_path / "p.csv").write_text("unit,furlong\n" + "\n".join(lines))
    with pytest.raises(ScanError, match="unknown unit 'furlong'"):
        read_scan(tmp_path / "p.csv", options=options)


def test_wide_line_scans_are_not_taken_for_profiles(tmp_path):
    extra = [f"e{k}" for k in range(12)]
    head = ",".join(["scan", "ox", "oy", "oz", "dx", "dy", "dz", "range", *extra])
    (tmp_path / "s.csv").write_text(f"{head}\n0,1,2,3,0,0,-1,0.5{',7' * 12}\n")
    scan = read_scan(tmp_path / "s.csv")
    assert np.allclose(scan.hits, (1, 2, 2.5)) and set(scan.extra) == set(extra)
    (tmp_path / "s.csv").write_text(
        ",".join(f"speed{k}" for k in range(20)) + "\n" + ",".join("7" * 20) + "\n"
    )
    with pytest.raises(ScanError, match="no header of a line scan"):
        read_scan(tmp_path / "s.csv")


# -- damage ------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["h.png", "h.tif", "z.tif", "h.npy", "s.json", "p.csv"])
def test_damaged_maps_are_read_or_refused_but_never_crash(tmp_path, counts, name):
    tifffile = pytest.importorskip("tifffile")
    from PIL import Image

    file = tmp_path / name
    match name:
        case "h.png":
            Image.fromarray(counts).save(file)
        case "h.tif":
            tifffile.imwrite(file, counts)
        case "z.tif":
            tifffile.imwrite(file, counts, compression="zlib")
        case "h.npy":
            np.save(file, counts)
        case "s.json":
            file.write_text(json.dumps(sick(counts)))
        case "p.csv":
            file.write_text(table(counts))
    data = np.frombuffer(file.read_bytes(), np.uint8)
    rng = np.random.default_rng(5)
    refused = 0
    for k in range(60):
        bad = data.copy()
        reach = len(bad) if k % 2 else min(len(bad), 250)
        places = rng.integers(0, reach, rng.integers(1, 6))
        bad[places] = rng.integers(0, 256, len(places))
        if k % 5 == 0:
            bad = bad[: int(rng.uniform(0.0, 1.0) * len(bad))]
        file.write_bytes(bad.tobytes())
        try:
            scan = read_scan(file, options=PIXEL)
        except ScanError as error:
            assert "\n" not in str(error) and name in str(error)
            refused += 1
        else:
            assert len(scan) > 0 and np.isfinite(scan.directions if isinstance(scan, LineScan) else 0).all()
    assert refused >= (3 if name in ("h.tif", "z.tif", "p.csv") else 10)


def test_columns_that_the_sensor_does_not_use_are_no_beams(tmp_path, counts):
    """Empty from the first row to the last at either end; a groove as long as the map stays a groove."""
    counts[:, :3] = counts[:, -5:] = 0
    from PIL import Image

    Image.fromarray(counts).save(tmp_path / "h.png")
    scan = read_scan(tmp_path / "h.png", options=PIXEL)
    assert len(scan) == SHAPE[0] * (SHAPE[1] - 8)
    lost = ~scan.returned.reshape(SHAPE[0], -1)
    assert lost[0].sum() == 4
    assert lost[7].all()
    assert np.allclose(scan.hits, expected(counts), rtol=0, atol=1e-12)
