"""Ranges as a URG-04LX-UG01 reports them: noise, quantisation and error codes. For the emulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ConfigError
from bimfit.sensor.scip import FIRST_MEASUREMENT, FloatArray, IntArray, Parameters


@dataclass(frozen=True)
class Noise:
    """How measured ranges differ from true ones.

    Recorded scans: sigma 2.5 to 5 mm at 1 to 2 m, neighbouring beams correlated 0.46 to 0.60, 26 to 34 % of
    neighbouring values identical. White noise gives neither of the last two, so a share of the beams repeats
    its neighbour's value and the others follow a first-order autoregression.

    Attributes
    ----------
    sigma : float or None
        Standard deviation, m; None is 2.5 mm up to 1 m and 2 mm a metre more beyond: with the values that
        are held where a surface slopes, 5 mm at 2 m.
    correlation : float
        Correlation of the errors of neighbouring beams.
    held : float
        Share of beams that repeat their neighbour's value, where the surface goes on.
    dropouts : float
        Share of beams that fail for no visible reason.
    """

    sigma: float | None = None
    correlation: float = 0.53
    held: float = 0.21
    dropouts: float = 0.005

    def __post_init__(self) -> None:
        if self.sigma is not None and not 0.0 <= self.sigma < 1.0:
            raise ConfigError(f"sigma must be at least 0 and in metres, got {self.sigma}")
        if not 0.0 <= self.held <= self.correlation < 1.0:
            raise ConfigError("noise needs 0 <= held <= correlation < 1")
        if not 0.0 <= self.dropouts < 1.0:
            raise ConfigError(f"dropouts must lie in [0, 1), got {self.dropouts}")

    def measure(self, truth: FloatArray, parameters: Parameters, rng: np.random.Generator) -> IntArray:
        """Turn true ranges into what the device sends.

        Parameters
        ----------
        truth : ndarray, shape (n,)
            Ranges of neighbouring steps, m; NaN or infinite where there is nothing.
        parameters : Parameters
            Nearest and farthest range.
        rng : numpy.random.Generator
            Source of chance.

        Returns
        -------
        ndarray, shape (n,)
            mm, or codes below 20.
        """
        truth = np.asarray(truth, dtype=np.float64)
        seen = np.isfinite(truth) & (truth * 1000.0 >= parameters.dmin) & (truth * 1000.0 <= parameters.dmax)
        seen &= rng.random(truth.shape) >= self.dropouts
        clean = np.where(seen, truth, 0.0)
        recorded = 0.0005 + 0.002 * np.maximum(clean, 1.0)
        sigma = recorded if self.sigma is None else np.full(truth.shape, self.sigma)
        held = self._held(clean, sigma, seen, rng)
        source = np.maximum.accumulate(np.where(held, 0, np.arange(truth.size)))
        # The beam after a held one follows what was shown, so errors are counted by beams that are not held.
        errors = self._errors(truth.size, rng)[np.cumsum(~held) - 1]
        codes = np.rint((clean[source] + sigma[source] * errors) * 1000.0).astype(np.int64)
        return np.where(seen, np.clip(codes, parameters.dmin, parameters.dmax), _failures(truth, seen, rng))

    def _errors(self, n: int, rng: np.random.Generator) -> FloatArray:
        from scipy.signal import lfilter

        # Held beams are fully correlated with their neighbour: held + (1 - held) a = correlation.
        a = (self.correlation - self.held) / (1.0 - self.held)
        white = rng.standard_normal(n)
        errors, _ = lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], white, zi=[a * rng.standard_normal()])
        return np.asarray(errors, dtype=np.float64)

    def _held(
        self, clean: FloatArray, sigma: FloatArray, seen: NDArray[np.bool_], rng: np.random.Generator
    ) -> NDArray[np.bool_]:
        """Which beams show their neighbour's value; never the first, nor across an edge."""
        held = rng.random(clean.shape) < self.held
        held[0:1] = False
        held[1:] &= seen[1:] & seen[:-1] & (np.abs(np.diff(clean)) <= np.maximum(sigma[1:], 0.001))
        return held


NO_NOISE = Noise(sigma=0.0, correlation=0.0, held=0.0, dropouts=0.0)


def _failures(truth: FloatArray, seen: NDArray[np.bool_], rng: np.random.Generator) -> IntArray:
    """Codes of beams without a measurement: 0 in runs, with 6 and 7 among them as recorded."""
    chance = rng.random(truth.shape)
    codes = np.where(chance < 0.62, 0, np.where(chance < 0.90, 6, 7))
    lost = np.isfinite(truth) & ~seen
    codes = np.where(lost & (codes == 0), 6, codes)
    return np.asarray(np.minimum(codes, FIRST_MEASUREMENT - 1), dtype=np.int64)
