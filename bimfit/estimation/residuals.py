"""How the returns of a component agree with where it is estimated to be (METHOD, section 5)."""

from __future__ import annotations

import numpy as np

from bimfit.config import SensorConfig
from bimfit.estimation import _kernels_residuals as kernels
from bimfit.estimation.ownership import BeamTable, Sight, Views
from bimfit.estimation.posterior import Posterior
from bimfit.estimation.result import Residuals, Unsupported
from bimfit.geometry.pose import Array

_ALIKE: Array = np.zeros(0)


def residuals_of(
    which: int,
    rows: Array,
    posterior: Posterior,
    table: BeamTable,
    views: Views,
    sight: Sight,
    sensor: SensorConfig,
    spread: Array | None,
    fixed: float,
) -> Residuals:
    """Residual statistics of the returns that speak for one component.

    Grazing returns whose misfit the pose's own uncertainty explains count as beams that meet the component,
    and as nothing else.

    Parameters
    ----------
    which : int
        0 for A, 1 for B.
    rows : ndarray, shape (m, 6)
        Edges of the designed component.
    views : Views
        What beams should see of both components where they are estimated to be.
    sight : Sight
        Which of them may speak for which.
    sensor : SensorConfig
        Where beams differ in sigma (``spread``, how many times it each has), residuals are given as they
        would be at the sensor's.
    fixed : float
        Greatest standard deviation of a direction that counts as fixed, m.
    """
    lost = min(max(sensor.miss_share + sensor.outlier_share, 0.01), 0.9)
    f, z, places, feet, lean, faces = kernels.residuals(
        which, rows, posterior.pose.as_array(), posterior.pivot, posterior.pivot_covariance, views.ranges,
        views.faces, sight.side, sight.usable, table.rows, table.start, table.eye, table.spacing,
        sensor.sigma, _ALIKE if spread is None else spread, np.array([lost, sensor.outlier_run, fixed]),
    )  # fmt: skip
    figures = f.tolist()
    n_beams, n_covered, n_inliers = (int(x) for x in figures[:3])
    rms, chi2, strays, misses, stray_run, miss_run, cusum, lag1, unexplained, edge = figures[3:13]
    return Residuals(
        n_beams, n_covered, n_inliers, rms, chi2, strays, misses, int(stray_run), int(miss_run), cusum, lag1,
        int(unexplained), edge, z, places, feet, lean, faces,
        _unsupported(f),
    )  # fmt: skip


def _unsupported(figures: Array) -> Unsupported | None:
    """The face that the pose depends on without support, if there is one."""
    face, beams, inliers = (int(x) for x in figures[14:17].tolist()) if figures[14] >= 0.0 else (-1, 0, 0)
    return None if face < 0 else Unsupported(face, beams, inliers, figures[17:20])
