"""Gap sections against closed forms, Shapely on the whole boards, finite differences and Monte Carlo."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from bimfit.gap import clearance
from bimfit.gap.section import gap_section
from bimfit.geometry.pose import Pose2D

_spec = importlib.util.spec_from_file_location("gap_shapes", Path(__file__).with_name("shapes.py"))
shapes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(shapes)
section, SHAPES = shapes.section, shapes.SHAPES

FIGURES = ("u", "v", "width_mouth", "angle", "width_root", "area", "width_narrowest")
SIGMAS = ("x", "y", "width", "angle", "width_root", "area", "width_narrowest")
small = st.tuples(st.floats(-0.003, 0.003), st.floats(-0.003, 0.003), st.floats(-0.04, 0.04))


def figures(g):
    return np.array([*g.origin, g.width_mouth, g.angle, g.width_root, g.area, g.width_narrowest])


def sigmas(g):
    return np.array([getattr(g.sigma, name) for name in SIGMAS])


def boards(shape, pose_a, pose_b):
    """The two components as big polygons behind their sides."""
    a, b = shape.side_a, shape.side_b
    far_a = [(-0.3, a[-1, 1]), (-0.3, a[0, 1])]
    far_b = [(0.3, b[-1, 1]), (0.3, b[0, 1])]
    return (
        shapely.Polygon(Pose2D.from_array(pose_a).apply([*a, *far_a])),
        shapely.Polygon(Pose2D.from_array(pose_b).apply([*b, *far_b])),
    )


def less(region, solid):
    # On a grid of a nanometre: edges that lie on one another but for rounding defeat GEOS otherwise.
    return shapely.difference(shapely.make_valid(region), solid, grid_size=1e-9)


def test_as_designed():
    g = section()
    assert (g.angle, g.overlap_area, g.contact, g.sigma) == (0.0, 0.0, "clearance", None)
    assert np.allclose(g.origin, 0.0, atol=1e-15)
    assert np.allclose([g.width_mouth, g.width_root, g.width_narrowest], 0.025, rtol=1e-12)
    assert math.isclose(g.area, 0.025 * 0.025, rel_tol=1e-12)
    v = section(shapes.V_GROOVE)
    assert math.isclose(v.area, 0.5 * (0.030 + 0.004) * 0.020 + 0.004 * 0.005, rel_tol=1e-12)
    assert np.allclose([v.width_mouth, v.width_root, v.width_narrowest], [0.030, 0.004, 0.004])
    # A ledge 10 mm above the other: vertical legs of 10 x 20, 10 x 40 and the ledge between.
    stepped = section(shapes.STEPPED)
    assert math.isclose(stepped.area, 0.01 * 0.02 + 0.015 * 0.01 + 0.01 * 0.04, rel_tol=1e-12)
    assert math.isclose(stepped.width_narrowest, 0.010, rel_tol=1e-12)


def test_long_chains_take_the_same_figures():
    chain = section(shapes.FILLET)
    polygon = shapely.Polygon(np.concatenate([shapes.FILLET.side_a, shapes.FILLET.side_b[::-1]]))
    assert math.isclose(chain.area, polygon.area, rel_tol=1e-12)
    assert math.isclose(chain.width_narrowest, 0.008, rel_tol=1e-9)
    cov = np.diag([1e-4, 1e-4, 1e-2]) ** 2
    g = section(shapes.FILLET, (0.001, 0, 0.02), (0, 0.002, -0.01), cov_a=cov, cov_b=cov)
    assert np.allclose(
        sigmas(g), differences(shapes.FILLET, (0.001, 0, 0.02), (0, 0.002, -0.01), cov, cov), rtol=1e-4
    )


@pytest.mark.parametrize("name", SHAPES)
def test_a_common_motion_moves_the_gap_and_nothing_else(name):
    motion = Pose2D(0.013, -0.021, 0.3)
    at_rest, moved = section(SHAPES[name]), section(SHAPES[name], motion.as_array(), motion.as_array())
    assert np.allclose(moved.origin, motion.apply(at_rest.origin), atol=1e-15)
    assert math.isclose(moved.angle, 0.3, rel_tol=1e-9)
    assert np.allclose(figures(moved)[[2, 4, 5, 6]], figures(at_rest)[[2, 4, 5, 6]], rtol=1e-9)


@given(a=small, b=small, name=st.sampled_from(list(SHAPES)))
@settings(max_examples=120, deadline=None, derandomize=True)
def test_open_gaps_against_shapely(a, b, name):
    shape = SHAPES[name]
    g = section(shape, a, b)
    solid_a, solid_b = boards(shape, a, b)
    ring = shapely.Polygon(np.concatenate([g.side_a, g.side_b[::-1]]))
    clearance = shapely.LineString(g.side_a).distance(shapely.LineString(g.side_b))
    if solid_a.intersects(solid_b):
        assert g.contact != "clearance"
        return
    assert math.isclose(g.width_narrowest, clearance, rel_tol=1e-9, abs_tol=1e-12)
    assert g.overlap_area == 0.0
    expected = less(less(ring, solid_a), solid_b)
    assert math.isclose(g.area, expected.area, rel_tol=1e-5, abs_tol=1e-9)
    assert shapely.Polygon(g.polygon).is_valid


@given(a=small, b=small, push=st.floats(0.018, 0.032))
@settings(max_examples=100, deadline=None, derandomize=True)
def test_touching_and_crossing_sides_against_the_whole_boards(a, b, push):
    """Open: the band from mouth to root line less both boards. Overlap: what both boards share."""
    pose_a, pose_b = (push + a[0], 0.0, a[2] / 4), (b[0], 0.0, b[2] / 4)
    g = section(shapes.BUTT, pose_a, pose_b)
    solid_a, solid_b = boards(shapes.BUTT, pose_a, pose_b)
    band = shapely.convex_hull(shapely.MultiPoint([*g.side_a, *g.side_b]))
    # Between the line through two corners and the boards' own top faces, which lean, lies a sliver.
    sliver = 7e-6
    assert g.area == pytest.approx(less(less(band, solid_a), solid_b).area, abs=sliver)
    assert g.overlap_area == pytest.approx(solid_a.intersection(solid_b).area, abs=sliver)
    assert sum(shapely.Polygon(p).area for p in g.parts) == pytest.approx(g.area, abs=1e-15)
    assert (g.contact == "overlap") == (g.width_narrowest < -1e-6)


@pytest.mark.parametrize(
    ("shift", "contact", "narrowest", "overlap"),
    [(-0.020, "clearance", 0.005, 0.0), (-0.025, "touch", 0.0, 0.0), (-0.030, "overlap", -0.005, 125e-6)],
)
def test_clearance_touch_and_overlap_are_told_apart(shift, contact, narrowest, overlap):
    g = section(shapes.BUTT, b=(shift, 0, 0))
    assert g.contact == contact
    assert math.isclose(g.width_narrowest, narrowest, abs_tol=1e-12)
    assert math.isclose(g.width_mouth, narrowest, abs_tol=1e-12)
    assert math.isclose(g.overlap_area, overlap, abs_tol=1e-12)
    assert math.isclose(g.area, max(narrowest, 0.0) * 0.025, abs_tol=1e-12)
    assert g.closed == (contact != "clearance")
    assert len(g.polygon_world) == (4 if contact == "clearance" else 0)


def test_a_bow_tie_is_half_open():
    # A's face stands upright through B's, which leans by atan(8 / 25): they cross midway.
    lean = shapes.outline([(0, 0), (0, -0.025)], [(-0.004, 0), (0.004, -0.025)])
    g = section(lean)
    assert math.isclose(g.area, 0.5 * 0.0125 * 0.004, rel_tol=1e-9)
    assert math.isclose(g.overlap_area, g.area, rel_tol=1e-9)
    assert (g.width_mouth, g.width_root) == pytest.approx((-0.004, 0.004))
    # The deepest point is B's mouth corner, 4 mm behind A's face.
    assert math.isclose(g.width_narrowest, -0.004, rel_tol=1e-9)
    assert len(g.parts) == 1


@given(a=small, b=small, push=st.floats(-0.002, 0.012), name=st.sampled_from(list(SHAPES)))
@settings(max_examples=150, deadline=None, derandomize=True)
def test_sides_that_cross_once_as_by_noding(a, b, push, name):
    """The closed form for overlap and a single crossing against Shapely's noded faces."""
    shape = SHAPES[name]
    side_a = (Pose2D(push) @ Pose2D.from_array(a)).apply(shape.side_a)
    side_b = Pose2D.from_array(b).apply(shape.side_b)
    plain = clearance.measure(side_a.tolist(), side_b.tolist())
    ring = np.concatenate([side_a, side_b[::-1]])
    line_a, line_b = shapely.LineString(side_a), shapely.LineString(side_b)
    noded = clearance._measure_crossing(ring, side_a, side_b, line_a.distance(line_b), plain.nearest)
    assert plain.area == pytest.approx(noded.area, rel=1e-6, abs=1e-10)
    assert plain.overlap_area == pytest.approx(noded.overlap_area, rel=1e-6, abs=1e-10)
    assert plain.narrowest == pytest.approx(noded.narrowest, rel=1e-6, abs=1e-9)
    assert [len(p) for p in plain.parts] == [len(p) for p in noded.parts]


def test_a_bump_that_touches_leaves_two_parts():
    bump = shapes.outline(
        [(-0.01, 0), (-0.01, -0.01), (0.002, -0.02), (-0.01, -0.03), (-0.01, -0.05)], [(0, 0), (0, -0.05)]
    )
    g = section(bump)
    a = shapely.Polygon([*bump.side_a, (-0.1, -0.05), (-0.1, 0)])
    band = shapely.box(-0.05, -0.05, 0, 0)
    rest = band.difference(a)
    assert len(g.parts) == 2
    assert math.isclose(g.area, rest.area, rel_tol=1e-9)
    assert [shapely.Polygon(p).area for p in g.parts] == pytest.approx(
        sorted((p.area for p in rest.geoms), reverse=True)
    )
    assert math.isclose(
        g.overlap_area, a.area - a.difference(shapely.box(0, -0.05, 0.1, 0)).area, rel_tol=1e-9
    )
    assert math.isclose(g.width_narrowest, -0.002, rel_tol=1e-9)


def differences(shape, a, b, cov_a, cov_b, step=1e-7):
    at = np.concatenate([a, b])
    J = np.empty((7, 6))
    for k in range(6):
        e = np.zeros(6)
        e[k] = step
        up, down = at + e, at - e
        J[:, k] = (figures(section(shape, up[:3], up[3:])) - figures(section(shape, down[:3], down[3:]))) / (
            2 * step
        )
    cov = np.zeros((6, 6))
    cov[:3, :3], cov[3:, 3:] = cov_a, cov_b
    return np.sqrt(np.diag(J @ cov @ J.T))


@pytest.mark.parametrize("name", SHAPES)
def test_sigmas_against_finite_differences(name):
    rng = np.random.default_rng(5)
    for _ in range(20):
        a, b = rng.uniform(-1, 1, (2, 3)) * (0.001, 0.001, 0.02)
        cov_a, cov_b = (m @ m.T for m in rng.normal(size=(2, 3, 3)) * np.array([3e-4, 3e-4, 1e-2])[:, None])
        g = section(SHAPES[name], a, b, cov_a=cov_a, cov_b=cov_b)
        assert g.contact == "clearance"
        assert np.allclose(sigmas(g), differences(SHAPES[name], a, b, cov_a, cov_b), rtol=2e-4)


def test_sigmas_against_monte_carlo():
    rng = np.random.default_rng(11)
    a, b = np.array([-0.002, -0.001, 0.03]), np.array([0.002, 0.001, -0.02])
    cov_a, cov_b = np.diag([5e-4, 2e-4, 0.02]) ** 2, np.diag([6e-4, 1e-4, 0.015]) ** 2
    cov_a[0, 2] = cov_a[2, 0] = 0.6 * 5e-4 * 0.02
    cross = 0.3 * np.diag([5e-4 * 6e-4, 2e-4 * 1e-4, 0.02 * 0.015])
    whole = np.block([[cov_a, cross], [cross.T, cov_b]])
    g = section(shapes.V_GROOVE, a, b, cov_a=cov_a, cov_b=cov_b, cov_ab=cross)
    drawn = rng.multivariate_normal(np.concatenate([a, b]), whole, 4000)
    sample = np.array([figures(section(shapes.V_GROOVE, p[:3], p[3:])) for p in drawn])
    # 4,000 draws know a standard deviation to 1.1 %; the rest is the functions' curvature.
    assert np.allclose(sigmas(g), sample.std(axis=0), rtol=0.05)


def test_sigmas_of_a_closing_gap_against_monte_carlo():
    """Where the area cannot fall below zero a gradient says nothing; the deviation about the estimate must
    hold."""
    rng = np.random.default_rng(12)
    sd = np.array([5e-4, 2e-4, 0.01])
    b = np.array([-0.0252, 0.0, 0.0])
    g = section(shapes.BUTT, b=b, cov_a=np.diag(sd**2), cov_b=np.diag(sd**2))
    assert g.contact == "overlap"
    drawn = rng.normal(size=(800, 6)) * np.tile(sd, 2) + np.concatenate([np.zeros(3), b])
    sample = np.array([figures(section(shapes.BUTT, p[:3], p[3:])) for p in drawn])
    rms = np.sqrt(np.mean((sample - figures(g)) ** 2, axis=0))
    assert sigmas(g)[5] == pytest.approx(rms[5], rel=0.3)
    assert sigmas(g)[6] == pytest.approx(rms[6], rel=0.3)


def test_corners_that_meet_have_an_unknown_line_and_a_known_width():
    cov = np.diag([3e-4, 3e-4, 0.0]) ** 2
    g = section(shapes.BUTT, a=(0.0125, 0, 0), b=(-0.0125, 0, 0), cov_a=cov, cov_b=cov)
    assert g.width_mouth == 0.0
    assert g.sigma.width == pytest.approx(3e-4 * math.sqrt(2))
    assert g.sigma.angle == pytest.approx(math.pi / math.sqrt(12))


def test_the_angle_is_that_of_a_line():
    # B's corner has passed A's by 1 mm and lies 1 mm lower: the line leans by 45 degrees, not by 225.
    g = section(shapes.BUTT, b=(-0.026, -0.001, 0))
    assert g.angle == pytest.approx(math.pi / 4)
    assert g.width_mouth == pytest.approx(-math.hypot(0.001, 0.001))


def test_no_covariance_no_sigma():
    cov = np.eye(3) * 1e-8
    assert section(cov_a=cov).sigma is None
    assert section(cov_a=cov, cov_b=np.full((3, 3), np.nan)).sigma is None
    assert section(cov_a=cov, cov_b=np.diag([np.inf, 1e-8, 1e-8])).sigma is None


def test_world_coordinates_keep_their_precision():
    frame = shapes.frame_at(0.0, shapes.MAP)
    g = gap_section(0.0, frame, shapes.BUTT, Pose2D(0.001, 0.002, 0.01), Pose2D())
    assert np.allclose(frame.to_section(g.polygon_world)[:, :2], g.polygon, atol=2e-9)
    assert np.allclose(g.origin_world, frame.to_world(g.origin), atol=0)
