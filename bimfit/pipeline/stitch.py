"""From gap sections to one mesh and the two volumes of a joint."""

from __future__ import annotations

from collections.abc import Sequence

from bimfit.gap.mesh import GapMesh, loft
from bimfit.gap.volume import Volumes, gap_volumes
from bimfit.pipeline.records import StationResult


def stitch(
    stations: Sequence[StationResult], ring: float | None = None
) -> tuple[GapMesh | None, Volumes | None]:
    """Loft the measured stations and take the paper's volume beside the mesh's.

    Parameters
    ----------
    stations : sequence of StationResult
    ring : float, optional
        Length of a path that closes on itself, m.
    """
    gaps = [station.gap for station in stations]
    if not any(gap is not None for gap in gaps):
        return None, None
    mesh = loft(gaps, ring=ring)
    return (None if mesh.empty else mesh), gap_volumes(gaps, mesh, ring=ring)
