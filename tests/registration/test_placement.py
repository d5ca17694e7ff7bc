"""Placement of clouds with nothing known of the pose: random poses, clutter, the real tee."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bimfit.errors import ScanError
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import rigid_inverse, transform_points
from bimfit.registration.placement import PlacementConfig, place_cloud
from bimfit.registration.rigid_3d import T_model_scan, T_scan_model, about, matrix_of, parameters_of
from bimfit.registration.surface_3d import sample_surface, visible_surface

SCANS = Path(__file__).parents[3] / "shared" / "data" / "scans"


def box(low, high) -> TriangleMesh:
    import trimesh

    mesh = trimesh.creation.box(bounds=[low, high])
    return TriangleMesh.of(mesh.vertices, mesh.faces)


def join(*parts: TriangleMesh) -> TriangleMesh:
    offsets = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    return TriangleMesh.of(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + k for p, k in zip(parts, offsets, strict=True)]),
    )


def bracket() -> TriangleMesh:
    """Three boxes of different sizes: no motion carries it onto itself."""
    return join(
        box([0, 0, 0], [0.5, 0.2, 0.04]),
        box([0, 0, 0.04], [0.06, 0.2, 0.3]),
        box([0.2, 0.05, 0.04], [0.3, 0.11, 0.12]),
    )


def random_pose(rng) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    out[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    out[:3, 3] = rng.uniform(-2.0, 2.0, 3)
    return out


def farthest(T, truth, mesh) -> float:
    """How far the model's corners are from where they belong, m."""
    a, b = transform_points(T, mesh.vertices), transform_points(truth, mesh.vertices)
    return float(np.linalg.norm(a - b, axis=1).max())


def scan_of(mesh, eye, truth, rng, *, count=2500, sigma=0.001):
    """What a scanner at ``eye`` (model frame) sees, moved by ``truth``."""
    seen = visible_surface(mesh, 0.004, eye).points
    seen = seen[rng.choice(len(seen), min(count, len(seen)), replace=False)]
    return transform_points(truth, seen + rng.normal(0.0, sigma, seen.shape))


@pytest.mark.parametrize("seed", range(2))
def test_finds_a_bracket_among_floor_and_clutter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mesh, truth = bracket(), random_pose(rng)
    eye = np.array([0.7, -0.9, 0.8])
    cloud = scan_of(mesh, eye, truth, rng)
    floor = np.column_stack(
        [rng.uniform(-0.4, 0.9, 1500), rng.uniform(-0.4, 0.6, 1500), np.full(1500, -0.001)]
    )
    hidden = (floor[:, 0] > 0) & (floor[:, 0] < 0.5) & (floor[:, 1] > 0) & (floor[:, 1] < 0.45)
    clutter = rng.uniform([-0.4, -0.4, 0.0], [0.9, 0.6, 0.5], (300, 3))
    scan = np.concatenate([cloud, transform_points(truth, floor[~hidden]), transform_points(truth, clutter)])
    known = transform_points(truth, eye) if seed % 2 else None
    result = place_cloud(scan, mesh, viewpoint=known)
    assert result.status.name == "ok", result.status
    assert farthest(T_scan_model(result), truth, mesh) < 0.002
    back = transform_points(T_model_scan(result), transform_points(truth, mesh.vertices))
    np.testing.assert_allclose(back, mesh.vertices, atol=0.002)


def test_same_input_gives_the_same_bits() -> None:
    rng = np.random.default_rng(5)
    scan = scan_of(bracket(), np.array([0.7, -0.9, 0.8]), random_pose(rng), rng, count=400)
    one, two = (place_cloud(scan, bracket(), seed=3) for _ in range(2))
    assert np.array_equal(one.parameters, two.parameters)
    assert one.score == two.score


def test_names_the_rivals_of_a_symmetric_model() -> None:
    """A box has four rotations onto itself; all of them explain a whole scan of it."""
    rng = np.random.default_rng(2)
    mesh = box([-0.2, -0.1, -0.05], [0.2, 0.1, 0.05])
    truth = random_pose(rng)
    surface = sample_surface(mesh, 0.008).points
    result = place_cloud(transform_points(truth, surface + rng.normal(0, 0.001, surface.shape)), mesh)
    assert result.status.name == "ambiguous"
    poses = [T_scan_model(result), *(matrix_of(m.parameters) for m in result.modes)]
    turns = [
        np.diag([1.0, 1, 1, 1]),
        np.diag([1.0, -1, -1, 1]),
        np.diag([-1.0, 1, -1, 1]),
        np.diag([-1.0, -1, 1, 1]),
    ]
    for turn in turns:
        assert min(farthest(T, truth @ turn, mesh) for T in poses) < 0.003


def test_names_the_directions_that_a_single_face_leaves_open() -> None:
    rng = np.random.default_rng(4)
    mesh = box([0, 0, 0], [1.0, 0.7, 0.02])
    patch = np.column_stack(
        [rng.uniform(0.3, 0.7, 900), rng.uniform(0.2, 0.5, 900), rng.normal(0.02, 0.001, 900)]
    )
    result = place_cloud(patch, mesh, viewpoint=(0.5, 0.3, 1.0))
    assert result.status.name in ("weak", "ambiguous")
    if result.status.name == "weak":
        assert "shift along" in result.status.reason
        assert "turn about" in result.status.reason
    else:
        assert result.modes


@pytest.mark.parametrize("kind", ["noise", "room"])
def test_rejects_what_is_not_there(kind: str) -> None:
    rng = np.random.default_rng(6)
    cloud = rng.uniform(-0.6, 0.6, (1500, 3))
    if kind == "room":  # a floor and two walls, nothing on them
        cloud[:700, 2], cloud[700:1100, 0], cloud[1100:, 1] = -0.6, 0.6, 0.6
    result = place_cloud(cloud, bracket(), config=PlacementConfig(max_rotations=24))
    assert result.status.name == "rejected"
    assert "explains" in result.status.reason


def test_few_points_are_no_data_and_hold_no_pose() -> None:
    result = place_cloud(np.zeros((3, 3)), bracket())
    assert result.status.name == "no_data"
    assert not result.found
    with pytest.raises(ValueError, match="no 3D pose"):
        T_model_scan(result)


@pytest.mark.parametrize("bad", [np.zeros((5, 2)), np.full((20, 3), np.nan), [["a", "b", "c"]]])
def test_bad_points_are_named(bad) -> None:
    with pytest.raises(ScanError, match="point"):
        place_cloud(bad, bracket())


def test_parameters_round_trip() -> None:
    rng = np.random.default_rng(8)
    for _ in range(20):
        T = random_pose(rng)
        np.testing.assert_allclose(matrix_of(parameters_of(T)), T, atol=1e-12)
    turn = about([1.0, 2.0, 3.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.5])
    np.testing.assert_allclose(transform_points(turn, [1.0, 2.0, 3.0]), [1.1, 2.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(turn @ rigid_inverse(turn), np.eye(4), atol=1e-12)


def test_samples_are_even_and_cover_the_area() -> None:
    surface = sample_surface(bracket(), 0.01)
    top = surface.points[(surface.normals[:, 2] > 0.9) & (np.abs(surface.points[:, 2] - 0.04) < 1e-9)]
    assert len(top) == pytest.approx(0.5 * 0.2 / 0.01**2, rel=0.1)


def test_inside_of_a_tube_is_not_exterior() -> None:
    import trimesh

    tube = trimesh.creation.annulus(0.02, 0.025, 0.4)
    seen = visible_surface(TriangleMesh.of(tube.vertices, tube.faces), 0.004)
    inner = np.hypot(*seen.points[:, :2].T) < 0.0202
    assert inner.mean() < 0.1


def load_tee() -> tuple[np.ndarray, TriangleMesh]:
    if not (SCANS / "tee_lidar.pcd").exists():
        pytest.skip("the real lidar cloud of the tee is not here")
    import trimesh

    lines = (SCANS / "tee_lidar.pcd").read_text().splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("DATA"))
    cad = trimesh.load(SCANS / "tee_cad.ply", process=False)
    return np.loadtxt(lines[start + 1 :]), TriangleMesh.of(cad.vertices, cad.faces)


def test_places_the_real_tee() -> None:
    """The joint's corner line is x = z = 25.4 mm in the CAD's frame; both faces meet it."""
    cloud, mesh = load_tee()
    result = place_cloud(cloud, mesh)
    assert result.status.name == "ok", result.status
    assert result.fitness > 0.9
    assert result.inlier_rmse < 0.0015
    placed = transform_points(T_model_scan(result), cloud)
    post = placed[(np.abs(placed[:, 0] - 0.0254) < 0.006) & (placed[:, 2] > 0.04) & (placed[:, 1] < 0.02)]
    base = placed[(np.abs(placed[:, 2] - 0.0254) < 0.006) & (placed[:, 0] > 0.04) & (placed[:, 1] < 0.02)]
    assert len(post) > 200
    assert len(base) > 100
    assert np.median(post[:, 0]) == pytest.approx(0.0254, abs=0.0008)
    assert np.median(base[:, 2]) == pytest.approx(0.0254, abs=0.0008)
    # The base tube shows its whole length: its ends fix x.
    front = placed[(placed[:, 2] < 0.02) & (placed[:, 1] > 0.02)]
    assert front[:, 0].min() == pytest.approx(-0.0762, abs=0.005)
    assert front[:, 0].max() == pytest.approx(0.18415, abs=0.006)


def test_certifies_a_placement() -> None:
    rng = np.random.default_rng(11)
    mesh, eye = bracket(), np.array([0.7, -0.9, 0.8])
    truth = random_pose(rng)
    config = PlacementConfig(blur=0.012, window=(0.01, 0.01))
    known = transform_points(truth, eye)
    result = place_cloud(
        scan_of(mesh, eye, truth, rng, count=1000), mesh, viewpoint=known, config=config, certify=True
    )
    assert result.status.name == "ok", result.status
    assert result.stop in ("proven", "tolerance")
    assert result.score <= result.bound <= 1.02 * result.score + 1e-9
    assert farthest(T_scan_model(result), truth, mesh) < 0.002


def test_places_the_real_tee_on_a_floor_and_turned() -> None:
    cloud, mesh = load_tee()
    rng = np.random.default_rng(1)
    truth = T_scan_model(place_cloud(cloud, mesh))
    floor = np.column_stack(
        [rng.uniform(-0.3, 0.4, 2500), rng.uniform(0.03, 0.5, 2500), np.full(2500, -0.0254)]
    )
    turn = random_pose(rng)
    scan = transform_points(turn, np.concatenate([cloud, transform_points(truth, floor)]))
    result = place_cloud(scan, mesh)
    assert result.status.name == "ok", result.status
    assert farthest(T_scan_model(result), turn @ truth, mesh) < 0.003
