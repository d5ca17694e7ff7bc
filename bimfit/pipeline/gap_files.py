"""Gap meshes of a results folder, read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array
from bimfit.pipeline.document import JointDocument


def load_gap(joint: JointDocument, folder: Path) -> tuple[TriangleMesh, Array] | None:
    """A joint's gap mesh in world coordinates and the width at its vertices, m; None where there is none.

    Only the PLY file is read: it alone has world coordinates in double precision, and the widths.
    """
    import trimesh

    file = folder / joint.files.get("ply", "")
    if not joint.files.get("ply") or not file.is_file():
        return None
    mesh = trimesh.load_mesh(file, process=False)
    width = np.asarray(mesh.metadata["_ply_raw"]["vertex"]["data"]["width"], float).ravel()
    return TriangleMesh.of(mesh.vertices, mesh.faces), width
