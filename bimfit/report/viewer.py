"""What the report's 3D view of a gap is given: arrays in text, small, and about the gap's own middle."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array

MOST_FACES, MOST_EDGES = 40_000, 20_000
"""Larger gaps are shown by their pictures alone; of larger elements no edges are drawn."""
_SHARP = np.cos(np.radians(25.0))


def viewer_script() -> str:
    """The viewer's own code."""
    return Path(__file__).with_name("templates").joinpath("viewer.js").read_text(encoding="utf-8")


def viewer_model(gap: TriangleMesh, width: Array, elements: Sequence[TriangleMesh]) -> str:
    """A gap, coloured by its width, and the sharp edges of elements, as JSON for the viewer.

    Parameters
    ----------
    gap : TriangleMesh
    width : ndarray, shape (vertices of gap,)
        m.
    elements : sequence of TriangleMesh
        In the same world coordinates.

    Returns
    -------
    str
        Empty where the gap has no face or too many.
    """
    if not 0 < len(gap.faces) <= MOST_FACES:
        return ""
    from matplotlib import colormaps

    middle = gap.bounds.mean(axis=0)
    span = float(np.ptp(width)) or 1.0
    colours = np.round(255.0 * colormaps["viridis"]((width - width.min()) / span)[:, :3]).astype(np.uint8)
    edges = [sharp_edges(mesh) - middle for mesh in elements]
    edges = [part for part in edges if len(part) <= MOST_EDGES] or [np.zeros((0, 2, 3))]
    lines = np.concatenate(edges)
    vertices = gap.vertices - middle
    radius = float(np.linalg.norm(vertices, axis=1).max())
    reach = max(radius, float(np.linalg.norm(lines, axis=-1).max(initial=0.0)))
    arrays = {
        "vertices": vertices.astype("<f4"),
        "faces": gap.faces.astype("<u4"),
        "colours": colours,
        "lines": lines.astype("<f4"),
    }
    # the longest way of the gap lies across the picture, a little askew
    main = np.linalg.svd(vertices, full_matrices=False)[2][0]
    level = bool(np.hypot(*main[:2]) > 0.5)
    yaw = (-float(np.arctan2(main[1], main[0])) if level else 0.0) + 0.3
    numbers = {"radius": radius, "reach": reach, "yaw": yaw, "fit": 1.0 if level else 0.6}
    return json.dumps({**{name: _text(a) for name, a in arrays.items()}, **numbers})


def sharp_edges(mesh: TriangleMesh) -> Array:
    """Ends of the edges at which a mesh turns by more than 25 degrees or ends, shape (n, 2, 3)."""
    faces = mesh.faces
    t = mesh.vertices[faces]
    normal = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    unique, first, inverse, count = np.unique(
        ends, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    inverse = inverse.ravel()
    # the least cosine between an edge's first face and any other of its faces
    cosine = np.einsum("ij,ij->i", normal[owner], normal[owner[first[inverse]]])
    least = np.ones(len(unique))
    np.minimum.at(least, inverse, cosine)
    return np.asarray(mesh.vertices[unique[(least < _SHARP) | (count == 1)]])


def _text(array: Any) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
