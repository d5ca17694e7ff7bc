"""Where a scan lies: in pieces as whole, in project and in map coordinates, in the wrong unit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bimfit.scan.formats.las as las
from bimfit.bim.georeference import GeoReference
from bimfit.config import Config, SliceConfig
from bimfit.errors import ScanError
from bimfit.pipeline.placing import Placing, place_scan
from bimfit.pipeline.simulate import simulate
from bimfit.pipeline.survey import cut_joint, model_joints, part_of
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import scaled, write_scan
from bimfit.scan.formats.options import ReadOptions
from bimfit.simulation.scenario import Scenario

SAMPLES = Path(__file__).parents[2] / "ifc_samples"
CONFIG = Config(slices=SliceConfig(spacing=0.07))
MAP = GeoReference("EPSG:25832", 458_657.0, 5_438_232.0, 117.5, 0.73, 0.9996)


@pytest.fixture(scope="module")
def scene():
    """The facade with its longest joint, and a line scan of it in project coordinates."""
    model, joints = model_joints(SAMPLES / "facade.ifc", Config().joints)
    chosen = sorted((j for j in joints if j.state == "open"), key=lambda j: -j.length)[:1]
    names = [joint.id for joint in chosen]
    scan, _ = simulate(SAMPLES / "facade.ifc", Scenario(), 5, joints=names)
    return model, chosen, scan


@pytest.fixture(scope="module")
def cloud(scene):
    """The scan's returns amid points of all the site, in steps of 0.1 mm, in no order."""
    rng = np.random.default_rng(1)
    clutter = rng.uniform(*scene[0].bounds, (20_000, 3))
    points = np.concatenate([scene[2].hits, clutter])
    return PointCloud(np.round(rng.permutation(points), 4))


def cuts(path, scene, placing=None):
    model, joints, _ = scene
    placed = place_scan(path, model, joints, CONFIG, placing or Placing())
    parts = [part_of(placed.nearby, joint, CONFIG) for joint in joints]
    return placed, [
        cut_joint(model, joint, part, CONFIG)[2] for joint, part in zip(joints, parts, strict=True)
    ]


def write_las(points: np.ndarray, path: Path) -> None:
    import laspy

    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 1e-4), np.floor(points.min(axis=0))
    record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    record.x, record.y, record.z = points.T
    with laspy.open(path, "w", header=header) as writer:
        writer.write_points(record)


def same(one, two, tolerance: float) -> None:
    for slices_a, slices_b in zip(one, two, strict=True):
        assert len(slices_a) == len(slices_b) > 3
        for a, b in zip(slices_a, slices_b, strict=True):
            assert a.s == pytest.approx(b.s, abs=max(tolerance, 1e-12))
            np.testing.assert_allclose(a.points, b.points, rtol=0, atol=tolerance)


def test_slices_are_the_same_whatever_the_format_and_the_pieces(tmp_path, monkeypatch, scene, cloud) -> None:
    write_scan(cloud, tmp_path / "whole.npz")
    first, whole = cuts(tmp_path / "whole.npz", scene)
    assert sum(len(s.points) for joint in whole for s in joint) > 5000
    for suffix in ("ply", "xyz"):
        write_scan(cloud, tmp_path / f"c.{suffix}")
        same(cuts(tmp_path / f"c.{suffix}", scene)[1], whole, 0.0)
    for suffix in ("las", "laz"):
        write_las(cloud.points, tmp_path / f"c.{suffix}")
        monkeypatch.setattr(las, "_CHUNK", 10**9)
        placed, once = cuts(tmp_path / f"c.{suffix}", scene)
        near = placed.nearby.scan.points
        np.testing.assert_allclose(near, first.nearby.scan.points, rtol=0, atol=1e-9)
        for size in (701, 20_000):
            monkeypatch.setattr(las, "_CHUNK", size)
            same(cuts(tmp_path / f"c.{suffix}", scene)[1], once, 0.0)


@pytest.mark.parametrize(("form", "scale"), [("beams", 0.9996), ("cloud", 1.0), ("las", 0.9996)])
def test_map_and_project_coordinates_find_the_same_place(tmp_path, scene, cloud, form, scale) -> None:
    """To far better than 0.1 mm at large eastings, by choice and of itself, and it is said."""
    place = replace(MAP, scale=scale)
    model = replace(scene[0], georeference=place)
    scene = (model, *scene[1:])
    shift = np.array([place.eastings, place.northings, place.height])
    if form == "beams":
        own = scene[2]
        away = scaled(own, scale)
        T = place.T_map_project.copy()
        T[:3, :3] /= scale
        away = away.transformed(T)
        assert np.abs(away.hits - shift).max() < 200.0
    else:
        own = cloud
        away = PointCloud(place.to_map(cloud.points))
    for name, scan in (("project", own), ("map", away)):
        if form == "las":
            write_las(scan.points, tmp_path / f"{name}.las")
        else:
            write_scan(scan, tmp_path / f"{name}.npz")
    suffix = "las" if form == "las" else "npz"
    expected = cuts(tmp_path / f"project.{suffix}", scene, Placing(crs="project"))[1]
    tolerance = 1.2e-4 if form == "las" else 1e-7  # LAS: both files are rounded to 0.1 mm
    for crs in ("auto", "map"):
        placed, found = cuts(tmp_path / f"map.{suffix}", scene, Placing(crs=crs))
        assert placed.crs == "map"
        assert any("map coordinates (EPSG:25832)" in note for note in placed.notes)
        if form != "las":
            same(found, expected, tolerance)
        near = placed.nearby.scan
        points = near.points if form != "beams" else near.hits
        back = place.to_map(points)
        from scipy.spatial import cKDTree

        assert cKDTree(away.points if form != "beams" else away.hits).query(back)[0].max() < tolerance
    placed, found = cuts(tmp_path / f"project.{suffix}", scene)
    assert placed.crs == "project"
    same(found, expected, 0.0)
    with pytest.raises(ScanError, match=r"far from the model.*map coordinates"):
        cuts(tmp_path / f"project.{suffix}", scene, Placing(crs="map"))


def test_a_pose_may_lead_to_the_map(tmp_path, scene) -> None:
    """A scanner levelled up over a survey point: its pose is known in map coordinates."""
    from bimfit.geometry.pose import rigid_inverse

    place = replace(MAP, scale=1.0)
    model = replace(scene[0], georeference=place)
    pose = np.array([[0, -1, 0, 458_660.0], [1, 0, 0, 5_438_230.0], [0, 0, 1, 119.0], [0, 0, 0, 1.0]])
    away = scene[2].transformed(rigid_inverse(pose) @ place.T_map_project)
    write_scan(scene[2], tmp_path / "own.npz")
    write_scan(away, tmp_path / "away.npz")
    expected = cuts(tmp_path / "own.npz", scene)[1]
    placed, found = cuts(tmp_path / "away.npz", (model, *scene[1:]), Placing(pose))
    assert placed.crs == "map"
    same(found, expected, 1e-7)
    np.testing.assert_allclose(
        placed.T_world_file, rigid_inverse(place.T_map_project) @ pose, rtol=0, atol=1e-8
    )


def test_a_model_without_conversion_says_so(tmp_path, scene) -> None:
    write_scan(scene[2], tmp_path / "own.npz")
    model = replace(scene[0], georeference=None)
    with pytest.raises(ScanError, match="map conversion"):
        cuts(tmp_path / "own.npz", (model, *scene[1:]), Placing(crs="map"))
    placed, _ = cuts(tmp_path / "own.npz", (model, *scene[1:]))
    assert placed.crs == "project"
    assert not any("coordinates" in note for note in placed.notes)


@pytest.mark.parametrize(
    ("factor", "word", "on_map"),
    [(1000.0, "mm", False), (1000.0, "mm", True), (100.0, "cm", False), (1 / 0.3048, "ft", True)],
)
def test_a_scan_in_another_unit_is_named(tmp_path, scene, cloud, factor, word, on_map) -> None:
    model = replace(scene[0], georeference=MAP)
    points = MAP.to_map(cloud.points) if on_map else cloud.points
    write_scan(PointCloud(points * factor), tmp_path / "c.npz")
    with pytest.raises(ScanError, match="lengths are") as told:
        cuts(tmp_path / "c.npz", (model, *scene[1:]))
    assert f"--scan-unit {word}" in str(told.value)
    placed, _ = cuts(tmp_path / "c.npz", (model, *scene[1:]), Placing(options=ReadOptions(1.0 / factor)))
    assert placed.crs == ("map" if on_map else "project")


def test_a_model_in_another_unit_is_named(tmp_path, scene, cloud) -> None:
    """A model whose millimetres were written as metres notes that itself; the scan is then not blamed."""
    note = "half of its elements measure more than 800 m: is its unit millimetre, not metre?"
    grown = replace(scene[0], notes=(note,), georeference=None)
    write_scan(PointCloud(cloud.points * 1e-3), tmp_path / "c.npz")
    with pytest.raises(ScanError, match="length unit in the model"):
        cuts(tmp_path / "c.npz", (grown, *scene[1:]))


def test_a_moving_sensor_is_placed_by_each_beams_own_time(tmp_path, scene) -> None:
    """The same slices as from the scan in world coordinates; from a file with a column time."""
    from scipy.spatial.transform import Rotation

    from bimfit.geometry.pose import rigid_inverse
    from bimfit.scan.trajectory import Trajectory

    scan = scene[2]
    times = 100.0 + 0.1 * scan.scan + np.tile(np.linspace(0.029, 0.046, 171), len(scan) // 171)
    ticks = np.arange(99.0, times.max() + 1.0, 0.25)
    turns = Rotation.from_rotvec(np.outer(ticks, [0.02, -0.01, 0.03]))
    way = Trajectory(ticks, np.outer(ticks, [0.05, 0.0, 0.01]) + 3.0, turns.as_quat())
    inverse = np.array([rigid_inverse(pose) for pose in way.poses(times)])
    own = replace(scan.laid_out(inverse), extra={"time": times})
    write_scan(scan, tmp_path / "world.npz")
    write_scan(own, tmp_path / "own.csv")
    _, found = cuts(tmp_path / "own.csv", scene, Placing(trajectory=way))
    same(found, cuts(tmp_path / "world.npz", scene)[1], 1e-9)
    write_scan(PointCloud(scan.hits), tmp_path / "cloud.ply")
    with pytest.raises(ScanError, match="cloud of points"):
        cuts(tmp_path / "cloud.ply", scene, Placing(trajectory=way))


def test_a_scan_off_by_centimetres_and_degrees_is_aligned(tmp_path) -> None:
    """Its slices lie then where those of the scan in place lie, and the results say how that was proven."""
    import math

    from bimfit.pipeline.aligning import alignment_to_dict, describe_alignment
    from bimfit.pipeline.survey import shown_joints
    from bimfit.registration.alignment import AlignConfig
    from bimfit.registration.rigid_3d import about

    path = SAMPLES / "t-joint.ifc"
    model, joints = model_joints(path, Config().joints)
    still = Scenario(motion="none", spacing=0.02)
    scan, _ = simulate(path, still, 3)
    off = about(scan.bounds.mean(axis=0), [0.03, -0.02, 0.035], np.radians([1.5, -2.0, 1.0]))
    write_scan(scan.transformed(off), tmp_path / "off.npz")
    align = AlignConfig(blur=0.012, points=400)
    placed, chosen = shown_joints(
        tmp_path / "off.npz", model, joints, CONFIG, Placing(align=align), asked=False
    )
    (joint,) = chosen
    found = placed.alignment
    hits = placed.nearby.scan.hits
    along = joint.path.leg_directions[0]
    across = (hits - scan.hits) - ((hits - scan.hits) @ along)[:, None] * along
    assert np.sqrt(np.mean(np.sum(across**2, axis=1))) < 0.003
    np.testing.assert_allclose(placed.T_world_file, found.T_model_scan)
    plain = alignment_to_dict(found)
    assert plain["stop"] in ("proven", "tolerance")
    assert plain["bound"] >= plain["score"] > 0.7 * plain["points"]
    assert plain["window"] == {"shift": 0.05, "turn": math.radians(3.0)}
    line = describe_alignment(found)
    assert "gap" in line
    assert "bound" in line
    assert cut_joint(model, joint, part_of(placed.nearby, joint, CONFIG), CONFIG)[2]
