"""E57: written by libE57, read by ours, and pye57's own reader as a second opinion."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import transform_points
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import e57, read_scan, scan_chunks
from bimfit.scan.formats.options import ReadOptions

from .e57_files import write_e57

pytest.importorskip("pye57")
MAP = np.array([458657.0, 5438232.0, 12.0])


def pose(vector, shift):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    T[:3, 3] = shift
    return T


@pytest.fixture
def local():
    return np.random.default_rng(3).uniform(-5.0, 5.0, (2000, 3))


POSES = pose((0.3, -0.2, 1.1), MAP), pose((0.0, 0.1, -2.0), np.add(MAP, (3.0, 1.0, 0.5)))


@pytest.mark.parametrize("by_name", [False, True])
@pytest.mark.parametrize("kind", ["double", "single", "scaled"])
def test_points_of_several_scans_are_placed_by_their_poses(tmp_path, local, kind, by_name):
    scans = [{"points": local[:1200], "T": POSES[0]}, {"points": local[1200:], "T": POSES[1]}]
    write_e57(tmp_path / "a.e57", scans, kind=kind, by_name=by_name)
    cloud = read_scan(tmp_path / "a.e57")
    expected = np.concatenate([transform_points(s["T"], s["points"]) for s in scans])
    # near the scanner even single precision and steps of 0.1 mm hold 0.1 mm; a map coordinate rounds to 1 nm
    tolerance = {"double": 2e-9, "single": 1e-6, "scaled": 1e-4}[kind]
    assert np.allclose(cloud.points, expected, rtol=0, atol=tolerance)
    assert any("seen from 2 places" in note for note in cloud.notes)
    pieces = list(scan_chunks(tmp_path / "a.e57"))
    assert [tuple(piece.viewpoint) for piece in pieces] == [tuple(T[:3, 3]) for T in POSES]


def test_pyes57s_reader_agrees_where_it_can(tmp_path, local):
    import pye57

    with pye57.E57(str(tmp_path / "p.e57"), mode="w") as file:
        columns = {f"cartesian{axis}": local[:, k] for k, axis in enumerate("XYZ")}
        columns["intensity"] = np.linspace(0.0, 1.0, len(local))
        columns |= {f"color{name}": np.arange(len(local)) % 256 for name in ("Red", "Green", "Blue")}
        T = POSES[0]
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        file.write_scan_raw(columns, rotation=np.array([w, x, y, z]), translation=T[:3, 3])
    cloud = read_scan(tmp_path / "p.e57")
    with pye57.E57(str(tmp_path / "p.e57")) as file:
        theirs = file.read_scan(0, intensity=True, ignore_missing_fields=True)
    for k, axis in enumerate("XYZ"):
        assert np.allclose(cloud.points[:, k], theirs[f"cartesian{axis}"], rtol=0, atol=2e-9)
    assert np.allclose(cloud.intensity, theirs["intensity"])
    assert np.array_equal(cloud.colors[:, 1], np.arange(len(local)) % 256)
    assert np.allclose(cloud.viewpoint, T[:3, 3])


def test_single_precision_at_map_coordinates_is_pointed_out(tmp_path, local):
    write_e57(tmp_path / "s.e57", [{"points": local + MAP}], kind="single")
    assert any("single precision, in steps of 0.5 m" in note for note in read_scan(tmp_path / "s.e57").notes)
    write_e57(tmp_path / "d.e57", [{"points": local + MAP}])
    cloud = read_scan(tmp_path / "d.e57")
    assert np.array_equal(cloud.points, local + MAP)
    assert cloud.viewpoint is None
    assert not any("steps of" in note for note in cloud.notes)


def test_what_was_not_measured_is_left_out_flagged_or_not(tmp_path, local):
    local[5:9] = 0.0  # phantoms
    invalid = np.zeros(len(local), int)
    invalid[20:25] = 2
    invalid[30] = 1
    scan = {"points": local, "T": POSES[0], "cartesianInvalidState": invalid, "intensity": local[:, 0] + 5}
    write_e57(tmp_path / "i.e57", [scan])
    cloud = read_scan(tmp_path / "i.e57")
    keep = (invalid == 0) & (local != 0).any(axis=1)
    assert len(cloud) == len(local) - 10
    assert np.allclose(cloud.points, transform_points(POSES[0], local[keep]), rtol=0, atol=2e-9)
    assert np.array_equal(cloud.intensity, local[keep, 0] + 5)
    assert any("not measured" in note for note in cloud.notes)


def test_spherical_coordinates_and_colours(tmp_path, local):
    r = np.linalg.norm(local, axis=1)
    spherical = np.stack([r, np.arctan2(local[:, 1], local[:, 0]), np.arcsin(local[:, 2] / r)], axis=1)
    red = np.arange(len(local)) % 256
    scan = {"points": spherical, "spherical": True, "colorRed": red, "colorGreen": red * 0, "colorBlue": red}
    write_e57(tmp_path / "s.e57", [scan])
    cloud = read_scan(tmp_path / "s.e57")
    assert np.allclose(cloud.points, local, atol=1e-12)
    assert np.array_equal(cloud.colors, np.stack([red, 0 * red, red], axis=1))


# -- structured scans ----------------------------------------------------------------------------------


ROWS, COLUMNS = 41, 60


def structured(rng, T, *, flagged):
    """A spinning scanner's grid, column after column, with a band of missing returns."""
    elevation = np.radians(np.linspace(-20, 20, ROWS))
    azimuth = np.radians(np.linspace(0, 90, COLUMNS))
    a, e = np.meshgrid(azimuth, elevation, indexing="ij")
    way = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=2)
    ranges = rng.uniform(2.0, 6.0, (COLUMNS, ROWS))
    hole = np.zeros((COLUMNS, ROWS), bool)
    hole[:, 18:23] = True
    column, row = np.indices((COLUMNS, ROWS))
    scan = {"points": (way * ranges[..., None]).reshape(-1, 3), "T": T}
    scan |= {"rowIndex": row.reshape(-1), "columnIndex": column.reshape(-1)}
    if flagged:
        scan["cartesianInvalidState"] = hole.reshape(-1).astype(int)
    else:  # simply not there
        scan = {k: (v if k == "T" else v[~hole.reshape(-1)]) for k, v in scan.items()}
    return scan, way, ranges, hole


@pytest.mark.parametrize("flagged", [True, False])
@pytest.mark.parametrize("piece", [100, 997, 10**6])
def test_structured_scans_become_beams(tmp_path, monkeypatch, flagged, piece):
    monkeypatch.setattr(e57, "PIECE", piece)
    rng = np.random.default_rng(0)
    made = [structured(rng, T, flagged=flagged) for T in POSES]
    write_e57(tmp_path / "s.e57", [scan for scan, *_ in made])
    scan = read_scan(tmp_path / "s.e57")
    assert isinstance(scan, LineScan)
    assert len(scan.sweeps) == 2 * COLUMNS and len(scan) == 2 * COLUMNS * ROWS
    assert np.array_equal(scan.returned, ~np.concatenate([hole.reshape(-1) for *_, hole in made]))
    hits = [transform_points(s["T"], (w * r[..., None])[~h]) for s, w, r, h in made]
    assert np.allclose(scan.hits, np.concatenate(hits), rtol=0, atol=5e-9)
    expected = np.concatenate([w.reshape(-1, 3) @ s["T"][:3, :3].T for s, w, *_ in made])
    assert np.arccos(np.clip((scan.directions * expected).sum(axis=1), -1, 1)).max() < np.radians(0.05)
    assert np.allclose(np.unique(scan.origins, axis=0), [T[:3, 3] for T in POSES])
    pieces = list(scan_chunks(tmp_path / "s.e57"))
    assert sum(map(len, pieces)) == len(scan)
    if piece < 1000:
        assert len(pieces) > 2


def test_rows_that_are_no_sweeps_leave_points(tmp_path, local):
    """A registered cloud that kept its indices: its lines are no planes through the origin."""
    scan, *_ = structured(np.random.default_rng(1), None, flagged=False)
    scan["points"] = scan["points"] + (30.0, 2.0, 1.0)
    write_e57(tmp_path / "r.e57", [{k: v for k, v in scan.items() if k != "T"}])
    cloud = read_scan(tmp_path / "r.e57")
    assert isinstance(cloud, PointCloud) and len(cloud) == len(scan["points"])
    back = np.argsort(scan["rowIndex"] * 1000 - scan["columnIndex"], kind="stable")
    write_e57(tmp_path / "b.e57", [{k: v if k == "T" else v[back] for k, v in scan.items()}])
    assert len(read_scan(tmp_path / "b.e57")) == len(scan["points"])


# -- boxes, damage -------------------------------------------------------------------------------------


def test_boxes_keep_what_lies_in_them(tmp_path, monkeypatch, local):
    monkeypatch.setattr(e57, "PIECE", 300)
    write_e57(tmp_path / "a.e57", [{"points": local, "T": POSES[0], "intensity": local[:, 0]}])
    whole = read_scan(tmp_path / "a.e57")
    low = whole.points[:3] - 0.4
    boxes = np.stack([low, low + 0.8], axis=1)
    pieces = list(scan_chunks(tmp_path / "a.e57", ReadOptions(boxes=boxes)))
    inside = ((whole.points[:, None] >= boxes[:, 0]) & (whole.points[:, None] <= boxes[:, 1])).all(2).any(1)
    assert np.array_equal(np.concatenate([p.points for p in pieces]), whole.points[inside])
    assert np.array_equal(np.concatenate([p.intensity for p in pieces]), whole.intensity[inside])


def test_e57_without_pye57_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pye57", None)
    (tmp_path / "c.e57").write_bytes(b"ASTM-E57" + bytes(400))
    with pytest.raises(ScanError, match=r"bimfit\[e57\]"):
        read_scan(tmp_path / "c.e57")


def test_damaged_e57_is_refused_or_read_but_never_crashes(tmp_path, local):
    scan, *_ = structured(np.random.default_rng(0), POSES[0], flagged=True)
    write_e57(tmp_path / "s.e57", [scan, scan])
    write_e57(tmp_path / "p.e57", [{"points": local}])
    rng = np.random.default_rng(8)
    refused = 0
    for name in ("s.e57", "p.e57"):
        data = np.frombuffer((tmp_path / name).read_bytes(), np.uint8)
        for share in (0.001, 0.02, 0.3, 0.9, 0.99):
            (tmp_path / "bad.e57").write_bytes(data[: int(share * len(data))].tobytes())
            with pytest.raises(ScanError) as error:
                read_scan(tmp_path / "bad.e57")
            assert "\n" not in str(error.value) and "bad.e57" in str(error.value)
        for k in range(60):
            bad = data.copy()
            reach = len(bad) if k % 2 else 60
            places = rng.integers(0, reach, rng.integers(1, 4))
            bad[places] = rng.integers(0, 256, len(places))
            if (bad == data).all():
                continue
            (tmp_path / "bad.e57").write_bytes(bad.tobytes())
            try:
                read_scan(tmp_path / "bad.e57")
            except ScanError as error:
                assert "\n" not in str(error)
                refused += 1
    assert refused > 100  # every page has a sum


def test_files_without_scans_or_points(tmp_path):
    write_e57(tmp_path / "n.e57", [])
    with pytest.raises(ScanError, match="no point"):
        read_scan(tmp_path / "n.e57")
    write_e57(tmp_path / "z.e57", [{"points": np.zeros((10, 3))}])
    with pytest.raises(ScanError, match="no point"):
        read_scan(tmp_path / "z.e57")
