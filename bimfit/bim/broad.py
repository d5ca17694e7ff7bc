"""Second stage of the joint finder: pairs of faces that may meet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bimfit.bim.faces import Faces, Index, dot
from bimfit.geometry.pose import Array

_MARGIN = 2e-3


def face_pairs(
    faces: Faces,
    *,
    max_gap: float,
    max_overlap: float,
    min_cosine: float,
    max_cosine: float,
    chosen: NDArray[np.bool_],
) -> tuple[Index, Index]:
    """Pairs of faces of different elements that turn towards each other and lie near.

    Parameters
    ----------
    faces : Faces
    max_gap, max_overlap : float
        How far a face looks out along its normal, and back into its element, m.
    min_cosine, max_cosine : float
        Bounds of ``-n_a . n_b``: 1 for faces that are parallel and face each other.
    chosen : ndarray of bool, shape (faces,)
        Which faces take part.

    Returns
    -------
    a, b : ndarray, shape (k,)
        Faces; the element of a has the lower number. Sorted.
    """
    some = np.flatnonzero(chosen)
    low, high = faces.low[some], faces.high[some]
    reach = faces.normal[some] * max_gap
    back = -faces.normal[some] * max_overlap
    wide_low = np.minimum(np.minimum(low, low + reach), low + back) - _MARGIN
    wide_high = np.maximum(np.maximum(high, high + reach), high + back) + _MARGIN
    i, j = box_pairs(wide_low, wide_high, low, high)
    a, b = some[i], some[j]
    near = faces.element[a] < faces.element[b]
    a, b = a[near], b[near]
    cosine = -dot(faces.normal[a], faces.normal[b])
    good = (cosine >= min_cosine) & (cosine <= max_cosine)
    a, b = a[good], b[good]
    order = np.lexsort((b, a))
    return a[order], b[order]


def box_pairs(low_a: Array, high_a: Array, low_b: Array, high_b: Array) -> tuple[Index, Index]:
    """Which boxes of a set A overlap which of a set B: index pairs."""
    import shapely

    if not len(low_a) or not len(low_b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    # the tree is planar: give it the two axes along which the boxes are spread most, in terms of their sizes
    spread = (high_b.max(axis=0) - low_b.min(axis=0)) / np.maximum(np.mean(high_b - low_b, axis=0), 1e-3)
    x, y, z = np.argsort(-spread)
    tree = shapely.STRtree(shapely.box(low_b[:, x], low_b[:, y], high_b[:, x], high_b[:, y]))
    i, j = tree.query(shapely.box(low_a[:, x], low_a[:, y], high_a[:, x], high_a[:, y]))
    near = (low_a[i, z] <= high_b[j, z]) & (low_b[j, z] <= high_a[i, z])
    return np.asarray(i[near], np.int64), np.asarray(j[near], np.int64)
