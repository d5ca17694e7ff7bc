"""The sensor's noise from a joint's own residuals (METHOD, section 4, 'Noise')."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bimfit.config import SensorConfig
from bimfit.estimation.result import ComponentEstimate, StationEstimate
from bimfit.geometry.pose import Array

_PARAMETERS = 2.2
"""Degrees of freedom that a component's pose takes from its residuals: u is hardly seen by ranges."""
_FLOOR = 0.01
_FEW, _LEAST = 20, 6
_TAKEN = 0.3
"""Greatest share of the residuals' power that the fits are held to have taken."""
_DOUBT = 0.5
"""Standard deviation of log sigma before a return is seen: what was assumed may be wrong by 1.5."""
_SHARE_PRIOR = 30.0
"""Beams' worth of the shares that were assumed."""
_GATE = 4.0
"""A return that many assumed sigmas away is no inlier, see :mod:`bimfit.estimation.residuals`."""
_CORE, _BACKGROUND, _CLEARLY = 2.5, 0.02, 8.0
"""Where more than that share of the inliers is background (by that much log-likelihood), only those within so
many of the core's sigmas count."""


@dataclass(frozen=True)
class Noise:
    """What the residuals of a joint say about the sensor.

    Attributes
    ----------
    sigma : float
        Standard deviation of a range, m; where it grows with range, what it starts from.
    outlier_share, miss_share : float
        Of beams that meet a component; at least 0.01, for nothing is impossible.
    correlation : float
        Of neighbouring beams' residuals, in [0, 0.95].
    count : int
        Residuals behind these figures.
    sensor : SensorConfig
        What to estimate with.
    """

    sigma: float
    outlier_share: float
    miss_share: float
    correlation: float
    count: int
    sensor: SensorConfig


@dataclass
class _Sums:
    """What is summed over the components of all stations."""

    squares: float = 0.0
    products: float = 0.0
    power: float = 0.0
    gates: float = 0.0
    fits: float = 0.0
    pair_fits: float = 0.0
    count: int = 0
    covered: int = 0
    outliers: int = 0
    misses: int = 0

    def add(self, c: ComponentEstimate, z: Array, gate: float) -> None:
        """Count one component's residuals ``z``, m, none of which is over ``gate``."""
        n, r = len(z), c.residuals
        if n < _LEAST:
            return
        self.squares += float(z @ z)
        self.products += float(z[1:] @ z[:-1])
        self.power += float(z[1:] @ z[1:] + z[:-1] @ z[:-1]) / 2.0
        self.gates += n * gate * gate
        self.fits += _PARAMETERS
        self.pair_fits += _PARAMETERS * (n - 1) / n
        self.count += n
        self.covered += r.n_covered
        self.outliers += round(r.outlier_share * r.n_covered) + len(r.residuals) - n
        self.misses += round(r.miss_share * r.n_covered)


def estimate_noise(estimates: Sequence[StationEstimate], sensor: SensorConfig) -> Noise:
    """Estimate sigma, the shares and the correlation of neighbours over a joint.

    What was assumed counts as a prior, so that a few returns say little.

    Parameters
    ----------
    estimates : sequence of StationEstimate
        A pass with ``sensor``, or one much like it; stations that are rejected do not count.
    sensor : SensorConfig
        What was assumed; returned unchanged where there are hardly any residuals.
    """
    parts = list(_seen(estimates))
    core = _core([(z, gate) for _, z, gate in parts])
    sums = _Sums()
    for c, z, gate in parts:
        sums.add(c, z[np.abs(z) <= core * gate], core * gate)
    if sums.count < _FEW or sums.power <= 0.0:
        return Noise(
            sensor.sigma, sensor.outlier_share, sensor.miss_share, sensor.correlation, sums.count, sensor
        )
    variance, rho = _moments(sums)
    gate = math.sqrt(sums.gates / sums.count)
    seen = gate * _untruncated(variance / gate**2)
    share = (1.0 - rho * rho) / (1.0 + rho * rho)
    weight = 2.0 * share * max(sums.count - sums.fits, 1.0) * _DOUBT**2
    sigma = sensor.sigma * (seen / sensor.sigma) ** (weight / (1.0 + weight))
    tail = math.erfc(gate / (seen * math.sqrt(2.0)))
    strays = max(sums.outliers - sums.count * tail / (1.0 - tail), 0.0)
    total = sums.covered + _SHARE_PRIOR
    out = max((strays + _SHARE_PRIOR * sensor.outlier_share) / total, _FLOOR)
    miss = max((sums.misses + _SHARE_PRIOR * sensor.miss_share) / total, _FLOOR)
    found = replace(
        sensor,
        sigma=sigma,
        sigma_per_metre=sensor.sigma_per_metre * sigma / sensor.sigma,
        correlation=rho,
        outlier_share=out,
        miss_share=miss,
    )
    return Noise(sigma, out, miss, rho, sums.count, found)


def _seen(estimates: Sequence[StationEstimate]) -> Iterator[tuple[ComponentEstimate, Array, float]]:
    """Components to learn from, their residuals at no range, m, and what the largest may be."""
    for station in estimates:
        for c in station.components:
            z = c.residuals.residuals / station.growth
            if c.posterior is not None and c.status.measured and len(z) >= _LEAST:
                yield c, z, _GATE * station.sensor.sigma / station.growth


def _core(parts: Sequence[tuple[Array, float]]) -> float:
    """Share of the gate within which residuals are noise: 1 unless a background of strays lies under them.

    A normal cut off at the gate and a uniform background under it, by maximum likelihood from a histogram.
    A background within four sigmas would pass for noise, and the wider gate of the next round let in more.
    """
    if not parts:
        return 1.0
    x = np.concatenate([np.abs(z) / gate for z, gate in parts])
    edges = np.linspace(0.0, 1.0, 33)
    counts = np.histogram(x, edges)[0]
    sigmas = np.geomspace(0.02, 2.0, 70)
    inside = np.array([[math.erf(e / (s * math.sqrt(2.0))) for e in edges] for s in sigmas.tolist()])
    normal = np.diff(inside, axis=1) / inside[:, -1:]
    shares = np.linspace(0.0, 0.7, 36)
    mixed = (1.0 - shares)[:, None, None] * normal + shares[:, None, None] / len(counts)
    value = np.log(np.maximum(mixed, 1e-300)) @ counts
    alone, best = float(value[0].max()), np.unravel_index(int(np.argmax(value)), value.shape)
    if shares[best[0]] <= _BACKGROUND or float(value.max()) < alone + _CLEARLY:
        return 1.0
    return min(_CORE * float(sigmas[best[1]]), 1.0)


def _moments(sums: _Sums) -> tuple[float, float]:
    """Variance of a residual and lag-1 correlation, what the fits have taken out of both put back.

    A smooth curve through k residuals takes the power that they have at low frequencies: (1 + rho) /
    (1 - rho) times the variance for each of its parameters, from their squares and lag-1 products alike.
    Never more than is left to it: short faces cannot tell noise that goes together from a shape.
    """
    rho, variance = 0.0, sums.squares / sums.count
    most = max(_TAKEN * sums.count / sums.fits, 1.0)
    for _ in range(30):
        taken = min((1.0 + rho) / (1.0 - rho), most)
        variance = sums.squares / max(sums.count - sums.fits * taken, (1.0 - _TAKEN) * sums.count)
        lost = sums.pair_fits * taken * variance
        rho += 0.5 * (float(np.clip((sums.products + lost) / (sums.power + lost), 0.0, 0.95)) - rho)
    if rho < 2.5 / math.sqrt(sums.count):
        return sums.squares / max(sums.count - sums.fits, (1.0 - _TAKEN) * sums.count), 0.0
    return variance, rho


def _untruncated(variance: float) -> float:
    """Standard deviation, at most 1, of the normal whose part within -1 .. 1 has that variance."""
    low, high = 1e-6, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        x = 1.0 / middle
        inside = math.erf(x / math.sqrt(2.0))
        density = math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)
        if middle**2 * (1.0 - 2.0 * x * density / inside) < variance:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
