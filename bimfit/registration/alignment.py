"""Align a scan that is nearly in place: the certified search in space on the surroundings of the joints.

A robot knows where it is to several centimetres and degrees. The visible surface near the joints is the
target, the scan near them the data; what comes back carries the scan into the model's frame, with the proof
that no motion within the window fits better, or it is refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bimfit.errors import ConfigError, ScanError
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array, rigid_inverse, transform_points
from bimfit.registration.grcsm_3d import match_3d
from bimfit.registration.result import MatchResult
from bimfit.registration.rigid_3d import matrix_of, parameters_of
from bimfit.registration.surface_3d import Surface, clipped, visible_surface
from bimfit.registration.table_3d import Target3D, affordable_spacing

_FINE, _CELLS = 4.0, 2.0
"""Lattice steps a blur, of the motion and of the target."""
_TURNS = (math.radians(0.02), math.radians(0.2))
_PARALLEL = 0.99
_OPEN_GAP = 0.1
_RIVAL = 0.02
"""Another motion that scores within this share of the best is as good."""
_LEAST_POINTS = 50


@dataclass(frozen=True)
class AlignConfig:
    """How far a scan may be off, and how it is aligned.

    Attributes
    ----------
    shift, turn : float
        Half window: of the scan's middle along each axis (m), and of the rotation about it (rad).
    blur : float
        Of the target, m: about twice the sensor's noise, and what components may have moved by themselves.
    points : int
        The scan is thinned to about so many points.
    eps : float
        No other motion of the window scores more than (1 + eps) times the best one.
    time_budget : float or None
        Of the search, s.
    """

    shift: float = 0.05
    turn: float = math.radians(3.0)
    blur: float = 0.008
    points: int = 600
    eps: float = 0.02
    time_budget: float | None = 30.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.shift) and self.shift > 0.0 and 0.0 < self.turn <= math.pi):
            raise ConfigError(
                f"an alignment's window must be positive, and its angle at most pi, got {self.shift} m and"
                f" {self.turn} rad"
            )
        if not self.blur > 0.0 or self.points < _LEAST_POINTS:
            raise ConfigError(f"blur must be positive and points at least {_LEAST_POINTS}")


@dataclass(frozen=True)
class Alignment:
    """How a scan was aligned.

    Attributes
    ----------
    T_model_scan : ndarray, shape (4, 4)
        Carries the scan into the model's frame.
    moved : float
        By how much the scan's middle moved, m.
    turned : float
        Rotation, rad.
    config : AlignConfig
    result : MatchResult
        The search's certificate; its parameters are the motion of the model, the inverse.
    points : int
        How many points were matched; no score can be more.
    held : tuple of str
        Directions along the joints that nothing in the scan fixes: there it was left where it was.
    """

    T_model_scan: Array
    moved: float
    turned: float
    config: AlignConfig
    result: MatchResult
    points: int
    held: tuple[str, ...] = ()


def align_scan(
    mesh: TriangleMesh,
    boxes: Array,
    points: Array,
    along: Sequence[ArrayLike],
    config: AlignConfig,
    viewpoint: ArrayLike | None = None,
) -> Alignment:
    """Find the small motion that carries a scan onto the model near the joints, and prove it.

    Parameters
    ----------
    mesh : TriangleMesh
        The model's elements near the joints, m.
    boxes : ndarray, shape (k, 2, 3)
        Where the joints' surroundings are: only the surface in them counts.
    points : ndarray, shape (n, 3)
        What the scan shows there and as far around as the window reaches.
    along : sequence of array_like, shape (3,)
        Directions of the joints' legs. The one thing that need not be fixed is a shift along all of them.
    config : AlignConfig
    viewpoint : array_like, shape (3,), optional
        Where the sensor stood, roughly.

    Raises
    ------
    ScanError
        When too few points are there, the best motion explains too little, lies at the window's edge or has
        a rival, or a direction stays open: then an alignment is not safe.
    """
    surface = _surroundings(mesh, boxes, config.blur, viewpoint)
    cell = max(config.blur / _CELLS, affordable_spacing(surface, config.blur))
    blur = _CELLS * cell
    target = Target3D.of(surface, blur, spacing=cell)
    chosen = thinned(points, config.points)
    if len(chosen) < _LEAST_POINTS:
        raise ScanError(f"cannot be aligned: only {len(chosen)} points lie near the joints")
    middle = 0.5 * (chosen.min(axis=0) + chosen.max(axis=0))
    lever = max(float(np.sqrt(np.mean(np.sum((chosen - middle) ** 2, axis=1)))), 1e-6)
    step = (blur / _FINE,) * 3 + (float(np.clip(blur / _FINE / lever, *_TURNS)),) * 3
    window = (config.shift,) * 3 + (config.turn,) * 3
    result = match_3d(
        target, chosen, None, window, step, eps=config.eps, delta=_RIVAL, time_budget=config.time_budget
    )
    held = _held(result, along)
    _check(result, held, _all_along(result, along, middle, lever, blur), config)
    T = rigid_inverse(matrix_of(result.parameters))
    return Alignment(
        T,
        float(np.linalg.norm(transform_points(T, middle) - middle)),
        float(np.linalg.norm(parameters_of(T)[3:])),
        config,
        result,
        len(chosen),
        held,
    )


def _surroundings(mesh: TriangleMesh, boxes: Array, blur: float, viewpoint: ArrayLike | None) -> Surface:
    """The visible surface in boxes: of a large element only the part that matters is sampled."""
    near = clipped(mesh, boxes, 0.25)
    if not len(near.faces):
        raise ScanError("cannot be aligned: the model has no surface near the joints")
    spacing = max(blur / 2.0, math.sqrt(float(np.linalg.norm(near.face_vectors, axis=1).sum()) / 4e5))
    surface = visible_surface(near, spacing, viewpoint)
    low, high = boxes[:, 0], boxes[:, 1]
    inside = np.zeros(len(surface), bool)
    for a, b in zip(low, high, strict=True):
        inside |= ((surface.points >= a) & (surface.points <= b)).all(axis=1)
    if not inside.any():
        raise ScanError("cannot be aligned: the model has no visible surface near the joints")
    return surface.subset(inside, unsigned=surface.unsigned)


def thinned(points: Array, count: int, seed: int = 0) -> Array:
    """About ``count`` of the points (n, 3), evenly spread in space: one, drawn at random, a cell."""
    if len(points) <= count:
        return points
    points = np.random.default_rng(seed).permutation(points)
    low = points.min(axis=0)
    size = float(np.ptp(points, axis=0).max()) or 1.0
    small, large = size / 4096.0, size
    first = np.arange(len(points))
    for _ in range(24):  # the cell's side at which about so many are occupied
        side = math.sqrt(small * large)
        cells = np.floor((points - low) / side).astype(np.int64)
        _, first = np.unique((cells[:, 0] << 40) + (cells[:, 1] << 20) + cells[:, 2], return_index=True)
        if abs(len(first) - count) <= 0.05 * count:
            break
        small, large = (side, large) if len(first) > count else (small, side)
    return np.asarray(points[np.sort(first)][: 2 * count])


def _held(result: MatchResult, along: Sequence[ArrayLike]) -> tuple[str, ...]:
    """Names of the open directions, where all of them are shifts along all joints; else none."""
    axes = [np.asarray(a, float) / np.linalg.norm(a) for a in along]
    names = []
    for name, vector in result.flat:
        shift = vector[:3] / max(float(np.linalg.norm(vector)), 1e-300)
        if not axes or any(abs(float(shift @ axis)) < _PARALLEL for axis in axes):
            return ()
        names.append(name)
    return tuple(names)


def _all_along(
    result: MatchResult, along: Sequence[ArrayLike], middle: Array, lever: float, blur: float
) -> bool:
    """Whether all rival motions differ from the best one by no more than a shift along all joints."""
    axes = [np.asarray(a, float) / np.linalg.norm(a) for a in along]
    if any(abs(float(axes[0] @ axis)) < _PARALLEL for axis in axes):
        return False
    best = matrix_of(result.parameters)
    for mode in result.modes:
        apart = rigid_inverse(best) @ matrix_of(mode.parameters)
        shift = transform_points(apart, middle) - middle
        across = shift - (shift @ axes[0]) * axes[0]
        turn = lever * float(np.linalg.norm(parameters_of(apart)[3:]))
        if max(float(np.linalg.norm(across)), turn) > blur:
            return False
    return True


def _check(result: MatchResult, held: tuple[str, ...], along_only: bool, config: AlignConfig) -> None:
    remedy = "give --scan-pose, or a scan that shows more of the joint's surroundings"
    status = result.status
    if not status.measured:
        raise ScanError(f"cannot be aligned safely: {status.reason}", remedy=remedy)
    if result.flat and not held:
        names = ", ".join(name for name, _ in result.flat)
        raise ScanError(f"cannot be aligned safely: its points do not fix: {names}", remedy=remedy)
    if status.name == "weak" and not result.flat:
        wider = f"widen --align-window {1e3 * config.shift:g}mm,{math.degrees(config.turn):g}deg"
        raise ScanError(f"cannot be aligned safely: {status.reason}", remedy=wider)
    if status.name == "ambiguous" and not along_only:
        raise ScanError(f"cannot be aligned safely: {status.reason}", remedy=remedy)
    if not result.gap <= max(_OPEN_GAP, config.eps) * result.score:
        share = result.gap / max(result.score, 1e-300)
        raise ScanError(
            f"cannot be aligned safely: after {result.seconds:.0f} s another motion could still score"
            f" {share:.0%} more",
            remedy="narrow --align-window",
        )
