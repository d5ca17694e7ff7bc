"""From gap sections to one mesh and the two volumes of a joint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bimfit.estimation.motion import Couplings
from bimfit.gap.mesh import GapMesh, loft
from bimfit.gap.section import area_gradient
from bimfit.gap.volume import Volumes, gap_volumes
from bimfit.geometry.pose import Array
from bimfit.pipeline.records import StationResult


def stitch(
    stations: Sequence[StationResult], ring: float | None = None, correlation: Array | None = None
) -> tuple[GapMesh | None, Volumes | None]:
    """Loft the measured stations and take the paper's volume beside the mesh's.

    Parameters
    ----------
    stations : sequence of StationResult
    ring : float, optional
        Length of a path that closes on itself, m.
    correlation : ndarray, shape (n, n), optional
        Of the errors of the stations' areas; independent unless given.
    """
    gaps = [station.gap for station in stations]
    if not any(gap is not None for gap in gaps):
        return None, None
    mesh = loft(gaps, ring=ring)
    return (None if mesh.empty else mesh), gap_volumes(
        gaps, mesh, ring=ring, correlation=0.0 if correlation is None else correlation
    )


def area_correlation(stations: Sequence[StationResult], couplings: Couplings) -> Array:
    """Correlation (n, n) of the errors of the stations' areas, from a model of the motion along the joint.

    What one station is surer or less sure of than the model is its own and does not correlate.
    """
    n = len(stations)
    gradients = np.zeros((n, 6))
    for i, station in enumerate(stations):
        a, b = (c.pose for c in station.components)
        if a is not None and b is not None:
            gradients[i] = area_gradient(station.section.gap, a, b)
    total = np.zeros((n, n))
    for which, coupling in enumerate(couplings):
        poses = [station.components[which].pose for station in stations]
        total += coupling.between(gradients[:, 3 * which : 3 * which + 3], poses)
    own = [0.0 if s.gap is None or s.gap.sigma is None else s.gap.sigma.area for s in stations]
    sd = np.maximum(np.sqrt(np.diag(total)), own)
    sd[sd == 0.0] = 1.0
    correlation = np.asarray(total / sd[:, None] / sd[None, :])
    np.fill_diagonal(correlation, 1.0)
    return correlation
