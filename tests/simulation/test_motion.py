import dataclasses
import math

import numpy as np
import pytest
import shapely

from bimfit.geometry.pose import Pose2D
from bimfit.simulation.motion import random_truth
from bimfit.simulation.scenario import Scenario
from bimfit.simulation.truth import gap_truth

STATIONS = Scenario().stations(0.82)
KINDS = ("piecewise", "const", "rigid", "linear", "bent")


def parameters(truth, sections):
    """Common motion, and each component's own about its mouth corner, (k, 9), recovered from the poses."""
    rows = []
    for station, section in zip(truth.stations, sections, strict=True):
        row = list(station.common.as_array())
        for pose, corner in zip(station.components, section.gap.mouth, strict=True):
            own = station.common.inverse() @ pose
            row += [*(own.apply(corner) - corner), own.theta]
        rows.append(row)
    return np.array(rows)


@pytest.mark.parametrize("kind", KINDS)
def test_every_parameter_stays_in_its_range(joint, kind):
    sections = joint(STATIONS)
    limits = np.array([0.020, 0.020, math.radians(5.0)] + 2 * [0.006, 0.006, math.radians(3.0)])
    if kind == "bent":
        limits[:3] = 0.010 + 0.005, 0.010 + 0.005, math.radians(2.5)
    seen = np.zeros(9)
    for seed in range(20):
        p = parameters(random_truth(sections, Scenario(motion=kind), seed), sections)
        seen = np.maximum(seen, np.abs(p).max(axis=0))
    assert np.all(seen <= limits + 1e-12)
    assert np.all(seen >= 0.5 * limits)  # the ranges are used, not just respected


def test_piecewise_motion_bends_at_the_transition_slices_alone(joint):
    sections = joint(STATIONS)
    p = parameters(random_truth(sections, Scenario(), 3), sections)
    bends = np.abs(np.diff(p, n=2, axis=0)).max(axis=1) > 1e-9
    assert 5 <= np.count_nonzero(bends) <= 10  # neighbouring knots are rare; 10 inner ones were drawn


@pytest.mark.parametrize(("kind", "order"), [("const", 1), ("linear", 2), ("bent", 3)])
def test_smooth_motions_are_polynomials(joint, kind, order):
    sections = joint(STATIONS)
    p = parameters(random_truth(sections, Scenario(motion=kind), 5), sections)
    assert np.abs(np.diff(p, n=order, axis=0)).max() < 1e-12
    assert np.abs(np.diff(p, n=order - 1, axis=0)).max() > 1e-9


def test_a_rigid_body_drifts_without_turning(joint):
    sections = joint(STATIONS)
    p = parameters(random_truth(sections, Scenario(motion="rigid"), 5), sections)
    assert np.ptp(p[:, 2::3], axis=0).max() < 1e-12
    assert np.ptp(p[:, 0]) > 1e-4


def test_none_leaves_the_design(joint):
    sections = joint(STATIONS)
    truth = random_truth(sections, Scenario(motion="none"), 1)
    assert all(pose == Pose2D() for station in truth.stations for pose in station.components)
    for station in truth.stations:
        assert station.gap.angle == 0.0
        assert station.gap.area == pytest.approx(0.025**2)
        assert np.allclose(station.gap.origin, station.frame.origin)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("gap", [0.003, 0.010, 0.025])
def test_components_never_overlap(joint, kind, gap):
    sections = joint(STATIONS[::9], gap=gap, depth=0.2)
    for seed in range(5):
        truth = random_truth(sections, Scenario(motion=kind), seed)
        for section, station in zip(sections, truth.stations, strict=True):
            a, b = (
                shapely.Polygon(profile.moved(pose).loops[0])
                for profile, pose in zip(section.components, station.components, strict=True)
            )
            assert shapely.intersection(a, b).area == 0.0
            assert station.gap.width_narrowest == pytest.approx(shapely.distance(a, b), abs=1e-12)
            assert station.gap.width_narrowest >= 0.1 * gap


def test_gap_truth_of_a_gap_worked_out_by_hand(joint):
    section = joint([0.4], origin=(10.0, 20.0, 30.0))[0]
    # A goes 2 mm down; B moves 1 mm away and turns by 90 degrees about its mouth corner
    gap = gap_truth(section, Pose2D(v=-0.002), Pose2D.about(section.gap.mouth[1], u=0.001, theta=math.pi / 2))
    assert np.allclose(gap.origin, [10.0005, 19.6, 29.999], atol=1e-12)
    assert gap.angle == pytest.approx(math.atan2(0.002, 0.026))
    assert gap.width_mouth == pytest.approx(math.hypot(0.026, 0.002))
    # B's root corner, 25 mm under its mouth corner, swings out to 25 mm beside it
    assert gap.width_root == pytest.approx(math.hypot(0.0385 + 0.0125, 0.027))
    quadrilateral = shapely.Polygon([(-0.0125, -0.002), (-0.0125, -0.027), (0.0385, 0.0), (0.0135, 0.0)])
    assert gap.area == pytest.approx(quadrilateral.area)
    # in section coordinates (x - 10, z - 30); the section lies at y = 19.6
    assert np.allclose(gap.polygon[:, 1], 19.6)


def test_the_seed_decides_and_the_sensor_does_not(joint):
    sections = joint(STATIONS)
    first = random_truth(sections, Scenario(), 7)
    again = random_truth(sections, dataclasses.replace(Scenario(), sigma=0.1, outliers=0.5), 7)
    other = random_truth(sections, Scenario(), 8)
    assert [s.components for s in first.stations] == [s.components for s in again.stations]
    assert first.stations[0].components != other.stations[0].components


def test_motion_is_uniform_at_the_ends(joint):
    sections = joint([0.0, 0.4])
    u = [random_truth(sections, Scenario(), seed).stations[0].common.u for seed in range(600)]
    assert np.mean(u) == pytest.approx(0.0, abs=4 * 0.020 / math.sqrt(3 * 600))
    assert np.std(u) == pytest.approx(0.020 / math.sqrt(3), rel=0.06)


def test_one_station_is_a_joint_too(joint):
    truth = random_truth(joint([0.1]), Scenario(), 1)
    assert len(truth.stations) == 1
    assert truth.length == 0.0
    with pytest.raises(ValueError, match="at least one section"):
        random_truth([], Scenario(), 1)
