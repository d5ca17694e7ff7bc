"""Gap meshes of a results folder, read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bimfit.errors import ConfigError
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array
from bimfit.pipeline.document import JointDocument


def load_gap(joint: JointDocument, folder: Path) -> tuple[TriangleMesh, Array] | None:
    """A joint's gap mesh in world coordinates and the width at its vertices, m; None where there is none.

    Only the PLY file is read: it alone has world coordinates in double precision, and the widths.

    Raises
    ------
    ConfigError
        When the file is damaged.
    """
    import trimesh

    name = joint.files.get("ply", "")
    file = folder / name
    if not name or Path(name).name != name or not file.is_file():
        return None
    try:
        mesh = trimesh.load_mesh(file, process=False)
        width = np.asarray(mesh.metadata["_ply_raw"]["vertex"]["data"]["width"], float).ravel()
        surface = TriangleMesh.of(mesh.vertices, mesh.faces)
    except Exception as error:  # trimesh's and NumPy's errors share no base
        reason = f"is not a gap mesh that can be read: {error or type(error).__name__}"
        raise ConfigError(reason, file=file, remedy="fit the joints again") from error
    if len(width) != len(surface.vertices):
        raise ConfigError("has another number of widths than of vertices", file=file)
    return surface, width
