"""A moving sensor against motions in closed form: every beam by its own time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import rigid_inverse, transform_points
from bimfit.scan.trajectory import Trajectory, read_tum

NOW = 1_764_170_000.0


def screw(times: np.ndarray, seed: int) -> np.ndarray:
    """Steady speed and a steady turn about one axis of the body: straight line and slerp are exact."""
    rng = np.random.default_rng(seed)
    spin, speed, start = rng.normal(size=3), rng.normal(size=3), rng.uniform(-50, 50, 3)
    first = Rotation.random(rng=rng)
    out = np.zeros((len(times), 4, 4))
    out[:, :3, :3] = (first * Rotation.from_rotvec(times[:, None] * spin)).as_matrix()
    out[:, :3, 3] = start + times[:, None] * speed
    out[:, 3, 3] = 1.0
    return out


def trajectory(times: np.ndarray, poses: np.ndarray) -> Trajectory:
    return Trajectory(times, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat())


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), count=st.integers(2, 30), flip=st.booleans())
def test_a_steady_motion_comes_out_exactly(seed: int, count: int, flip: bool) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 0.4, count))
    way = trajectory(times, screw(times, seed))
    if flip:  # q and -q are one orientation
        signs = rng.choice([-1.0, 1.0], (count, 1))
        way = Trajectory(way.times, way.positions, way.quaternions * signs)
    asked = np.concatenate([rng.uniform(times[0], times[-1], 50), times])
    np.testing.assert_allclose(way.poses(asked), screw(asked, seed), rtol=0, atol=1e-9)


def test_a_curve_is_met_to_its_sagitta() -> None:
    """A circle of 1 m at 1 rad/s, a pose every 20 ms: off by at most h^2 / 8 = 0.05 mm."""

    def ring(t: np.ndarray) -> np.ndarray:
        out = np.tile(np.eye(4), (len(t), 1, 1))
        out[:, :3, :3] = Rotation.from_rotvec(np.outer(t, [0, 0, 1])).as_matrix()
        out[:, :2, 3] = np.column_stack([np.cos(t), np.sin(t)])
        return out

    times = np.arange(0.0, 3.0, 0.02)
    asked = np.random.default_rng(0).uniform(0.0, 2.9, 400)
    found = trajectory(times, ring(times)).poses(asked)
    off = np.linalg.norm((found - ring(asked))[:, :3, 3], axis=1)
    assert 4e-5 < off.max() <= 0.02**2 / 8 + 1e-12
    np.testing.assert_allclose(found[:, :3, :3], ring(asked)[:, :3, :3], atol=1e-12)


def sweeps(seed: int) -> tuple[LineScan, Trajectory, np.ndarray]:
    """Beams of a moving, turning sensor at points that stand still: scan in sensor coordinates, way, points.

    Beams of one sweep lie 29 to 46 ms after its stamp, as those of +-30 degrees do (SCIP.md).
    """
    rng = np.random.default_rng(seed)
    stamps = np.repeat(0.1 * np.arange(12), 171)
    times = NOW + stamps + np.tile(np.linspace(0.029, 0.046, 171), 12)
    ticks = NOW + np.arange(-0.5, 2.0, 0.05)
    way = trajectory(ticks, screw(ticks - NOW, seed))
    poses = screw(times - NOW, seed)
    points = poses[:, :3, 3] + rng.normal(size=(len(times), 3))
    local = np.einsum("nij,nj->ni", np.linalg.inv(poses)[:, :3, :3], points - poses[:, :3, 3])
    ranges = np.linalg.norm(local, axis=1)
    scan = LineScan.of(np.repeat(np.arange(12), 171), np.zeros_like(local), local / ranges[:, None], ranges)
    return LineScan(scan.scan, scan.origins, scan.directions, scan.ranges, extra={"time": times}), way, points


@pytest.mark.parametrize("seed", range(3))
def test_beams_come_back_to_where_they_hit(seed: int) -> None:
    scan, way, points = sweeps(seed)
    out = way.carry(scan)
    # stamps since 1970 are good to 0.2 us, which at 2 m/s is 0.5 um
    np.testing.assert_allclose(out.hits, points, rtol=0, atol=3e-6)
    np.testing.assert_allclose(np.linalg.norm(out.directions, axis=1), 1.0, atol=1e-12)
    at_stamp = LineScan(
        scan.scan, scan.origins, scan.directions, scan.ranges, extra={"time": NOW + 0.1 * scan.scan}
    )
    assert np.linalg.norm(way.carry(at_stamp).hits - points, axis=1).mean() > 0.01


def test_how_the_sensor_sits_on_the_body_goes_first() -> None:
    scan, way, points = sweeps(7)
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_rotvec([0.2, -1.0, 2.0]).as_matrix()
    mount[:3, 3] = 0.1, 0.2, -0.3
    back = np.array([pose @ rigid_inverse(mount) for pose in way.poses(scan.extra["time"])])
    body = trajectory(scan.extra["time"], back)
    np.testing.assert_allclose(body.carry(scan.transformed(mount)).hits, points, rtol=0, atol=3e-6)


def test_tum_files_are_read(tmp_path) -> None:
    path = tmp_path / "way.tum"
    path.write_text(
        "# timestamp tx ty tz qx qy qz qw\n\n1764170000.5 1 2 3 0 0 0 1\n"
        "1764170001.5 3 2 3 0 0 0.70710678 0.70710678\n"
    )
    way = read_tum(path)
    pose = way.poses([NOW + 1.0])[0]
    np.testing.assert_allclose(
        transform_points(pose, [1.0, 0, 0]), [2 + 0.5**0.5, 2 + 0.5**0.5, 3], atol=1e-7
    )
    for delimiter in (",", " "):
        rows = (way.times, *way.positions.T, *way.quaternions.T)
        lines = [delimiter.join(repr(float(x)) for x in row) for row in zip(*rows, strict=True)]
        (tmp_path / "again.csv").write_text("\n".join(lines) + "\n")
        again = read_tum(tmp_path / "again.csv")
        assert np.array_equal(again.times, way.times)
        assert np.array_equal(again.positions, way.positions)
    path.write_text("5 1 2 3 0 0 0 1\n")
    np.testing.assert_allclose(read_tum(path).poses([5.0])[0][:3, 3], [1, 2, 3])


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0\n", "line 2"),
        ("# c\n0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", "line 3: the time is not later"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 1 1\n", "line 2: qx qy qz qw is not of unit length"),
        ("0 0 0 0 0 0 0 0\n", "line 1: qx qy qz qw"),
        ("0 0 0 x 0 0 0 1\n", "line 1"),
        ("0 0 nan 0 0 0 0 1\n", "line 1"),
        ("# only this\n", "no pose"),
        ("\n", "empty"),
    ],
)
def test_damaged_trajectories_are_one_line(tmp_path, text: str, named: str) -> None:
    path = tmp_path / "way.tum"
    path.write_text(text)
    with pytest.raises(ScanError, match=named) as told:
        read_tum(path)
    assert "way.tum" in str(told.value)
    assert "\n" not in str(told.value)


def test_times_outside_are_refused() -> None:
    scan, way, _ = sweeps(1)
    for times in (scan.extra["time"] - 10.0, np.full(len(scan), np.nan)):
        late = LineScan(scan.scan, scan.origins, scan.directions, scan.ranges, extra={"time": times})
        with pytest.raises(ScanError, match="trajectory runs from"):
            way.carry(late)
    bare = LineScan(scan.scan, scan.origins, scan.directions, scan.ranges)
    with pytest.raises(ScanError, match="no column time"):
        way.carry(bare)
