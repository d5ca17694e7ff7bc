"""A scan that is nearly in place is carried there, with proof, or refused by name."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from bimfit.errors import ConfigError, ScanError
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import transform_points
from bimfit.registration.alignment import AlignConfig, align_scan, thinned
from bimfit.registration.rigid_3d import about, parameters_of
from bimfit.registration.surface_3d import clipped, visible_surface

COARSE = AlignConfig(blur=0.012, points=400)
ALONG = [np.array([0.0, 1.0, 0.0])]
EYE = (0.1, 0.2, 0.9)


def boxes(*bounds) -> TriangleMesh:
    parts = [trimesh.creation.box(bounds=b) for b in bounds]
    starts = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    return TriangleMesh.of(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + k for p, k in zip(parts, starts, strict=True)]),
    )


def corner() -> TriangleMesh:
    """A floor, a wall and a post: all directions are fixed."""
    return boxes(
        [[-0.1, -0.1, -0.05], [0.35, 0.4, 0.0]],
        [[-0.1, -0.1, 0.012], [-0.05, 0.4, 0.2]],
        [[0.2, 0.3, 0.0], [0.26, 0.36, 0.2]],
    )


def seen(mesh: TriangleMesh, count: int, seed: int, region=((-1, -1, -1), (1, 1, 1))) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = visible_surface(mesh, 0.005, EYE).points
    points = points[((points >= region[0]) & (points <= region[1])).all(axis=1)]
    points = points[rng.choice(len(points), min(count, len(points)), replace=False)]
    return points + rng.normal(0.0, 0.002, points.shape)


def around(mesh: TriangleMesh) -> np.ndarray:
    return mesh.bounds[None] + np.array([[-0.02], [0.02]])


@pytest.mark.parametrize("seed", range(2))
def test_a_scan_is_carried_into_place_with_its_proof(seed: int) -> None:
    mesh = corner()
    rng = np.random.default_rng(seed)
    off = about([0.1, 0.2, 0.1], rng.uniform(-0.04, 0.04, 3), rng.uniform(-0.03, 0.03, 3))
    clutter = rng.uniform(-0.1, 0.35, (100, 3))
    scan = transform_points(off, np.concatenate([seen(mesh, 6000, seed), clutter]))
    found = align_scan(mesh, around(mesh), scan, ALONG, COARSE, transform_points(off, np.array(EYE)))
    left = found.T_model_scan @ off
    middle = np.array([0.1, 0.2, 0.1])
    assert np.linalg.norm(transform_points(left, middle) - middle) < 0.002
    assert np.linalg.norm(parameters_of(left)[3:]) < 0.008
    assert found.result.stop in ("proven", "tolerance")
    assert found.result.gap <= 0.02 * found.result.score + 1e-9
    assert found.result.score <= found.points
    assert found.turned == pytest.approx(np.linalg.norm(parameters_of(found.T_model_scan)[3:]))
    assert not found.held


def test_what_nothing_fixes_is_refused_by_name_unless_it_runs_along_the_joint() -> None:
    """A corner seen in its middle only may lie anywhere along itself; a plate lies anywhere in its plane."""
    groove = boxes([[-0.3, -2.0, -0.05], [0.3, 2.0, 0.0]], [[-0.3, -2.0, 0.0], [-0.25, 2.0, 0.3]])
    part = ((-0.4, -0.2, -0.2), (0.1, 0.2, 0.4))
    region = np.array([[[-0.4, -0.3, -0.2], [0.15, 0.3, 0.2]]])
    off = about([0, 0, 0], [0.02, 0.0, -0.015], [0.01, 0.02, -0.02])
    scan = transform_points(off, seen(groove, 3000, 4, part))
    found = align_scan(groove, region, scan, ALONG, COARSE, EYE)
    assert found.held == ("shift along y",)
    left = found.T_model_scan @ off
    across = transform_points(left, np.zeros(3))[[0, 2]]
    assert np.abs(across).max() < 0.002
    assert np.linalg.norm(parameters_of(left)[3:]) < 0.01
    for other in ([np.array([1.0, 0.0, 0.0])], [ALONG[0], np.array([0.0, 0.0, 1.0])]):
        with pytest.raises(ScanError, match=r"do not fix: shift along y"):
            align_scan(groove, region, scan, other, COARSE, EYE)
    plate = boxes([[-2.0, -2.0, -0.05], [2.0, 2.0, 0.0]])
    with pytest.raises(ScanError, match=r"cannot be aligned safely.*shift along") as told:
        align_scan(plate, region, seen(plate, 2000, 5, part), ALONG, COARSE, EYE)
    assert "--scan-pose" in str(told.value)


def test_beyond_the_window_and_elsewhere_are_refused() -> None:
    mesh = corner()
    scan = seen(mesh, 3000, 6) + np.array([0.03, 0.0, 0.0])
    small = AlignConfig(shift=0.01, turn=0.01, blur=0.012, points=400)
    with pytest.raises(ScanError, match=r"cannot be aligned safely"):
        align_scan(mesh, around(mesh), scan, ALONG, small, EYE)
    blob = np.random.default_rng(0).uniform(-0.3, 0.5, (3000, 3)) + np.array([0, 0, 3.0])
    with pytest.raises(ScanError, match=r"explains 0% of the points"):
        align_scan(mesh, around(mesh), blob, ALONG, small, EYE)
    with pytest.raises(ScanError, match=r"only 20 points"):
        align_scan(mesh, around(mesh), scan[:20], ALONG, small, EYE)
    with pytest.raises(ScanError, match=r"no surface near"):
        align_scan(mesh, around(mesh) + 9.0, scan, ALONG, small, EYE)
    for bad in ({"shift": 0.0}, {"turn": 4.0}, {"blur": 0.0}, {"points": 3}, {"shift": float("nan")}):
        with pytest.raises(ConfigError):
            AlignConfig(**bad)


def test_a_clipped_mesh_is_the_same_surface_near_the_boxes() -> None:
    """Every sample of the whole surface in a box lies on the part, which is little longer than the box."""
    mesh = TriangleMesh.of(
        *(lambda m: (m.vertices, m.faces))(trimesh.creation.box(bounds=[[-9, -7, -0.2], [9, 7, 0]]))
    )
    turn = about([1, 2, 3], [0, 0, 0], [0.3, -0.4, 0.9])
    mesh = TriangleMesh.of(transform_points(turn, mesh.vertices), mesh.faces)
    centre = transform_points(turn, np.array([3.0, -2.0, 0.0]))
    box = np.array([[centre - 0.3, centre + 0.3]])
    part = clipped(mesh, box, 0.25)
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces)
    points, _ = trimesh.sample.sample_surface(whole, 300_000, seed=1)
    near = points[((points >= box[0, 0]) & (points <= box[0, 1])).all(axis=1)]
    assert len(near) > 100
    t = part.triangles
    on_it = np.zeros(len(near), bool)
    for corners in t:
        solved = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), np.vstack([near.T, np.ones(len(near))]))
        weights = solved[0]
        off = np.abs(corners.T @ weights - near.T).max(axis=0)
        on_it |= (weights > -1e-9).all(axis=0) & (off < 1e-9)
    assert on_it.all()
    assert 0.5 * np.linalg.norm(part.face_vectors, axis=1).sum() < 4.0
    assert np.ptp(part.triangles, axis=1).max() <= 0.25
    np.testing.assert_allclose(
        np.abs(part.face_vectors @ turn[:3, 2]) / np.linalg.norm(part.face_vectors, axis=1), 1.0, atol=1e-9
    )
    assert len(clipped(mesh, box + 50.0, 0.25).faces) == 0


def test_thinning_is_even_and_repeatable() -> None:
    rng = np.random.default_rng(2)
    dense = rng.uniform(0.0, 0.1, (20_000, 3)) * [1, 1, 0]
    thin = rng.uniform(0.0, 1.0, (20_000, 3)) * [1, 1, 0]
    kept = thinned(np.concatenate([dense, thin]), 900)
    assert 800 < len(kept) < 1000
    assert np.array_equal(kept, thinned(np.concatenate([dense, thin]), 900))
    share = np.mean((kept < 0.1).all(axis=1))
    assert share == pytest.approx(0.01, abs=0.01)  # of the area, not of the points
    assert len(thinned(dense[:30], 900)) == 30
    assert len(thinned(np.zeros((5000, 3)), 900)) >= 1
