"""How the returns of a component agree with where it is estimated to be (METHOD, section 5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bimfit.config import SensorConfig
from bimfit.estimation import _kernels_residuals as kernels
from bimfit.estimation.likelihood import BeamSet
from bimfit.estimation.posterior import Posterior
from bimfit.estimation.result import Residuals, Unsupported
from bimfit.geometry.pose import Array


def residuals_of(
    rows: Array,
    posterior: Posterior,
    beams: BeamSet,
    met: tuple[Array, NDArray[np.int64]],
    other: Array,
    used: NDArray[np.bool_],
    sensor: SensorConfig,
    fixed: float,
) -> Residuals:
    """Residual statistics of the returns that speak for one component.

    Grazing returns whose misfit the pose's own uncertainty explains count as beams that meet the component,
    and as nothing else.

    Parameters
    ----------
    rows : ndarray, shape (m, 6)
        Edges of the designed component.
    met : tuple of ndarray, shape (n,)
        Range to the component where it is estimated to be, and the edge met.
    other : ndarray, shape (n,)
        Range to the other component, which may hide it.
    used : ndarray of bool, shape (n,)
        Beams that may speak for it.
    sensor : SensorConfig
        Where beams differ in sigma (``beams.spread``), residuals are given as they would be at the sensor's.
    fixed : float
        Greatest standard deviation of a direction that counts as fixed, m.
    """
    n, sigma = len(beams), sensor.sigma
    lost = min(max(sensor.miss_share + sensor.outlier_share, 0.01), 0.9)
    about = np.array([lost, sensor.outlier_run, fixed])
    sd = np.full(n, sigma) if beams.spread is None else sigma * beams.spread
    out, z, places = np.empty(kernels.FIGURES), np.empty(n), np.empty((n, 2))
    faces = np.empty(n, np.int64)
    count = kernels.residuals(
        rows, posterior.pose.as_array(), posterior.pivot, posterior.pivot_covariance, met[0], met[1], other,
        used.copy(), beams.d, beams.r, beams.start, beams.eye, beams.spacing, sigma, sd, about, out, z,
        places, faces,
    )  # fmt: skip
    f = out.tolist()
    return Residuals(
        int(f[0]), int(f[1]), int(f[2]), f[3], f[4], f[5], f[6], int(f[7]), int(f[8]), f[9], f[10],
        int(f[11]), f[12], z[:count], places[:count], faces[:count],
        None if f[14] < 0.0 else Unsupported(int(f[14]), int(f[15]), int(f[16]), out[17:20]),
    )  # fmt: skip
