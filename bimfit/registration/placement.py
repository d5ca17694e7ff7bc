"""Place a cloud against a model when nothing is known of the pose.

Rotations come from pairing the cloud's main face directions with the model's, translations from a
correlation of both on a voxel grid, so that neither features nor a first guess are needed and what does
not belong to the model (floor, tables) costs nothing but time. The best candidates are refined robustly
and ranked by what they explain of the cloud.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from bimfit.errors import ConfigError, ScanError
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array, rigid_inverse, transform_points
from bimfit.geometry.status import OK, Status
from bimfit.registration.candidates_3d import (
    coarse_translations,
    main_directions,
    rotation_candidates,
    thin,
)
from bimfit.registration.grcsm_3d import match_3d
from bimfit.registration.result import MatchResult, Mode
from bimfit.registration.rigid_3d import Refined, Refiner, T_scan_model, parameters_of
from bimfit.registration.surface_3d import Caster, Surface, visible_surface
from bimfit.registration.table_3d import Target3D

NO_POSE = np.full(6, np.nan)


@dataclass(frozen=True)
class PlacementConfig:
    """How a cloud is placed.

    Attributes
    ----------
    sigma : float
        The least spread that residuals are given, m.
    max_points : int
        The cloud is thinned to about so many points.
    max_rotations : int
        Rotations tried.
    peaks : int
        Translations kept a rotation.
    refined : int
        Candidates refined to the end.
    min_fitness, min_coverage : float
        Share of the cloud explained, and of the model's visible surface covered; a placement that
        reaches neither is rejected, unless
    min_purity : float
        this share is explained of the points in the model's own box, and they fix all six directions.
    rival : float
        Another placement that explains more than this share of what the best one does is a rival.
    blur : float
        Of the certificate's target, m; about twice the sensor's sigma.
    window : (float, float)
        Half widths of the certificate's window, m and rad.
    time_budget : float or None
        Of the certificate, s.
    """

    sigma: float = 0.001
    max_points: int = 2000
    max_rotations: int = 240
    peaks: int = 4
    refined: int = 8
    min_fitness: float = 0.4
    min_coverage: float = 0.4
    min_purity: float = 0.7
    rival: float = 0.93
    blur: float = 0.004
    window: tuple[float, float] = (0.03, float(np.radians(2.0)))
    time_budget: float | None = 30.0

    def __post_init__(self) -> None:
        if not self.sigma > 0.0:
            raise ConfigError(f"sigma must be a positive number, got {self.sigma}")
        if min(self.max_points, self.max_rotations, self.peaks, self.refined) < 1:
            raise ConfigError("max_points, max_rotations, peaks and refined must be at least 1")


@dataclass(frozen=True)
class _Placed:
    """One refined candidate; ``purity`` is the share explained of the points in the model's own box."""

    refined: Refined
    score: float
    fitness: float
    coverage: float
    purity: float


def place_cloud(
    points: ArrayLike,
    mesh: TriangleMesh,
    *,
    viewpoint: ArrayLike | None = None,
    seed: int = 0,
    config: PlacementConfig | None = None,
    certify: bool = False,
) -> MatchResult:
    """Find where the model is in a cloud, from nothing.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        The cloud in its own (the scanner's) frame, m; it may show other things too.
    mesh : TriangleMesh
        The designed model, m.
    viewpoint : array_like, shape (3,), optional
        Where the scanner stood, in the cloud's frame. It tells front from back and what can be seen.
    seed : int
        Of the thinning of the cloud.
    config : PlacementConfig, optional
    certify : bool
        Prove the placement the best within ``config.window`` of it by :func:`grcsm_3d.match_3d`; ``score``,
        ``bound``, ``evaluations`` and ``stop`` are then the certificate's. Takes seconds.

    Returns
    -------
    MatchResult
        ``parameters`` is the motion (x, y, z, rotation vector) of the model into the cloud's frame
        (``rigid_3d.T_model_scan`` inverts it); ``score`` the points explained, ``modes`` the rival
        placements. Status ``ambiguous`` names rivals, ``weak`` the directions that the cloud does not
        fix, ``rejected`` says why no placement is to be trusted.

    Raises
    ------
    ScanError
        When the points are not an (n, 3) array of finite numbers.
    ModelError
        When the model has no surface.
    """
    begun = time.perf_counter()
    settings = config or PlacementConfig()
    cloud = _checked(points)
    if len(cloud) < 10:
        status = Status("no_data", f"{len(cloud)} points are too few to place a cloud")
        return MatchResult("placement", NO_POSE.copy(), status=status)
    eye = None if viewpoint is None else np.asarray(viewpoint, float)
    size = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
    data, normals, flat = thin(cloud, size, settings.max_points, eye, seed)
    surface = visible_surface(mesh, size / 80.0)
    starts, tried = _coarse(data, normals, flat, surface, size, settings, signed=eye is not None)
    placed = _refine_all(starts, data, normals, surface, size, settings, eye)
    if eye is not None:
        placed = [_with_view(p, data, normals, mesh, size, settings, eye) for p in placed]
        placed.sort(key=lambda p: -p.score)
    result = _verdict(placed, mesh, tried, settings, time.perf_counter() - begun)
    return _certified(result, mesh, data, eye, size, settings) if certify and result.found else result


def _certified(
    result: MatchResult,
    mesh: TriangleMesh,
    data: Array,
    eye: Array | None,
    size: float,
    settings: PlacementConfig,
) -> MatchResult:
    """The placement with the certificate of an exact search around it; the better pose of the two."""
    prior = T_scan_model(result)
    back = rigid_inverse(prior)
    view = None if eye is None else transform_points(back, eye)
    target = Target3D.of(mesh, max(settings.blur, size / 150.0), viewpoint=view)
    # What lies far from the model only adds to the search's cost, never to its score.
    local = transform_points(back, data)
    margin = settings.window[0] + 3.0 * target.blur
    near = np.all((local >= mesh.bounds[0] - margin) & (local <= mesh.bounds[1] + margin), axis=1)
    chosen = data[near][:: max(1, int(near.sum()) // 800)]
    shift, turn = settings.window
    step = (0.001,) * 3 + (float(np.radians(0.1)),) * 3
    proof = match_3d(
        target, chosen, prior, (shift,) * 3 + (turn,) * 3, step, time_budget=settings.time_budget
    )
    if not proof.found:
        return replace(result, status=proof.status)
    apart = motion_apart(rigid_inverse(T_scan_model(proof)), back, mesh.vertices)
    moved = apart > 3.0 * target.blur
    status = result.status if proof.status.name == "ok" or result.status.name == "ambiguous" else proof.status
    if moved and result.status.name == "ok":
        reason = f"an exact search around the placement prefers one {1e3 * apart:.0f} mm away"
        status = Status("ambiguous", reason)
    return replace(
        result,
        parameters=proof.parameters if moved else result.parameters,
        modes=(*result.modes, Mode(result.parameters, float("nan"))) if moved else result.modes,
        score=proof.score,
        bound=proof.bound,
        evaluations=proof.evaluations,
        stop=proof.stop,
        status=status,
        seconds=result.seconds + proof.seconds,
    )


def _checked(points: ArrayLike) -> Array:
    try:
        cloud = np.asarray(points, float)
    except (TypeError, ValueError) as error:
        raise ScanError("the points are not numbers", remedy="give an (n, 3) array in metres") from error
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ScanError(f"points must be an (n, 3) array, got shape {cloud.shape}")
    if not np.all(np.isfinite(cloud)):
        raise ScanError("points hold NaN or infinite coordinates", remedy="drop missing returns first")
    return cloud


def _coarse(
    data: Array,
    normals: Array,
    flat: Array,
    surface: Surface,
    size: float,
    settings: PlacementConfig,
    *,
    signed: bool,
) -> tuple[list[Array], int]:
    """Starting motions (cloud to model), most promising first, and how many were tried."""
    faces = main_directions(surface.normals, np.ones(len(surface)), signed=True)
    seen = main_directions(normals, flat, signed=signed)
    rotations = rotation_candidates(seen, faces, settings.max_rotations)
    starts = coarse_translations(data, surface, rotations, size, settings.peaks)
    refiner = Refiner(surface)
    gate = size / 20.0
    scored = []
    for T in starts:
        moved = transform_points(T, data)
        pairs = refiner.pair(moved, normals @ T[:3, :3].T, gate)
        r = pairs.residual[pairs.near] / gate
        scored.append(float(np.sum((1.0 - r**2) ** 2)))
    order = np.argsort(-np.asarray(scored), kind="stable")
    return [starts[i] for i in order], len(starts)


def _refine_all(
    starts: list[Array],
    data: Array,
    normals: Array,
    surface: Surface,
    size: float,
    settings: PlacementConfig,
    eye: Array | None,
) -> list[_Placed]:
    """Refine in two rounds: many starts a little, then the best apart from each other to the end."""
    refiner = Refiner(surface)
    gates = (size / 16.0, size / 32.0)
    sketch = data[:: max(1, len(data) // 350)]
    turned = normals[:: max(1, len(data) // 350)]
    rough: list[tuple[float, Array]] = []
    for T in starts[: 5 * settings.refined]:
        first = refiner.refine(sketch, T, gates=gates, floor=settings.sigma, normals=turned, iterations=4)
        judged = refiner.judge(sketch, first.T, size / 100.0, turned)
        rough.append((float(judged.inlier.sum()), first.T))
    rough.sort(key=lambda pair: -pair[0])
    chosen: list[Array] = []
    for count, T in rough:
        # Far behind the best after a rough fit: no finish makes a rival of it.
        if count < 0.6 * rough[0][0]:
            break
        if all(motion_apart(T, other, surface.points) > 0.03 * size for other in chosen):
            chosen.append(T)
        if len(chosen) == settings.refined:
            break
    out = [_finish(refiner, T, data, normals, size, settings, eye) for T in chosen]
    return sorted(out, key=lambda p: -p.score)


def _finish(
    refiner: Refiner,
    T: Array,
    data: Array,
    normals: Array,
    size: float,
    settings: PlacementConfig,
    eye: Array | None,
) -> _Placed:
    gates = (size / 24.0, size / 48.0, size / 96.0)
    result = refiner.refine(data, T, gates=gates, floor=settings.sigma, normals=normals)
    judged = refiner.judge(data, result.T, max(result.sigma, size / 500.0), normals)
    moved = transform_points(result.T, data)
    coverage = _coverage(refiner.surface, moved, size)
    inliers = float(judged.inlier.sum())
    low, high = refiner.surface.points.min(axis=0), refiner.surface.points.max(axis=0)
    within = np.all((moved > low - 0.02 * size) & (moved < high + 0.02 * size), axis=1)
    purity = inliers / max(float(within.sum()), 1.0)
    return _Placed(result, inliers, inliers / len(data), coverage, purity)


def _with_view(
    placed: _Placed,
    data: Array,
    normals: Array,
    mesh: TriangleMesh,
    size: float,
    settings: PlacementConfig,
    eye: Array,
) -> _Placed:
    """Fit again to what the scanner sees of the model there, and subtract points seen through it."""
    T = placed.refined.T
    seen = visible_surface(mesh, size / 80.0, transform_points(T, eye))
    again = _finish(Refiner(seen), T, data, normals, size, settings, eye)
    through = points_behind(
        mesh, transform_points(again.refined.T, data), transform_points(again.refined.T, eye), size
    )
    return _Placed(again.refined, again.score - through, again.fitness, again.coverage, again.purity)


def points_behind(mesh: TriangleMesh, points: Array, eye: Array, size: float) -> int:
    """How many points (n, 3) the sensor could only have seen through the mesh, all in its frame."""
    ray = points - eye
    length = np.maximum(np.linalg.norm(ray, axis=1), 1e-12)
    hit = Caster(mesh).hit_distance(np.broadcast_to(eye, ray.shape), ray / length[:, None])
    return int(np.sum(hit < length - 0.05 * size))


def _coverage(surface: Surface, moved: Array, size: float) -> float:
    """Share of the surface's samples that have a cloud point within size / 40."""
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(moved).query(surface.points, distance_upper_bound=size / 40.0)
    return float(np.mean(np.isfinite(distance)))


def motion_apart(T_a: Array, T_b: Array, model_points: Array) -> float:
    """How far two motions (cloud to model) put the model apart in the cloud, at most, m."""
    low, high = model_points.min(axis=0), model_points.max(axis=0)
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    a = transform_points(rigid_inverse(T_a), corners)
    b = transform_points(rigid_inverse(T_b), corners)
    return float(np.linalg.norm(a - b, axis=1).max())


def _verdict(
    placed: list[_Placed], mesh: TriangleMesh, tried: int, settings: PlacementConfig, seconds: float
) -> MatchResult:
    if not placed:
        status = Status("rejected", "no candidate placement of the model was found in the cloud")
        return MatchResult("placement", NO_POSE.copy(), status=status, evaluations=tried, seconds=seconds)
    best = placed[0]
    size = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
    rivals = [
        p
        for p in placed[1:]
        if p.score >= settings.rival * best.score
        and motion_apart(p.refined.T, best.refined.T, mesh.vertices) > 0.05 * size
    ]
    modes = tuple(Mode(parameters_of(rigid_inverse(p.refined.T)), p.score) for p in rivals)
    return MatchResult(
        "placement",
        parameters_of(rigid_inverse(best.refined.T)),
        score=best.score,
        evaluations=tried,
        stop="converged",
        status=_status(best, rivals, settings),
        fitness=best.fitness,
        inlier_rmse=best.refined.rmse,
        modes=modes,
        seconds=seconds,
    )


def _status(best: _Placed, rivals: list[_Placed], settings: PlacementConfig) -> Status:
    names = best.refined.information.names()
    # Amid a large scene a model seen from one side reaches neither share, but is alone in its own box.
    alone = best.purity >= settings.min_purity and not names and best.coverage >= 0.6 * settings.min_coverage
    if best.fitness < settings.min_fitness and best.coverage < settings.min_coverage and not alone:
        return Status(
            "rejected",
            f"the best placement explains {best.fitness:.0%} of the cloud and covers"
            f" {best.coverage:.0%} of the model's surface",
        )
    if rivals:
        shares = ", ".join(f"{p.score / best.score:.0%}" for p in rivals)
        return Status(
            "ambiguous", f"{len(rivals)} other placement(s) explain about as much of the cloud: {shares}"
        )
    if names:
        return Status("weak", "the cloud does not fix: " + ", ".join(names))
    return OK
