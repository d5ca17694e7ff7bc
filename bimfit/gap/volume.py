"""The gap's volume: the paper's sum of slices, and the lofted mesh's."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bimfit.gap.mesh import GapMesh, loft
from bimfit.gap.runs import Runs, find_runs
from bimfit.gap.section import GapSection
from bimfit.geometry.pose import Array


@dataclass(frozen=True)
class Volumes:
    """How much fits into a gap.

    Attributes
    ----------
    slices : float
        The paper's: the sum of ``increments``, m^3.
    mesh : float
        The lofted mesh's, m^3.
    sigma : float or None
        Standard deviation of ``slices``, m^3; None where a section has none.
    increments : ndarray, shape (n,)
        The paper's differential volume of each station given, m^3; NaN where it has no estimate.
    length : float
        How much of the joint the volumes cover, m.
    """

    slices: float
    mesh: float
    sigma: float | None
    increments: Array
    length: float


def gap_volumes(
    sections: Sequence[GapSection | None],
    mesh: GapMesh | None = None,
    *,
    correlation: float | ArrayLike = 0.0,
    ring: float | None = None,
    max_bridge: float | None = None,
) -> Volumes | None:
    """Add up a gap's volume.

    The paper extends each area half the distance to each neighbouring station (its section 5). A station at
    an end has one neighbour and counts with that half alone, so that the sum covers just the measured
    length and agrees with the mesh; the same holds beside a stretch that is left out.

    Parameters
    ----------
    sections : sequence of GapSection or None
        In order along the joint; None where a station has no estimate.
    mesh : GapMesh, optional
        Of the same sections; lofted here unless given.
    correlation : float or array_like, shape (n, n)
        Of the areas' errors along the joint: either that of neighbouring stations, which then falls off as
        a power of their difference in number (0: independent, 1: all alike), or the matrix for all sections
        given.
    ring, max_bridge
        As for :func:`bimfit.gap.mesh.loft`.

    Returns
    -------
    Volumes or None
        None where no two neighbouring stations were measured: nothing is known then, not zero.
    """
    runs = find_runs(sections, ring=ring, max_bridge=max_bridge)
    share = _shares(sections, runs, ring)
    if not share.any():
        return None
    known = np.array([section is not None for section in sections])
    area = np.array([np.nan if section is None else section.area for section in sections])
    increments = np.where(known, area * share, np.nan)
    lofted = loft(sections, ring=ring, max_bridge=max_bridge) if mesh is None else mesh
    return Volumes(
        float(np.nansum(increments)),
        lofted.volume,
        _sigma(sections, share, correlation),
        increments,
        float(share.sum()),
    )


def _shares(sections: Sequence[GapSection | None], runs: Runs, ring: float | None) -> Array:
    """The length that each station stands for, m."""
    place = {id(section): k for k, section in enumerate(sections) if section is not None}
    share = np.zeros(len(sections))
    for run in runs.sections:
        pairs = list(itertools.pairwise(run))
        if runs.ring:
            pairs.append((run[-1], run[0]))
        for a, b in pairs:
            step = b.s - a.s
            if step <= 0.0 and ring is not None:
                step += ring
            share[place[id(a)]] += 0.5 * step
            share[place[id(b)]] += 0.5 * step
    return share


def _sigma(
    sections: Sequence[GapSection | None], share: Array, correlation: float | ArrayLike
) -> float | None:
    used = np.flatnonzero(share)
    sd: list[float] = []
    for k in used.tolist():
        section = sections[k]
        if section is None or section.sigma is None:
            return None
        sd.append(section.sigma.area * float(share[k]))
    if np.ndim(correlation) == 0:
        rho = float(np.asarray(correlation))
        if not 0.0 <= rho <= 1.0:
            raise ValueError(f"the correlation of neighbouring stations lies in [0, 1], got {rho}")
        matrix = rho ** np.abs(used[:, None] - used[None, :]).astype(float)
    else:
        matrix = np.asarray(correlation, float)[np.ix_(used, used)]
    x = np.array(sd)
    return float(np.sqrt(max(x @ matrix @ x, 0.0)))
