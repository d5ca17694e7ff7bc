"""The sensor's noise from a joint's own residuals (METHOD, section 4, 'Noise')."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bimfit.config import SensorConfig
from bimfit.estimation.result import StationEstimate

_PARAMETERS = 2.2
"""Degrees of freedom that a component's pose takes from its residuals: u is hardly seen by ranges."""
_FLOOR = 0.01
_FEW = 200


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
        What to estimate with: sigma / sqrt(f), f = (1 - rho) / (1 + rho), so that correlated neighbours
        count for what they are worth. Tempering the likelihood as a whole would blunt the edges too.
    """

    sigma: float
    outlier_share: float
    miss_share: float
    correlation: float
    count: int
    sensor: SensorConfig


def estimate_noise(estimates: Sequence[StationEstimate], sensor: SensorConfig) -> Noise:
    """Estimate sigma, the shares and the correlation of neighbours over a joint.

    Parameters
    ----------
    estimates : sequence of StationEstimate
        A first pass with ``sensor``; stations that are rejected do not count.
    sensor : SensorConfig
        What was assumed; returned unchanged where there are too few residuals to say better.
    """
    squares = freedom = products = power = 0.0
    covered = outliers = misses = count = 0
    for station in estimates:
        for c in station.components:
            r = c.residuals
            if c.posterior is None or not c.status.measured or r.n_inliers < 6:
                continue
            z = r.residuals / station.growth
            squares += float(z @ z)
            freedom += len(z) - _PARAMETERS
            products += float(z[1:] @ z[:-1])
            power += float(z[1:] @ z[1:] + z[:-1] @ z[:-1]) / 2.0
            # a line through k residuals leaves their lag-1 products low by about 2.2 z^2 / k each
            products += _PARAMETERS * float(z @ z) / len(z)
            covered += r.n_covered
            outliers += round(r.outlier_share * r.n_covered)
            misses += round(r.miss_share * r.n_covered)
            count += len(z)
    if count < _FEW or freedom <= 0.0 or power <= 0.0:
        return Noise(sensor.sigma, sensor.outlier_share, sensor.miss_share, 0.0, count, sensor)
    sigma = float(np.sqrt(squares / freedom))
    rho = float(np.clip(products / power, 0.0, 0.95))
    rho = 0.0 if rho < 2.5 / np.sqrt(count) else rho
    out = max(outliers / covered, _FLOOR)
    miss = max(misses / covered, _FLOOR)
    effective = sigma * float(np.sqrt((1.0 + rho) / (1.0 - rho)))
    found = replace(
        sensor,
        sigma=effective,
        sigma_per_metre=sensor.sigma_per_metre * effective / sensor.sigma,
        outlier_share=out,
        miss_share=miss,
    )
    return Noise(sigma, out, miss, rho, count, found)
