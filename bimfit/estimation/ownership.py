"""Which beams speak for which component, and what covering each of them costs.

METHOD section 4, step 2, and the occlusion of one component by the other. In the first round beams are split
at the bearing of the combined gap's centre. Where one component hides part of the other, or hardly a beam
passes between them, a second round repeats each posterior given the other component's estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bimfit.estimation import _kernels_beams, _kernels_sight
from bimfit.estimation.likelihood import BeamModel, BeamSet
from bimfit.geometry.pose import Array, Pose2D

Mask = NDArray[np.bool_]
Ints = NDArray[np.int64]
_SAME_SURFACE = 0.05
_NO_SCALE: Array = np.zeros(0)


@dataclass(frozen=True)
class BeamTable:
    """Beams, and what covering each of them adds to the log-likelihood, as the kernels take them.

    Attributes
    ----------
    rows : ndarray, shape (9, n + PAD)
        Pseudo-angle, direction and range; the cost of covering the beam whatever it returned, and when it
        returned from more than ``margin`` behind the surface that should have stopped it; the range at which
        something else is in the way, m; 1 / sigma; log-odds of a return on the spot against an outlier.
    start, eye : ndarray
        As in :class:`~bimfit.estimation.likelihood.BeamSet`.
    margin : float
        m.
    spacing : float
        Usual angle between neighbouring beams, rad.
    """

    rows: Array
    start: Ints
    eye: Array
    margin: float
    spacing: float

    def __len__(self) -> int:
        return int(self.start[-1])

    @property
    def origins(self) -> Array:
        """Where each beam starts from, shape (2, n)."""
        return np.repeat(self.eye[:, :2].T, np.diff(self.start), axis=1)

    def take(self, keep: Mask) -> BeamTable:
        """The beams for which ``keep`` holds; groups left empty stay."""
        rows, start = _kernels_beams.taken(self.rows, self.start, keep)
        return replace(self, rows=rows, start=start)


def beam_table(beams: BeamSet, model: BeamModel, margin: float) -> BeamTable:
    """Beams and what covering each costs when nothing is known of the other component.

    A beam that returned nothing, or from behind, speaks against a face in its way. Only a return that a
    neighbouring beam bears out counts as from behind: floors come in runs, outliers alone.
    """
    scale = _NO_SCALE if beams.scale is None else beams.scale
    rows = _kernels_beams.table(
        beams.rays, beams.r, scale, 1.0 / model.sigma, math.log(model.amplitude), model.miss, model.past,
        _SAME_SURFACE,
    )  # fmt: skip
    return BeamTable(rows, beams.start, beams.eye, margin, beams.spacing)


@dataclass(frozen=True)
class Sight:
    """What beams should see with both components at one pose, and which of them may speak.

    Attributes
    ----------
    ranges, faces : ndarray, shape (2, n)
        Range to A and to B by itself, inf where the beam does not meet it, and the edge met, -1 for none.
    side : ndarray, shape (n,)
        On whose side of the gap's centre the beam passes: 0 for A, 1 for B, -1 where a group of beams meets
        neither. Where that leaves many beams on the wrong side, the cut that separates the components best.
    may : ndarray of bool, shape (3, n)
        Beams that may speak at all, and for A and for B while the other is known from this pose alone.
    """

    ranges: Array
    faces: Ints
    side: Ints
    may: Mask

    @property
    def usable(self) -> Mask:
        """Beams that may speak at all."""
        return np.asarray(self.may[0])

    def first(self, which: int) -> Mask:
        """Beams for one component when the other is known from the combined pose alone."""
        return np.asarray(self.may[1 + which])


@dataclass(frozen=True)
class Views:
    """What beams should see with each component at a pose of its own.

    Attributes
    ----------
    ranges, faces : ndarray, shape (2, n)
        As in :class:`Sight`.
    passed : int
        Beams that went in between the two mouth corners: missing, or back from deeper than the mouth; 0 as
        well where fewer than half of the beams between the corners did so, for then something is there.
    close : bool
        Whether one component hides part of the other, or hardly a beam passes between them.
    """

    ranges: Array
    faces: Ints
    passed: int
    close: bool


def second_round(
    which: int, views: Views, sight: Sight, table: BeamTable, model: BeamModel, pose: Pose2D, shallow: float
) -> tuple[Mask, BeamTable]:
    """Beams that speak for one component, and what they cost, when the other has been estimated.

    Returns that the other explains count for it. Those on its side near the mouth may not be claimed even by
    a surface that would explain them equally well, for two bodies do not fill the same place.

    Parameters
    ----------
    shallow : float
        Height above which a return of the combined ``pose``'s frame is near the mouth, m; inf for nowhere.
    """
    sigma = float(np.hypot(model.sigma, 0.001))
    use, rows = _kernels_sight.claim(
        which, views.ranges, sight.side, table.rows, table.eye, table.start, sight.usable, pose.as_array(),
        shallow, sigma, model.amplitude * model.sigma / sigma, model.past,
    )  # fmt: skip
    return use, replace(table, rows=rows)


def beside_artificial_ends(
    sight: Sight,
    beams: BeamSet,
    edges: tuple[Array, Array],
    surface: tuple[Mask, Mask],
    margin: float,
) -> Mask:
    """Beams that cannot be judged, because the profile was clipped or guessed there; shape (n,).

    The component goes on where its clipped profile ends: a return beyond the end is no evidence that the
    profile should be shifted outwards to cover it.

    Parameters
    ----------
    edges : tuple of ndarray, shape (m, 2, 2)
        Both components' edges at the pose of the sight.
    surface : tuple of ndarray of bool, shape (m,)
        Which of them are surface.
    margin : float
        Beams that close to such an end are left out too, m.
    """
    out = np.zeros(len(beams), bool)
    for which in (0, 1):
        if surface[which].all():
            continue
        face, rho = sight.faces[which], sight.ranges[which]
        met = face >= 0
        out |= met & ~surface[which][np.maximum(face, 0)]
        hits = (beams.origins + beams.d * np.where(met, rho, 0.0)).T
        close = np.zeros(len(beams), bool)
        for a, b in edges[which][~surface[which]]:
            close |= met & (_distance(hits, a, b) < margin)
        if not close.any():
            continue
        out |= close
        for g in range(len(beams.eye)):
            s, t = int(beams.start[g]), int(beams.start[g + 1])
            own = np.flatnonzero(met[s:t])
            if not len(own):
                continue
            if close[s + own[0]]:
                out[s : s + own[0]] |= sight.side[s : s + own[0]] == which
            if close[s + own[-1]]:
                out[s + own[-1] + 1 : t] |= sight.side[s + own[-1] + 1 : t] == which
    return out


def _distance(points: Array, a: Array, b: Array) -> Array:
    """Distance of points (n, 2) from the segment a b."""
    w = b - a
    t = np.clip((points - a) @ w / max(float(w @ w), 1e-300), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - a - t[:, None] * w, axis=1))
