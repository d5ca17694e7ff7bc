"""Iterative closest point, the usual alternative: Open3D and small_gicp on clouds in the plane v = 0."""

from __future__ import annotations

import itertools
import math
import time
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from bimfit.config import SearchConfig
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Slice
from bimfit.geometry.status import OK, Status
from bimfit.registration.fitness import fitness_of
from bimfit.registration.result import MatchResult
from bimfit.registration.table import Target

ITERATIONS = 300
CHANGE = 1e-9  # of share and root mean square within an iteration, under which it has converged
SPACING = 0.001  # between samples of the model, m
GATE_SIGMAS = 3.0
MAX_GATE = 0.15  # correspondences farther apart are never made, m
APART = 1.0  # between the two sheets that stand for the plane, m: beyond any gate
LOST = np.full(3, np.nan)
Kind = Literal["point", "plane", "robust"]


def icp_point(
    target: Target, slice_: Slice, prior: Pose2D, config: SearchConfig, *, weights: ArrayLike | None = None
) -> MatchResult:
    """Point-to-point ICP (Open3D), started at the prior; ``config.window`` gates pairs, no weights."""
    return _open3d("icp-point", "point", target, slice_, (prior,), config, prior)


def icp_plane(
    target: Target, slice_: Slice, prior: Pose2D, config: SearchConfig, *, weights: ArrayLike | None = None
) -> MatchResult:
    """Point-to-plane ICP (Open3D), started at the prior; ``config.window`` gates pairs, no weights."""
    return _open3d("icp-plane", "plane", target, slice_, (prior,), config, prior)


def icp_plane_robust(
    target: Target, slice_: Slice, prior: Pose2D, config: SearchConfig, *, weights: ArrayLike | None = None
) -> MatchResult:
    """Point-to-plane ICP with a Tukey kernel of three blurs (Open3D)."""
    return _open3d("icp-plane-robust", "robust", target, slice_, (prior,), config, prior)


def icp_multistart(
    target: Target, slice_: Slice, prior: Pose2D, config: SearchConfig, *, weights: ArrayLike | None = None
) -> MatchResult:
    """Point-to-plane ICP from 27 starts spread over the window; the least misfit wins."""
    steps = [(-0.5 * w, 0.0, 0.5 * w) for w in config.window]
    pivot = np.mean(slice_.points, axis=0) if len(slice_.points) else np.zeros(2)
    starts = tuple(Pose2D.about(pivot, *motion) @ prior for motion in itertools.product(*steps))
    return _open3d("icp-multistart", "plane", target, slice_, starts, config, prior)


def g_icp(
    target: Target, slice_: Slice, prior: Pose2D, config: SearchConfig, *, weights: ArrayLike | None = None
) -> MatchResult:
    """Generalised ICP (small_gicp) on the clouds repeated along the joint, so that normals exist."""
    name = "g-icp"
    if lost := _too_little(name, target, slice_):
        return lost
    try:
        import small_gicp
    except ImportError:
        return MatchResult(name, LOST, status=Status("rejected", "small_gicp is not installed"))
    model, _ = sample(target.edges)
    started = time.perf_counter()
    moved = prior.inverse().apply(slice_.points)
    width = np.arange(-5, 6) * 0.002
    try:
        found = small_gicp.align(
            _extruded(model, width), _extruded(moved, width), registration_type="GICP",
            downsampling_resolution=0.0015, max_correspondence_distance=_gate(target, config),
            max_iterations=ITERATIONS,
        )  # fmt: skip
    except Exception as error:  # a library's failure on this slice is a verdict, not a crash
        return MatchResult(name, LOST, status=Status("rejected", f"small_gicp: {error}"))
    matrix = np.asarray(found.T_target_source)
    converged = bool(found.converged)
    return _verdict(
        name, target, slice_, prior, matrix, int(found.iterations), converged, started, config, prior
    )


def sample(edges: Array, spacing: float = SPACING) -> tuple[Array, Array]:
    """Points and unit normals along surface pieces, ``spacing`` (m) apart; shapes (n, 2)."""
    points, normals = [], []
    for a, b in edges:
        d = b - a
        length = float(np.hypot(d[0], d[1]))
        steps = max(1, math.ceil(length / spacing))
        points.append(a + d * ((np.arange(steps) + 0.5) / steps)[:, None])
        normals.append(np.tile(np.array([d[1], -d[0]]) / max(length, 1e-300), (steps, 1)))
    return np.concatenate(points), np.concatenate(normals)


def _extruded(points: Array, width: ArrayLike) -> Array:
    along = np.asarray(width, np.float64)
    return np.column_stack([np.repeat(points, len(along), axis=0), np.tile(along, len(points))])


def _flat(points: Array) -> Array:
    """The same points on two sheets: on one, a turn out of the plane could pass for a mirrored fit."""
    return _extruded(points, (0.0, APART))


def _gate(target: Target, config: SearchConfig) -> float:
    """Farthest correspondence, m: the search's window, so that ICP may come from as far as it does."""
    window = min(MAX_GATE, max(config.window[:2]))
    return max(GATE_SIGMAS * target.blur, window)


def _too_little(name: str, target: Target, slice_: Slice) -> MatchResult | None:
    if target.empty:
        return MatchResult(name, LOST, status=Status("no_data", "no surface of the model is visible"))
    if len(slice_.points) < 3:
        return MatchResult(
            name, LOST, status=Status("no_data", f"only {len(slice_.points)} points in the slice")
        )
    return None


def _open3d(
    name: str, kind: Kind, target: Target, slice_: Slice, starts: tuple[Pose2D, ...], config: SearchConfig,
    prior: Pose2D,
) -> MatchResult:  # fmt: skip
    if lost := _too_little(name, target, slice_):
        return lost
    import open3d as o3d

    registration = o3d.pipelines.registration
    model = _cloud(o3d, target)
    estimation = _estimation(registration, kind, GATE_SIGMAS * target.blur)
    criteria = registration.ICPConvergenceCriteria(CHANGE, CHANGE, ITERATIONS)
    started = time.perf_counter()
    gate, best = GATE_SIGMAS * target.blur, None
    for start in starts:
        own = _flat(start.inverse().apply(slice_.points))
        own = own if kind == "point" else own[::2]  # normals in the plane forbid a mirrored fit
        data = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(own))
        try:
            found = registration.registration_icp(
                data, model, _gate(target, config), np.eye(4), estimation, criteria
            )
        except RuntimeError as error:
            failed = MatchResult(name, LOST, status=Status("rejected", f"Open3D: {error}"))
            best = best or failed
            continue
        matrix = np.asarray(found.transformation)
        result = _verdict(name, target, slice_, start, matrix, len(starts), True, started, config, prior)
        if best is None or not best.found or (result.found and _misfit(result, gate) < _misfit(best, gate)):
            best = result
    assert best is not None
    return best


def _estimation(registration: Any, kind: Kind, scale: float) -> Any:
    if kind == "point":
        return registration.TransformationEstimationPointToPoint()
    if kind == "plane":
        return registration.TransformationEstimationPointToPlane()
    return registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=scale))


def _cloud(o3d: Any, target: Target) -> Any:
    """The model as a cloud with normals; kept with the target's tables, as those of a search are."""
    with target.lock:
        cloud = target.kept.get("open3d")
        if cloud is None:
            points, normals = sample(target.edges)
            cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(_flat(points)))
            across = np.zeros((2 * len(normals), 3))
            across[:, :2] = np.repeat(normals, 2, axis=0)
            cloud.normals = o3d.utility.Vector3dVector(across)
            target.kept["open3d"] = cloud
    return cloud


def _verdict(
    name: str, target: Target, slice_: Slice, start: Pose2D, matrix: Array, evaluations: int,
    converged: bool, started: float, config: SearchConfig, prior: Pose2D,
) -> MatchResult:  # fmt: skip
    """What a motion of the data (4 x 4) means for the model."""
    seconds = time.perf_counter() - started
    if not np.all(np.isfinite(matrix)):
        return MatchResult(name, LOST, status=Status("rejected", "the solution is not a number"))
    motion = Pose2D(float(matrix[0, 3]), float(matrix[1, 3]), math.atan2(matrix[1, 0], matrix[0, 0]))
    pose, status = start @ motion.inverse(), OK
    if not converged:
        status = Status("weak", f"not converged within {ITERATIONS} iterations")
    if _left(slice_.points, prior, pose, config):
        pose, status = prior, Status("weak", "it left the window that a search is held to: its start is kept")
    share, rmse = fitness_of(target, slice_.points, pose)
    if share == 0.0:
        status = Status("rejected", "no point lies near the model")
    return MatchResult(
        name, pose.as_array(), evaluations=evaluations, status=status, fitness=share, inlier_rmse=rmse,
        seconds=seconds,
    )  # fmt: skip


def _left(points: Array, prior: Pose2D, pose: Pose2D, config: SearchConfig) -> bool:
    """Whether the data would have to move by more than the window, their middle taken."""
    motion = (prior.inverse() @ pose).inverse()
    middle = np.mean(prior.inverse().apply(points), axis=0)
    moved = np.abs([*(motion.apply(middle) - middle), motion.theta])
    return bool(np.any(moved > np.add(config.window, config.tolerance)))


def _misfit(result: MatchResult, gate: float) -> float:
    """Mean square distance of the points, those beyond the gate counted at it, m^2."""
    near = result.fitness * result.inlier_rmse**2 if result.fitness > 0.0 else 0.0
    return near + (1.0 - result.fitness) * gate**2
