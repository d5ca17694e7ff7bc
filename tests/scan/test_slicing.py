"""Slices against naive masks, closed forms and conserved counts, on boards whose surfaces are known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.line_scan import LineScan, joined
from bimfit.geometry.path import JointPath
from bimfit.scan.cloud import PointCloud
from bimfit.scan.grid import ray_enters
from bimfit.scan.slicing import covers, cut_slices, scan_stations

LENGTH = 0.8
PATH = JointPath(
    np.array([[0.0, 0.0, 0.0], [0.0, LENGTH, 0.0]]), np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, -1.0]])
)
"""Along y; u is x, v is -z: the sensor stands at negative z."""
FLOOR = 1.0
BEARINGS = np.radians(np.arange(-30, 30.1, 0.5))


def sweep(number, y, *, yaw=0.0, pitch=0.0, height=0.25, bearings=BEARINGS):
    """Beams onto the plane z = 0, missing at |x| < 12.5 mm: there every other beam sees the floor."""
    d = np.stack([np.sin(bearings), 0.0 * bearings, np.cos(bearings)], axis=1)
    cp, sp, cy, sy = math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw)
    d = d @ np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]]).T
    d = d @ np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1.0]]).T
    o = np.broadcast_to([0.0, y, -height], d.shape)
    t = height / d[:, 2]
    through = np.abs(o[:, 0] + t * d[:, 0]) < 0.0125
    t = np.where(through, np.where(np.arange(len(t)) % 2, np.nan, (height + FLOOR) / d[:, 2]), t)
    return LineScan.of(np.full(len(d), number), o, d, t)


def sweeps(ys, **kw):
    return joined([sweep(k, y, **kw) for k, y in enumerate(ys)])


def frames_at(stations, path=PATH):
    return [path.rough_frame(float(s)) for s in stations]


def placed(T, frames):
    return [
        SectionFrame(T[:3, :3] @ f.origin + T[:3, 3], *(T[:3, :3] @ a for a in (f.u, f.v, f.n)))
        for f in frames
    ]


STATIONS = np.arange(0.1, 0.71, 0.02)


# -- line scans ----------------------------------------------------------------------------------------


def test_every_transverse_sweep_goes_whole_to_its_station():
    scan = sweeps(STATIONS)
    slices = cut_slices(scan, frames_at(STATIONS), STATIONS)
    assert [s.s for s in slices] == STATIONS.tolist()
    for k, one in enumerate(slices):
        rows = scan.scan == k
        assert one.sweeps == 1
        assert np.array_equal(one.beams.ranges, scan.ranges[rows], equal_nan=True)
        assert np.allclose(one.beams.directions, scan.directions[rows][:, [0, 2]] * (1, -1))
        assert np.allclose(one.viewpoint, (0.0, 0.25))
        assert np.array_equal(one.points, one.beams.points)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.floats(0.09, 0.71), min_size=1, max_size=40),
    st.floats(-8.0, 8.0),
    st.floats(-25.0, 25.0),
    st.sampled_from([0.02, 0.05, 0.11]),
)
def test_no_sweep_is_lost_split_or_used_twice(ys, yaw, pitch, spacing):
    """Against the plain rule: nearest station to where the sweep crosses the joint, within half a spacing."""
    stations = np.arange(0.1, 0.71, spacing)
    pitch, yaw = math.radians(pitch), math.radians(yaw)
    scan = sweeps(ys, yaw=yaw, pitch=pitch)
    # a sweep meets the surface z = 0 in a straight line: where that crosses the joint, x = 0
    d = np.array([scan.directions[scan.scan == k][[0, -1]] for k in range(len(ys))])
    x, y = 0.25 * d[..., 0] / d[..., 2], np.array(ys)[:, None] + 0.25 * d[..., 1] / d[..., 2]
    crossing = y[:, 0] - x[:, 0] * (y[:, 1] - y[:, 0]) / (x[:, 1] - x[:, 0])
    distance = np.abs(crossing[:, None] - stations)
    if np.any(np.abs(distance - 0.5 * spacing) < 1e-6):
        return  # midway: either neighbour will do
    expected = np.where(distance.min(axis=1) < 0.5 * spacing, distance.argmin(axis=1), -1)
    slices = cut_slices(scan, frames_at(stations), stations)
    assert [s.sweeps for s in slices] == [int(np.sum(expected == k)) for k in range(len(stations))]
    for k, one in enumerate(slices):
        assert len(one.beams.ranges) == len(BEARINGS) * np.sum(expected == k)


def test_tilted_beams_are_projected_onto_the_section():
    """Whatever the tilt, returns from the surface v = 0 stay on it, and the floor stays 1 m under it."""
    for yaw, pitch in ((0.1, 0.0), (0.0, 0.4), (-0.12, -0.3)):
        scan = sweeps(STATIONS, yaw=yaw, pitch=pitch)
        slices = cut_slices(scan, frames_at(STATIONS), STATIONS, thickness=10.0)
        points = np.concatenate([s.points for s in slices])
        far = points[:, 1] < -0.5
        assert far.any()
        assert np.allclose(points[~far, 1], 0.0, atol=1e-12)
        assert np.allclose(points[far, 1], -FLOOR, atol=1e-12)
        for s in slices:
            assert np.allclose(np.linalg.norm(s.beams.directions, axis=1), 1.0)


def test_returns_from_behind_the_gap_and_missing_ones_are_kept():
    one = cut_slices(sweeps([0.3]), frames_at([0.3]), [0.3])[0]
    at_gap = np.abs(one.beams.origins[:, 0] + 0.25 * np.tan(BEARINGS)) < 0.0125
    assert np.isnan(one.beams.ranges[at_gap]).any()
    assert (one.beams.ranges[at_gap] > 1.0).any()
    assert len(one.beams.ranges) == len(BEARINGS)


def test_beams_that_pass_elsewhere_or_end_before_the_joint_are_dropped():
    o = np.tile([0.0, 0.3, -1.0], (6, 1))
    d = np.array([(0, 0, 1), (0, 0, 1), (0, 0, 1), (1, 0, 0), (0, 0, -1), (0, 0, 1.0)])
    # surface, stopped on the way, missing, missing aside, missing away, from behind
    r = [1.0, 0.5, np.nan, np.nan, np.nan, 3.0]
    scan = LineScan.of(np.arange(6), o, d, r)
    one = cut_slices(scan, frames_at([0.3]), [0.3], reach=0.2)[0]
    assert np.array_equal(one.beams.ranges, [1.0, np.nan, 3.0], equal_nan=True)


def test_thickness_limits_which_sweeps_share_a_station():
    ys = np.arange(0.1, 0.7, 0.005)
    stations = np.arange(0.15, 0.66, 0.1)
    whole = cut_slices(sweeps(ys), frames_at(stations), stations)
    assert sum(s.sweeps for s in whole) == len(ys)
    thin = cut_slices(sweeps(ys), frames_at(stations), stations, thickness=0.0101)
    assert [s.sweeps for s in thin] == [3] * len(stations)


def naive_split(scan, stations, reach):
    """Beam by beam: where it crosses v = 0, nearest station within half a spacing."""
    half = 0.5 * (stations[1] - stations[0])
    out = [[] for _ in stations]
    for k in range(len(scan)):
        o, d = scan.origins[k], scan.directions[k]
        if d[2] <= 0.05:
            continue
        p = o - d * o[2] / d[2]
        nearest = int(np.argmin(np.abs(p[1] - stations)))
        if abs(p[0]) <= reach and abs(p[1] - stations[nearest]) <= half:
            out[nearest].append(k)
    return out


@pytest.mark.parametrize("yaw", [25.0, 60.0, 90.0])
def test_sweeps_that_do_not_lie_across_are_split_beam_by_beam(yaw):
    ys = np.arange(0.1, 0.7, 0.01)
    scan = sweeps(ys, yaw=math.radians(yaw))
    slices = cut_slices(scan, frames_at(STATIONS), STATIONS, reach=0.15)
    expected = naive_split(scan, STATIONS, 0.15)
    for one, rows in zip(slices, expected, strict=True):
        assert len(one.beams.ranges) == len(rows)
        projected = scan.directions[rows][:, [0, 2]]
        scale = np.linalg.norm(projected, axis=1)
        assert np.allclose(one.beams.ranges, scan.ranges[rows] * scale, equal_nan=True)
    assert sum(len(rows) for rows in expected) > 3000
    assert sum(np.isnan(s.beams.ranges).sum() for s in slices) > 20


def test_a_rotating_scanner_in_one_place():
    """Sweeps in planes through the joint's own direction: hits and misses go where they cross the joint."""
    tilts = np.radians(np.arange(-30, 30.1, 0.5))
    parts = []
    for k, tilt in enumerate(tilts):
        one = sweep(k, 0.4, yaw=math.pi / 2, bearings=np.radians(np.arange(-50, 50.1, 0.25)))
        c, s = math.cos(tilt), math.sin(tilt)
        R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        d = one.directions @ R.T
        t = 0.25 / d[:, 2]
        through = np.abs(t * d[:, 0]) < 0.0125
        parts.append(LineScan.of(one.scan, one.origins, d, np.where(through, np.nan, t)))
    scan = joined(parts)
    slices = cut_slices(scan, frames_at(STATIONS), STATIONS, reach=0.2)
    for one, rows in zip(slices, naive_split(scan, STATIONS, 0.2), strict=True):
        steep = np.linalg.norm(scan.directions[rows][:, [0, 2]], axis=1) < 0.3
        assert len(one.beams.ranges) == len(rows) - steep.sum()
        missing = np.isnan(one.beams.ranges)
        where = one.beams.origins[:, 0] - one.beams.origins[:, 1] * (
            one.beams.directions[:, 0] / one.beams.directions[:, 1]
        )
        assert np.array_equal(missing, np.abs(where) < 0.0125)


def test_a_station_with_whole_sweeps_takes_no_oblique_beams():
    across = sweeps(STATIONS[:10])
    scan = joined([across, sweeps(np.arange(0.1, 0.7, 0.01), yaw=math.pi / 2)])
    slices = cut_slices(scan, frames_at(STATIONS), STATIONS)
    assert [s.sweeps for s in slices[:10]] == [1] * 10
    assert all(len(s.beams.ranges) == len(BEARINGS) for s in slices[:10])
    assert all(len(s.beams.ranges) > 0 for s in slices[12:])


def test_slices_do_not_depend_on_where_the_world_is():
    angle = 0.7
    T = np.eye(4)
    T[:3, :3] = np.array(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    )
    T[:3, :3] = T[:3, :3] @ np.array([[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]])
    T[:3, 3] = (458657.0, 5438232.0, 12.0)
    for yaw in (0.05, 0.8):
        scan = sweeps(STATIONS, yaw=yaw)
        here = cut_slices(scan, frames_at(STATIONS), STATIONS)
        there = cut_slices(scan.transformed(T), placed(T, frames_at(STATIONS)), STATIONS)
        for a, b in zip(here, there, strict=True):
            assert np.allclose(a.points, b.points, atol=1e-8)
            assert np.allclose(a.beams.ranges, b.beams.ranges, atol=1e-8, equal_nan=True)


def test_sections_of_an_arc_are_radial():
    """A quarter ring of radius 2 m scanned by radial sweeps: each its own station, and all alike."""
    radius = 2.0
    angles = np.linspace(0.0, math.pi / 2, 46)
    points = radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    middle = 0.5 * (angles[1:] + angles[:-1])
    u = np.stack([np.cos(middle), np.sin(middle), 0 * middle], axis=1)
    path = JointPath(points, u, np.tile([0.0, 0.0, -1.0], (45, 1)))
    parts = []
    turns = np.linspace(0.05, 1.5, 30)
    for k, a in enumerate(turns):
        c, s = math.cos(a), math.sin(a)
        T = np.array([[c, -s, 0, radius * c], [s, c, 0, radius * s], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        one = sweep(k, 0.0).transformed(T)
        parts.append(LineScan.of(np.full(len(one), k), one.origins, one.directions, one.ranges))
    scan = joined(parts)
    stations = scan_stations(scan, path)
    assert np.allclose(stations, turns * radius, atol=2e-3)
    slices = cut_slices(scan, [path.rough_frame(float(s)) for s in stations], stations)
    for one in slices:
        assert one.sweeps == 1
        # a facet of 70 mm sags by 0.3 mm
        assert np.allclose(one.beams.origins, (0.0, 0.25), atol=1e-3)
        assert np.nanmax(np.abs(one.points[one.points[:, 1] > -0.5][:, 1])) < 1e-9
    assert covers(scan, path) > 0.9


def test_nothing_gives_empty_slices():
    empty = LineScan.of([], [], [], [])
    far = sweeps(STATIONS).transformed(np.array([[1, 0, 0, 50.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    for scan in (empty, far, PointCloud(np.zeros((0, 3)))):
        slices = cut_slices(scan, frames_at(STATIONS), STATIONS)
        assert len(slices) == len(STATIONS)
        assert all(len(s.points) == 0 for s in slices)
        assert len(scan_stations(scan, PATH)) == 0
        assert covers(scan, PATH) == 0.0
    assert cut_slices(far, [], []) == ()
    with pytest.raises(ValueError, match="1 frames but 2 stations"):
        cut_slices(far, frames_at([0.1]), [0.1, 0.2])


# -- clouds --------------------------------------------------------------------------------------------


def naive_slabs(points, frames, thick, reach):
    out = []
    for f in frames:
        p = (points - f.origin) @ np.stack([f.u, f.v, f.n], axis=1)
        out.append(p[(np.abs(p[:, :2]) <= reach).all(axis=1) & (np.abs(p[:, 2]) <= thick / 2), :2])
    return out


@pytest.mark.parametrize("thickness", [0.004, 0.02, 0.07])
def test_slabs_agree_with_a_mask_a_station(thickness):
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.5, -0.2, -0.5), (0.5, 1.0, 0.5), (20_000, 3))
    cloud = PointCloud(points, viewpoint=np.array([0.1, 5.0, -2.0]))
    slices = cut_slices(cloud, frames_at(STATIONS), STATIONS, thickness=thickness, reach=0.25)
    total = 0
    for one, expected in zip(slices, naive_slabs(points, frames_at(STATIONS), thickness, 0.25), strict=True):
        order = [np.lexsort(p.T) for p in (one.points, expected)]
        assert np.allclose(one.points[order[0]], expected[order[1]], atol=1e-12)
        assert one.beams is None
        assert np.allclose(one.viewpoint, (0.1, 2.0))
        total += len(expected)
    assert total > 500


def test_by_default_slabs_share_the_cloud_out_between_them():
    rng = np.random.default_rng(1)
    points = rng.uniform((-0.2, 0.09, -0.2), (0.2, 0.71, 0.2), (5000, 3))
    slices = cut_slices(PointCloud(points), frames_at(STATIONS), STATIONS)
    inside = (points[:, 1] > STATIONS[0] - 0.01) & (points[:, 1] < STATIONS[-1] + 0.01)
    assert sum(len(s.points) for s in slices) == inside.sum()
    assert all(s.viewpoint is None for s in slices)


def test_slabs_on_a_bent_path_agree_with_a_mask_a_station():
    rng = np.random.default_rng(2)
    corner = JointPath(
        np.array([[0, 0, 0], [0, 0.5, 0], [-0.5, 0.5, 0.0]]),
        np.array([[1, 0, 0], [0, 1, 0.0]]),
        np.tile([0.0, 0.0, -1.0], (2, 1)),
    )
    stations = np.array([0.1, 0.2, 0.3, 0.7, 0.8, 0.9])
    frames = frames_at(stations, corner)
    points = rng.uniform((-0.6, -0.1, -0.1), (0.1, 0.6, 0.1), (20_000, 3))
    slices = cut_slices(PointCloud(points), frames, stations, thickness=0.01, reach=0.05)
    for one, expected in zip(slices, naive_slabs(points, frames, 0.01, 0.05), strict=True):
        assert len(one.points) == len(expected) > 5


# -- stations ------------------------------------------------------------------------------------------


def test_a_station_a_sweep_and_close_sweeps_share_one():
    ys = np.array([0.10, 0.1004, 0.1008, 0.15, 0.20, 0.2005])
    assert np.allclose(scan_stations(sweeps(ys), PATH), [0.1004, 0.15, 0.20025])


def test_sweeps_off_the_joints_ends_make_no_station():
    ys = np.array([-0.1, -0.02, -1e-9, 0.02, 0.04, LENGTH - 0.01, LENGTH + 0.005, LENGTH + 0.05])
    assert np.allclose(scan_stations(sweeps(ys), PATH), [0.0, 0.02, 0.04, LENGTH - 0.01, LENGTH], atol=1e-8)


def test_a_given_spacing_is_kept_where_the_scan_is():
    stations = scan_stations(sweeps(np.arange(0.2, 0.41, 0.01)), PATH, 0.05)
    assert np.allclose(stations, [0.2, 0.25, 0.3, 0.35, 0.4])
    assert np.allclose(scan_stations(sweeps(np.arange(0, 0.81, 0.01)), PATH, 0.1), np.arange(9) * 0.1)
    cloud = PointCloud(sweeps(np.arange(0.2, 0.41, 0.01)).hits)
    assert np.allclose(scan_stations(cloud, PATH, 0.05), [0.2, 0.25, 0.3, 0.35, 0.4])


def test_slices_of_a_cloud_get_enough_points():
    rng = np.random.default_rng(3)
    for count in (400, 4000, 400_000):
        points = rng.uniform((-0.2, 0.1, -0.01), (0.2, 0.7, 0.01), (count, 3))
        stations = scan_stations(PointCloud(points), PATH)
        slices = cut_slices(PointCloud(points), frames_at(stations), stations)
        sizes = [len(s.points) for s in slices]
        assert np.all(np.diff(stations) >= 0.9e-3)
        assert 0.1 < stations[0] < stations[-1] < 0.7
        assert np.median(sizes) >= 35
        if count == 4000:
            assert np.median(sizes) < 60


def test_coverage_is_the_share_of_the_length():
    assert covers(sweeps(np.arange(0, 0.81, 0.01)), PATH) == 1.0
    assert covers(sweeps(np.arange(0, 0.41, 0.01)), PATH) == pytest.approx(0.5, abs=0.05)
    assert covers(sweeps(np.arange(0, 0.81, 0.1)), PATH) == 1.0  # far apart, yet all along
    cloud = PointCloud(sweeps(np.arange(0.2, 0.61, 0.002)).hits)
    assert covers(cloud, PATH) == pytest.approx(0.5, abs=0.06)
    beyond = PointCloud(cloud.points + np.array([0.0, 2.0, 0.0]))
    assert covers(beyond, PATH) == 0.0
    assert covers(PointCloud(cloud.points + np.array([0.0, 0.0, 0.5])), PATH) == 0.0


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_rays_enter_boxes_where_shapely_says(seed):
    import shapely

    rng = np.random.default_rng(seed)
    o, d = rng.uniform(-3, 3, 2), rng.normal(size=2)
    d = np.array([[1, 0], [0, 1], [-1, 0], d / np.linalg.norm(d)][seed % 4], float)
    enters = ray_enters(o[None], d[None], (-1, -1), (1, 1))[0]
    met = shapely.intersection(shapely.LineString([o, o + 20 * d]), shapely.box(-1, -1, 1, 1))
    if met.is_empty:
        assert enters == np.inf
    else:
        assert enters == pytest.approx(shapely.distance(shapely.Point(o), met), abs=1e-9)


@pytest.mark.parametrize("pitch", [0.006, 0.010, 0.013, 0.030])
@pytest.mark.parametrize("smear", [0.0, 0.06])
def test_a_cloud_in_rows_across_the_joint_has_a_station_a_row(pitch, smear):
    rng = np.random.default_rng(1)
    rows = np.arange(0.05, 0.75, pitch)
    s = np.repeat(rows, 150) + smear * pitch * rng.uniform(-1.0, 1.0, 150 * len(rows))
    points = np.column_stack([rng.uniform(-0.2, 0.2, len(s)), s, np.zeros(len(s))])
    stations = scan_stations(PointCloud(points), PATH)
    assert len(stations) == len(rows)
    np.testing.assert_allclose(stations, rows, atol=5e-4)


def test_a_hole_in_a_cloud_is_not_taken_for_rows():
    rng = np.random.default_rng(1)
    s = rng.uniform(0.0, LENGTH, 40_000)
    points = np.column_stack([rng.uniform(-0.2, 0.2, len(s)), s, np.zeros(len(s))])
    whole, holed = (scan_stations(PointCloud(p), PATH) for p in (points, points[(s < 0.3) | (s > 0.6)]))
    np.testing.assert_allclose(np.diff(holed), np.diff(whole).mean(), rtol=0.01)
