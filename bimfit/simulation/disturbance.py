"""What spoils a scan: glare, ghosts, mixed pixels, spikes and bursts (METHOD, section 8)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array, Pose2D

if TYPE_CHECKING:
    from bimfit.simulation.rangefinder import Cast

Ints = NDArray[np.int64]
_STREAM = 3
_STREAK, _GHOST = 4.0, 3.0
"""Mean length of a streak and of a stretch of ghosts, beams."""
_OFF, _LEAN = (4.0, 20.0), 8.0
_APART = 0.010
_SPIKE = 0.050


@dataclass(frozen=True)
class Disturbance:
    """Shares of what goes wrong besides noise; all 0 by default.

    Attributes
    ----------
    glare : float
        Share of the beams that meet a component whose returns lie on streaks: straight runs of false points
        4 to 20 sigma off the surface.
    ghosts : float
        Share of beams, in runs, that return from a second copy of the joint, displaced by 4 to 20 sigma
        in u and v,
        always the same along a joint.
    mixed : float
        Share of beams beside an edge that return from between what is before and behind it.
    spikes : float
        Share of single returns up to 50 mm before or behind their surface.
    bursts : float
        Share of sweeps in which every beam that meets one face, drawn at random, returns nothing.
    """

    glare: float = 0.0
    ghosts: float = 0.0
    mixed: float = 0.0
    spikes: float = 0.0
    bursts: float = 0.0

    def __post_init__(self) -> None:
        for name in ("glare", "ghosts", "mixed", "spikes", "bursts"):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and 0.0 <= value <= 1.0):
                raise ConfigError(f"{name} must lie in [0, 1], got {value}")

    def __bool__(self) -> bool:
        return any((self.glare, self.ghosts, self.mixed, self.spikes, self.bursts))


class Disturber:
    """Spoils the sweeps of one joint; its draws do not shift those of motion and noise."""

    def __init__(self, disturbance: Disturbance, sigma: float, seed: int) -> None:
        self._what, self._sigma = disturbance, sigma
        self._rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_STREAM,)))
        du, dv = sigma * self._rng.uniform(*_OFF, 2) * self._rng.choice([-1.0, 1.0], 2)
        self._ghost = Pose2D(float(du), float(dv))

    @property
    def ghost(self) -> Pose2D:
        """Where the second copy of the joint stands."""
        return self._ghost

    def spoiled(self, ranges: Array, seen: Cast, ghost: Array) -> Array:
        """A sweep (n,) with its faults.

        Parameters
        ----------
        ranges : ndarray, shape (n,)
            As measured, NaN where nothing came back.
        seen : Cast
            What the beams meet.
        ghost : ndarray, shape (n,)
            True ranges to the displaced copy, inf where it is not met.
        """
        what, out = self._what, ranges.copy()
        met = seen.edge >= 0
        if what.ghosts > 0.0:
            for run in self._runs(np.isfinite(ghost), what.ghosts, _GHOST):
                out[run] = ghost[run] + self._sigma * self._rng.standard_normal(len(run))
        if what.glare > 0.0:
            for run in self._runs(met, what.glare, _STREAK):
                out[run] = self._streak(float(np.mean(seen.ranges[run])), len(run))
        if what.mixed > 0.0:
            self._mixed(out, seen.ranges)
        if what.spikes > 0.0:
            mask = met & (self._rng.random(len(out)) < what.spikes)
            out[mask] = seen.ranges[mask] + self._rng.uniform(-_SPIKE, _SPIKE, int(mask.sum()))
        if self._rng.random() < what.bursts:
            faces = np.unique(np.column_stack([seen.profile, seen.edge])[met], axis=0)
            if len(faces):
                profile, edge = faces[int(self._rng.integers(len(faces)))]
                out[(seen.profile == profile) & (seen.edge == edge)] = np.nan
        return out

    def _runs(self, able: NDArray[np.bool_], share: float, mean: float) -> Iterator[Ints]:
        """Runs of beams that together make up ``share`` of those that are able."""
        places = np.flatnonzero(able)
        done: set[int] = set()
        while len(done) < share * len(places):
            k = int(self._rng.integers(len(places)))
            run = places[k : k + int(self._rng.geometric(1.0 / mean))]
            done.update(run.tolist())
            yield run

    def _streak(self, true: float, count: int) -> Array:
        """Ranges of a straight run of false points off a surface at range ``true``."""
        middle = true + self._sigma * self._rng.uniform(*_OFF) * self._rng.choice([-1.0, 1.0])
        lean = (
            self._sigma
            * self._rng.uniform(-_LEAN, _LEAN)
            * (np.linspace(-0.5, 0.5, count) if count > 1 else np.zeros(1))
        )
        return np.asarray(middle + lean + self._sigma * self._rng.standard_normal(count))

    def _mixed(self, out: Array, true: Array) -> None:
        """Beams whose footprint lies across an edge."""
        for k in range(len(out) - 1):
            a, b = true[k], true[k + 1]
            if not (math.isfinite(a) or math.isfinite(b)) or abs(a - b) < _APART:
                continue
            near = min(a, b)
            far = max(a, b) if math.isfinite(max(a, b)) else near + _SPIKE
            at = k if self._rng.random() < 0.5 else k + 1
            if self._rng.random() < self._what.mixed:
                out[at] = near + self._rng.random() * (far - near)
