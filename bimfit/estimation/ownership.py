"""Which beams speak for which component, and what covering each of them costs.

METHOD section 4, step 2, and the occlusion of one component by the other. In the first round beams are split
at the bearing of the combined gap's centre. Where one component hides part of the other, or hardly a beam
passes between them, a second round repeats each posterior given the other component's estimate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bimfit.estimation import _kernels
from bimfit.estimation.likelihood import BeamModel, BeamSet
from bimfit.geometry.pose import Array, Pose2D

Mask = NDArray[np.bool_]
Ints = NDArray[np.int64]
_SAME_SURFACE = 0.05


@dataclass(frozen=True)
class Scene:
    """Both components predicted at some pose each.

    Attributes
    ----------
    ranges : ndarray, shape (2, n)
        Range to A and to B by itself; inf where the beam does not meet it.
    faces : ndarray, shape (2, n)
        Edge met, -1 for none.
    """

    ranges: Array
    faces: Ints

    @classmethod
    def at(cls, rows: tuple[Array, Array], poses: Sequence[Pose2D], beams: BeamSet) -> Scene:
        """Predict both components, given by their edges (m, 6) as designed."""
        ranges, faces = np.empty((2, len(beams))), np.empty((2, len(beams)), np.int64)
        a, b = poses
        _kernels.scene(*rows, a.as_array(), b.as_array(), beams.rays, beams.start, beams.eye, ranges, faces)
        return cls(ranges, faces)

    @property
    def rho(self) -> tuple[Array, Array]:
        """Range to A and to B."""
        return self.ranges[0], self.ranges[1]

    @property
    def face(self) -> tuple[Ints, Ints]:
        """Edge of A and of B that is met."""
        return self.faces[0], self.faces[1]

    @property
    def owner(self) -> Ints:
        """0 for A, 1 for B, -1 where the beam meets neither."""
        a, b = self.rho
        nobody = ~(np.isfinite(a) | np.isfinite(b))
        return np.where(nobody, -1, np.where(a <= b, 0, 1))

    @property
    def nearest(self) -> Array:
        """Range to whichever comes first, inf for neither."""
        return np.minimum(*self.rho)


def split_side(scene: Scene, beams: BeamSet, centre: Array) -> Ints:
    """Give every beam to the component on whose side of the gap's centre it passes.

    Where that leaves many beams on the wrong side, the cut that separates the components best is taken.

    Parameters
    ----------
    centre : ndarray, shape (2,)
        Midpoint of the mouth as placed by the combined pose.

    Returns
    -------
    ndarray, shape (n,)
        0 for A, 1 for B, -1 where a group of beams meets neither.
    """
    side = np.empty(len(beams), np.int64)
    _kernels.split_side(
        scene.ranges, beams.p, beams.start, beams.eye, float(centre[0]), float(centre[1]), side
    )
    return side


@dataclass(frozen=True)
class Cost:
    """What covering each beam adds to the log-likelihood besides its residual.

    Attributes
    ----------
    off : ndarray, shape (n,)
        Whatever it returned.
    deep : ndarray, shape (n,)
        When it returned from more than ``margin`` behind the surface that should have stopped it.
    margin : float
        m.
    limit : ndarray, shape (n,)
        Range at which something else is in the way, m.
    """

    off: Array
    deep: Array
    margin: float
    limit: Array

    def take(self, keep: Mask) -> Cost:
        """The beams for which ``keep`` holds."""
        return Cost(self.off[keep], self.deep[keep], self.margin, self.limit[keep])


def packed(beams: BeamSet, cost: Cost, model: BeamModel, *, alike: bool = False) -> Array:
    """Beams and what is known of each, shape (9, n + PAD), as the kernels' likelihood takes them.

    ``alike`` where the model's sigma is another one than the sensor's: then beams count alike.
    """
    n = len(beams)
    out = np.zeros((9, n + _kernels.PAD))
    out[:3, :n], out[_kernels.RANGE, :n] = beams.rays, beams.r
    out[_kernels.OFF, :n], out[_kernels.DEEP, :n], out[_kernels.LIMIT, :n] = cost.off, cost.deep, cost.limit
    out[_kernels.INVERSE, :n], out[_kernels.TOP, :n] = 1.0 / model.sigma, math.log(model.amplitude)
    if beams.scale is not None and not alike:
        out[_kernels.INVERSE, :n] /= beams.scale
        out[_kernels.TOP, :n] -= np.log(beams.scale)
    return out


def cover_cost(beams: BeamSet, model: BeamModel, margin: float) -> Cost:
    """Cost of covering beams when nothing is known of the other component.

    A beam that returned nothing, or from behind, speaks against a face in its way. Only a return that a
    neighbouring beam bears out counts as from behind: floors come in runs, outliers alone.
    """
    off, deep = np.empty(len(beams)), np.empty(len(beams))
    _kernels.cover_cost(beams.r, model.miss, model.past, _SAME_SURFACE, off, deep)
    return Cost(off, deep, margin, np.full(len(beams), np.inf))


def explained_by(rho: Array, beams: BeamSet, model: BeamModel, sigma: float) -> Array:
    """Log-odds of 'a return from a surface at rho' against 'outlier'; 0 for misses and open beams."""
    with np.errstate(invalid="ignore"):
        q = ((beams.r - rho) / sigma) ** 2
    odds = np.log1p(
        model.amplitude * model.sigma / sigma * np.exp(-0.5 * np.where(np.isfinite(q), q, np.inf))
    )
    return np.asarray(np.where(beams.r > 0.0, odds, 0.0))


def first_round(which: int, scene: Scene, side: Ints) -> Mask:
    """Beams for one component when the other is known from the combined pose alone."""
    own, other = scene.rho[which], scene.rho[1 - which]
    return np.asarray((side == which) & ~(np.isfinite(own) & (other < own)))


def second_round(
    which: int, scene: Scene, side: Ints, beams: BeamSet, cost: Cost, model: BeamModel, *, territory: Mask
) -> tuple[Mask, Cost]:
    """The same when the other component has been estimated.

    Returns that the other explains count for it; those in its ``territory`` (n,) may not be claimed even by
    a surface that would explain them equally well, for two bodies do not fill the same place.
    """
    other = scene.rho[1 - which]
    sigma = float(np.hypot(model.sigma, 0.001))
    odds = explained_by(other, beams, model, sigma)
    with np.errstate(invalid="ignore"):
        claimed = np.isfinite(other) & (beams.r > 0.0) & (np.abs(beams.r - other) < 4.0 * sigma)
    foreign = claimed & (side != which)
    use = (side == which) | foreign | ((beams.r < 0.0) & ~np.isfinite(other))
    off = cost.off - np.where(claimed, odds, 0.0)
    # a beam that the other should have returned speaks for neither when it did not
    off = np.where((beams.r < 0.0) & np.isfinite(other), 0.0, off)
    off = off - np.where(foreign & territory, abs(model.past), 0.0)
    return use, replace(cost, off=off, limit=other + 3.0 * sigma)


def through(corners: tuple[Array, Array], beams: BeamSet, nearest: Array, depth: float, sigma: float) -> int:
    """How many beams went in between the two mouth corners: missing, or back from deeper than the mouth.

    Parameters
    ----------
    corners : tuple of two ndarray, shape (2,)
        Mouth corners of A and B as built.
    depth : float
        A return that much farther than the corners went past them, m.
    nearest : ndarray, shape (n,)
        Predicted range to either component: a return from a groove's own face went in as well.
    sigma : float
        Standard deviation of a range, m.

    Returns
    -------
    int
        0 as well where fewer than half of the beams between the corners did so: then something is there.
    """
    return int(
        _kernels.through(
            np.array(corners), beams.rays, beams.r, beams.start, beams.eye, nearest, depth, sigma
        )
    )


def meeting(scene: Scene, few: int) -> bool:
    """Whether fewer than ``few`` open beams part A from B somewhere, as in a groove closed at its root."""
    owner = scene.owner
    seen = np.flatnonzero(owner >= 0)
    change = owner[seen[1:]] != owner[seen[:-1]]
    return bool(np.any(np.diff(seen)[change] - 1 < few))


def beside_artificial_ends(
    scene: Scene,
    side: Ints,
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
        Both components' edges where the scene has them.
    surface : tuple of ndarray of bool, shape (m,)
        Which of them are surface.
    margin : float
        Beams that close to such an end are left out too, m.
    """
    out = np.zeros(len(beams), bool)
    for which in (0, 1):
        if surface[which].all():
            continue
        face, rho = scene.face[which], scene.rho[which]
        met = face >= 0
        out |= met & ~surface[which][np.maximum(face, 0)]
        origin = np.repeat(beams.eye[:, :2], np.diff(beams.start), axis=0)
        hits = origin + (beams.d * np.where(met, rho, 0.0)).T
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
                out[s : s + own[0]] |= side[s : s + own[0]] == which
            if close[s + own[-1]]:
                out[s + own[-1] + 1 : t] |= side[s + own[-1] + 1 : t] == which
    return out


def _distance(points: Array, a: Array, b: Array) -> Array:
    """Distance of points (n, 2) from the segment a b."""
    w = b - a
    t = np.clip((points - a) @ w / max(float(w @ w), 1e-300), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - a - t[:, None] * w, axis=1))
