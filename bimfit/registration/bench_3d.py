"""The published figures of the search in space: the gap scene, random starts, beside the usual methods.

The scene: two boards 200 x 25 x 500 mm with a gap of 25 mm, seen from 400 mm above; 1,000 points evenly over
what is visible, noise 3 mm. The sensor's pose is off by a uniform draw from the window about the scene's
middle; each method starts at no motion. A failure is an error over 5 mm at the middle, or over 1 degree.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array, rigid_inverse, transform_points
from bimfit.registration.baselines_3d import BASELINES_3D
from bimfit.registration.grcsm_3d import match_3d
from bimfit.registration.rigid_3d import T_model_scan, about, parameters_of
from bimfit.registration.surface_3d import visible_surface
from bimfit.registration.table_3d import Target3D

EYE = (0.0, 0.0, 0.4)
SIGMA = 0.003
BLUR = 0.006
TOLERANCE = (0.001,) * 3 + (float(np.radians(0.1)),) * 3
FAIL_SHIFT, FAIL_TURN = 0.005, float(np.radians(1.0))
_CORNERS = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


@dataclass(frozen=True)
class Row3D:
    """One method on one window.

    Attributes
    ----------
    method : str
    window : str
    starts, failures : int
    failures_across : int
        Failures when an error along the joint, which few points fix here, is not counted.
    median_ms, p95_ms : float
        Time a start; the search alone, tables ready.
    mean_mm, mean_deg : float
        Error over the starts that did not fail; NaN where all did.
    evaluations : float
        Median; NaN for methods that have none.
    proven : int
        Starts whose bound closed to within eps.
    """

    method: str
    window: str
    starts: int
    failures: int
    failures_across: int
    median_ms: float
    p95_ms: float
    mean_mm: float
    mean_deg: float
    evaluations: float = float("nan")
    proven: int = 0


@dataclass(frozen=True)
class TableRow3D:
    """Building the scene's tables: seconds and MiB."""

    seconds: float
    mebibytes: float
    spacing_mm: float


@dataclass(frozen=True)
class _Trial:
    shift: float
    across: float
    turn: float
    seconds: float
    evaluations: float = float("nan")
    proven: bool = False

    @property
    def failed(self) -> bool:
        return not (self.shift <= FAIL_SHIFT and self.turn <= FAIL_TURN)


def gap_scene() -> TriangleMesh:
    """Two boards 200 x 25 x 500 mm, gap 25 mm along y, top faces at z = 0."""
    faces = np.array([tri for a, b, c, d in _QUADS for tri in ((a, b, c), (a, c, d))])
    boards = []
    for left in (-0.2125, 0.0125):
        boards.append(_CORNERS * (0.2, 0.5, 0.025) + (left, -0.25, -0.025))
    return TriangleMesh.of(np.concatenate(boards), np.concatenate([faces, faces + 8]))


def scans(starts: int, window: tuple[float, float], points: int, seed: int) -> Iterator[tuple[Array, Array]]:
    """Seeded (motion of the scene, scan) pairs; ``window`` half widths in m and rad."""
    seen = visible_surface(gap_scene(), 0.002, EYE).points
    for k in range(starts):
        rng = np.random.default_rng((seed, k))
        cloud = seen[rng.choice(len(seen), points, replace=False)] + rng.normal(0.0, SIGMA, (points, 3))
        truth = about(
            (0.0, 0.0, 0.0), rng.uniform(-window[0], window[0], 3), rng.uniform(-window[1], window[1], 3)
        )
        yield truth, transform_points(truth, cloud)


def bench_tables_3d() -> TableRow3D:
    """Time and memory of the scene's tables; compiled code warmed up on a small one first."""
    Target3D.of(visible_surface(gap_scene(), 0.05, EYE), 0.05)
    begun = time.perf_counter()
    target = Target3D.of(gap_scene(), BLUR, viewpoint=EYE)
    return TableRow3D(time.perf_counter() - begun, target.nbytes / 2**20, 1e3 * target.spacing)


def bench_matcher_3d(
    starts: int = 50,
    windows: Iterable[tuple[float, float]] = ((0.030, float(np.radians(2.0))),),
    *,
    points: int = 1000,
    eps: float = 0.02,
    seed: int = 0,
    methods: tuple[str, ...] = ("grcsm-3d", *BASELINES_3D),
    time_budget: float | None = 60.0,
    target: Target3D | None = None,
) -> list[Row3D]:
    """Run every method on the same random starts of the gap scene.

    Parameters
    ----------
    starts : int
        Random starts a window.
    windows : iterable of (float, float)
        Half widths: m and rad.
    points, eps, seed
        Of the scan, and of the search.
    methods : tuple of str
        ``grcsm-3d`` and names of ``BASELINES_3D``; g-icp is left out where small_gicp is not installed.
    time_budget : float, optional
        Of one search, s.
    target : Target3D, optional
        The scene's tables, when they are built already.
    """
    scene = gap_scene()
    if target is None:
        target = Target3D.of(scene, BLUR, viewpoint=EYE)
    surface = visible_surface(scene, 0.004, EYE)
    rows = []
    for window in windows:
        label = f"+-{1e3 * window[0]:.0f} mm, +-{np.degrees(window[1]):.0f} deg"
        data = list(scans(starts, window, points, seed))
        for method in methods:
            if method == "g-icp" and importlib.util.find_spec("small_gicp") is None:
                continue
            trials = []
            for truth, scan in data:
                begun = time.perf_counter()
                if method == "grcsm-3d":
                    result = match_3d(
                        target,
                        scan,
                        None,
                        (window[0],) * 3 + (window[1],) * 3,
                        TOLERANCE,
                        eps=eps,
                        time_budget=time_budget,
                    )
                    T = T_model_scan(result) if result.found else np.full((4, 4), np.nan)
                    closed = result.stop in ("proven", "tolerance")
                    trials.append(_Trial(*_error(T, truth), result.seconds, result.evaluations, closed))
                else:
                    T = BASELINES_3D[method](surface, scan, np.eye(4))
                    seconds = time.perf_counter() - begun
                    trials.append(_Trial(*_error(T, truth), seconds))
            rows.append(_row(method, label, trials))
    return rows


def _error(T: Array, truth: Array) -> tuple[float, float, float]:
    """By how much ``T`` misses the inverse of ``truth``: shift, shift across the joint (m), angle (rad)."""
    if not np.all(np.isfinite(T)):
        return float("inf"), float("inf"), float("inf")
    left = parameters_of(rigid_inverse(truth) @ rigid_inverse(T))
    return float(np.linalg.norm(left[:3])), float(np.hypot(left[0], left[2])), float(np.linalg.norm(left[3:]))


def _row(method: str, window: str, trials: list[_Trial]) -> Row3D:
    good = [t for t in trials if not t.failed]
    ms = [1e3 * t.seconds for t in trials]
    return Row3D(
        method,
        window,
        starts=len(trials),
        failures=len(trials) - len(good),
        failures_across=sum(not (t.across <= FAIL_SHIFT and t.turn <= FAIL_TURN) for t in trials),
        median_ms=float(np.median(ms)),
        p95_ms=float(np.percentile(ms, 95)),
        mean_mm=1e3 * float(np.mean([t.shift for t in good])) if good else float("nan"),
        mean_deg=float(np.degrees(np.mean([t.turn for t in good]))) if good else float("nan"),
        evaluations=float(np.median([t.evaluations for t in trials])),
        proven=sum(t.proven for t in trials),
    )
