import dataclasses

import numpy as np
import pytest
import shapely
import trimesh

from bimfit.errors import ConfigError
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile
from bimfit.simulation.motion import random_truth
from bimfit.simulation.rangefinder import cast, correlated_noise, inside, measured, simulate_scan
from bimfit.simulation.scenario import Scenario

CLEAN = Scenario(sigma=0.0)


def stars(rng, count):
    """Random star-shaped polygons, some with a hole, beside one another."""
    out = []
    for k in range(count):
        angle = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(4, 12)))
        radius = rng.uniform(0.05, 0.15, len(angle))
        loop = np.stack([0.4 * k + radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        hole = [(0.4 * k + 0.01, 0.0), (0.4 * k - 0.01, 0.005), (0.4 * k - 0.01, -0.005)]
        shape = shapely.Polygon(loop)
        if shape.is_valid and shape.contains(shapely.Polygon(hole)):
            out.append(Profile.polygon(loop, holes=[hole]))
        elif shape.is_valid:
            out.append(Profile.polygon(loop))
    return out


@pytest.mark.parametrize("seed", range(5))
def test_cast_agrees_with_shapely(seed):
    rng = np.random.default_rng(seed)
    profiles = stars(rng, 3)
    origins = rng.uniform((-0.5, 0.2), (1.3, 0.6), (60, 2))
    angle = rng.uniform(0, 2 * np.pi, 60)
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    seen = cast(profiles, origins, directions)
    rings = shapely.union_all([shapely.linearrings(loop) for p in profiles for loop in p.loops])
    for k in range(60):
        ray = shapely.LineString([origins[k], origins[k] + 5.0 * directions[k]])
        met = shapely.intersection(ray, rings)
        if met.is_empty:
            assert seen.ranges[k] == np.inf
            assert seen.profile[k] == seen.edge[k] == -1
            continue
        assert seen.ranges[k] == pytest.approx(shapely.distance(shapely.Point(origins[k]), met), abs=1e-9)
        edge = profiles[seen.profile[k]].edges[seen.edge[k]]
        end = shapely.Point(origins[k] + directions[k] * seen.ranges[k])
        assert shapely.distance(end, shapely.LineString(edge)) < 1e-9


def test_no_ray_slips_through_a_corner():
    square = Profile.polygon([(-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)])
    corners = square.loops[0][np.abs(square.loops[0][:, 1] - 0.1) < 1e-12]
    eye = np.array([0.013, 0.77])
    way = (corners - eye) / np.linalg.norm(corners - eye, axis=1, keepdims=True)
    seen = cast([square], np.broadcast_to(eye, way.shape), way)
    assert np.allclose(seen.ranges, np.linalg.norm(corners - eye, axis=1), atol=1e-9)


def test_a_scan_agrees_with_embree_on_the_moved_boards(joint):
    """The whole way to world coordinates, against boxes in 3D and someone else's ray caster (in float32)."""
    import open3d

    sections = joint([0.1, 0.3])
    truth = random_truth(sections, Scenario(), 2)
    scan = simulate_scan(sections, truth, CLEAN, 2)
    for number, (section, station) in enumerate(zip(sections, truth.stations, strict=True)):
        rows = scan.scan == number
        scene = open3d.t.geometry.RaycastingScene()
        for profile, pose in zip(section.components, station.components, strict=True):
            low, high = profile.bounds
            box = trimesh.creation.box(bounds=[[low[0], -0.5, low[1]], [high[0], 0.5, high[1]]])
            # designed boards lie in world x, z as they do in u, v
            box.apply_transform(section.frame.lift(pose))
            scene.add_triangles(box.vertices.astype(np.float32), box.faces.astype(np.uint32))
        rays = np.hstack([scan.origins[rows], scan.directions[rows]]).astype(np.float32)
        best = scene.cast_rays(open3d.core.Tensor(rays))["t_hit"].numpy()
        got = np.where(np.isnan(scan.ranges[rows]), np.inf, scan.ranges[rows])
        assert np.array_equal(np.isinf(got), np.isinf(best))
        assert np.allclose(got, best, atol=1e-6)
        assert np.isinf(got).any()
        assert np.isfinite(got).sum() > 100


def test_the_sensor_stands_over_the_design_whatever_has_moved(joint):
    sections = joint([0.1, 0.3], origin=(458657.0, 5438232.0, 12.0))
    scan = simulate_scan(sections, random_truth(sections, Scenario(), 2), Scenario(), 2)
    assert np.allclose(scan.origins[scan.scan == 1], (458657.0, 5438231.7, 12.25), atol=1e-9)
    assert np.allclose(np.linalg.norm(scan.directions, axis=1), 1.0, atol=1e-14)
    # sweeps lie in the section: nothing along y
    assert np.abs(scan.directions[:, 1]).max() < 1e-15
    assert np.all(np.diff(scan.directions[scan.scan == 0][:, 0]) > 0)


def test_noise_has_the_asked_deviation_and_correlation(joint):
    sections = joint(Scenario().stations(0.82))
    truth = random_truth(sections, Scenario(), 4)
    exact = simulate_scan(sections, truth, CLEAN, 4)
    for rho in (0.0, 0.5):
        noisy = simulate_scan(sections, truth, Scenario(correlation=rho), 4)
        error = (noisy.ranges - exact.ranges).reshape(83, 171)
        assert np.nanstd(error) == pytest.approx(0.003, rel=0.03)
        assert np.nanmean(error) == pytest.approx(0.0, abs=0.0002)
        pairs = error[:, 1:] * error[:, :-1]
        assert np.nanmean(pairs) / 0.003**2 == pytest.approx(rho, abs=0.04)
        # sweeps are independent of one another
        assert np.nanmean(error[1:] * error[:-1]) / 0.003**2 == pytest.approx(0.0, abs=0.04)


def test_correlated_noise_is_stationary_from_its_first_sample():
    rng = np.random.default_rng(0)
    noise = np.array([correlated_noise(rng, 6, 0.8) for _ in range(20_000)])
    assert np.allclose(noise.std(axis=0), 1.0, atol=0.03)
    lags = np.corrcoef(noise.T)[0]
    assert np.allclose(lags, 0.8 ** np.arange(6), atol=0.03)


def test_dropouts_and_outliers_come_in_their_share():
    rng = np.random.default_rng(1)
    true = np.where(np.arange(60_000) % 4 == 0, np.inf, 0.3)
    ranges = measured(true, Scenario(dropouts=0.1, outliers=0.05), rng)
    hit = np.isfinite(true)
    stray = np.isfinite(ranges) & (np.abs(ranges - 0.3) > 0.02)
    assert np.isnan(ranges[hit]).mean() == pytest.approx(0.1 * 0.95, abs=0.006)
    assert stray.mean() == pytest.approx(0.05, abs=0.004)
    # strays come from anywhere in range, also where nothing would have been met
    assert np.isfinite(ranges[~hit]).mean() == pytest.approx(0.05, abs=0.006)
    assert ranges[stray].mean() == pytest.approx((0.02 + 5.6) / 2, rel=0.05)


def test_nothing_comes_back_from_beyond_the_sensors_range():
    rng = np.random.default_rng(1)
    ranges = measured(np.array([0.01, 0.03, 5.5, 5.7, np.inf]), Scenario(sigma=0.0), rng)
    assert np.array_equal(np.isfinite(ranges), [False, True, True, False, False])


def test_the_same_seed_gives_the_same_bits_and_another_seed_other_noise(joint):
    sections = joint(np.arange(5) * 0.01)
    truth = random_truth(sections, Scenario(), 4)
    one, same, other = (simulate_scan(sections, truth, Scenario(), seed) for seed in (4, 4, 5))
    assert np.array_equal(one.ranges, same.ranges, equal_nan=True)
    assert not np.array_equal(one.ranges, other.ranges, equal_nan=True)


def test_settings_do_not_shift_one_anothers_draws(joint):
    """Losing returns leaves the ranges of the others as they were."""
    sections = joint(np.arange(5) * 0.01)
    truth = random_truth(sections, Scenario(), 4)
    full = simulate_scan(sections, truth, Scenario(), 4).ranges
    thinned = simulate_scan(sections, truth, Scenario(dropouts=0.3), 4).ranges
    kept = np.isfinite(thinned)
    assert np.array_equal(thinned[kept], full[kept])
    assert 0.6 < kept.sum() / np.isfinite(full).sum() < 0.8


def test_a_sensor_inside_a_component_is_refused(joint):
    sections = joint([0.0])
    truth = random_truth(sections, Scenario(motion="none"), 1)
    lifted = (Pose2D(u=0.05, v=0.26), Pose2D())  # A's upper face is now 10 mm over the sensor
    moved = dataclasses.replace(truth.stations[0], components=lifted)
    with pytest.raises(ConfigError, match="inside a component"):
        simulate_scan(sections, dataclasses.replace(truth, stations=(moved,)), Scenario(), 1)


def test_inside_agrees_with_shapely():
    rng = np.random.default_rng(3)
    for profile in stars(rng, 4):
        shape = shapely.Polygon(profile.loops[0], list(profile.loops[1:]))
        low, high = profile.bounds
        for point in rng.uniform(low - 0.01, high + 0.01, (200, 2)):
            assert inside(profile, point) == shape.contains(shapely.Point(point))
