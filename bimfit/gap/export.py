"""Gap meshes as files: STL, PLY, OBJ, GLB and 3MF."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from bimfit import __version__
from bimfit.errors import ExportError
from bimfit.files import whole_file
from bimfit.gap.mesh import GapMesh
from bimfit.geometry.pose import Array


@dataclass(frozen=True)
class Exported:
    """A mesh file and how its coordinates lie in the world.

    Attributes
    ----------
    path : Path
    offset : tuple of 3 float
        World position of the file's origin, m; zero where the file holds world coordinates.
    T_world_file : ndarray, shape (4, 4)
        Maps the file's coordinates to world metres: offset, unit and axes together.
    unit : str
        Of the file's coordinates.
    """

    path: Path
    offset: tuple[float, float, float]
    T_world_file: Array
    unit: str


def export_mesh(mesh: GapMesh, path: str | Path) -> Exported:
    """Write a gap mesh in the format that the file's suffix names.

    ======  =========================================================================================
    .ply    binary, double precision, world coordinates in metres; the gap's width as a vertex property
    .obj    text with nine decimals, world coordinates in metres
    .stl    binary, single precision, metres, shifted by ``offset`` (in the header, too)
    .glb    glTF 2.0, single precision, metres, shifted by ``offset``; a node turns z-up into glTF's y-up;
            offset and matrix in the asset's extras
    .3mf    text in millimetres, shifted so that the part stands at the origin; offset in the metadata
    ======  =========================================================================================

    Parameters
    ----------
    mesh : GapMesh
    path : str or Path

    Returns
    -------
    Exported

    Raises
    ------
    ExportError
        For another suffix, an empty mesh, or a place that cannot be written. What was there before then
        stays.
    """
    target = Path(path)
    writer = _WRITERS.get(target.suffix.lower())
    if writer is None:
        known = ", ".join(sorted(_WRITERS))
        raise ExportError(
            f"no mesh format is called {target.suffix!r}", file=target, remedy=f"use one of {known}"
        )
    if mesh.empty:
        raise ExportError("the gap mesh has no faces: nothing of the gap is open or measured", file=target)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    with whole_file(target) as part:
        T, unit = writer(mesh, part, low, high)
    x, y, z = T[:3, 3].tolist()
    return Exported(target, (x, y, z), T, unit)


def _shift(offset: Array, scale: float = 1.0) -> Array:
    T = np.diag([scale, scale, scale, 1.0])
    T[:3, 3] = offset
    return T


def _centre(low: Array, high: Array) -> Array:
    """Middle of the mesh, on whole millimetres so that it reads and copies well."""
    return np.asarray(np.round(0.5 * (low + high), 3))


def _write_stl(mesh: GapMesh, path: Path, low: Array, high: Array) -> tuple[Array, str]:
    offset = _centre(low, high)
    t = (mesh.vertices - offset)[mesh.faces]
    normal = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    record = np.zeros(len(t), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    record["normal"] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    record["corners"] = t
    # A binary header must not begin with "solid", which readers take for the text form.
    header = f"bimfit m offset {_numbers(offset)}".encode("ascii")
    with path.open("wb") as stream:
        stream.write(header[:80].ljust(80))
        stream.write(struct.pack("<I", len(t)))
        stream.write(record.tobytes())
    return _shift(offset), "m"


def _write_ply(mesh: GapMesh, path: Path, _low: Array, _high: Array) -> tuple[Array, str]:
    vertex = np.zeros(len(mesh.vertices), [("p", "<f8", 3), ("width", "<f8")])
    vertex["p"], vertex["width"] = mesh.vertices, mesh.width
    face = np.zeros(len(mesh.faces), [("count", "u1"), ("index", "<i4", 3)])
    face["count"], face["index"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment bimfit {__version__} as-built gap, world coordinates, metres, offset 0 0 0",
        f"element vertex {len(vertex)}",
        *(f"property double {name}" for name in ("x", "y", "z", "width")),
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    with path.open("wb") as stream:
        stream.write(("\n".join(header) + "\n").encode("ascii"))
        stream.write(vertex.tobytes())
        stream.write(face.tobytes())
    return np.eye(4), "m"


def _write_obj(mesh: GapMesh, path: Path, _low: Array, _high: Array) -> tuple[Array, str]:
    lines = [
        f"# bimfit {__version__} as-built gap, world coordinates, metres",
        "# offset 0 0 0",
        "o gap",
        *("v {:.9f} {:.9f} {:.9f}".format(*row) for row in mesh.vertices.tolist()),
        *("f {} {} {}".format(*row) for row in (mesh.faces + 1).tolist()),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")
    return np.eye(4), "m"


def _write_glb(mesh: GapMesh, path: Path, low: Array, high: Array) -> tuple[Array, str]:
    import trimesh

    offset = _centre(low, high)
    # glTF is y-up: file (x, y, z) = world (x, z, -y). Vertices stay z-up; the node turns them.
    T_file_local = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])
    T_world_file = _shift(offset) @ T_file_local.T
    body = trimesh.Trimesh(mesh.vertices - offset, mesh.faces, process=False)
    scene = trimesh.Scene()
    scene.add_geometry(body, node_name="gap", geom_name="gap", transform=T_file_local)

    def describe(tree: dict[str, Any]) -> None:
        tree["asset"]["generator"] = f"bimfit {__version__}"
        tree["asset"]["extras"] = {
            "unit": "m",
            "offset": offset.tolist(),
            "T_world_file": T_world_file.ravel().tolist(),
        }

    path.write_bytes(trimesh.exchange.gltf.export_glb(scene, tree_postprocessor=describe))
    return T_world_file, "m"


def _write_3mf(mesh: GapMesh, path: Path, low: Array, _high: Array) -> tuple[Array, str]:
    offset = np.floor(low * 1e3) * 1e-3
    local = (mesh.vertices - offset) * 1e3
    vertices = "".join('<vertex x="{:.7f}" y="{:.7f}" z="{:.7f}"/>'.format(*row) for row in local.tolist())
    triangles = "".join('<triangle v1="{}" v2="{}" v3="{}"/>'.format(*row) for row in mesh.faces.tolist())
    about = json.dumps({"offset_m": offset.tolist(), "unit": "mm"})
    core = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
    model = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<model unit="millimeter" xml:lang="en-US" xmlns={quoteattr(core)}>'
        f'<metadata name="Title">bimfit as-built gap</metadata>'
        f'<metadata name="Application">bimfit {__version__}</metadata>'
        f'<metadata name="Description">{about}</metadata>'
        f'<resources><object id="1" type="model" name="gap"><mesh><vertices>{vertices}</vertices>'
        f"<triangles>{triangles}</triangles></mesh></object></resources>"
        '<build><item objectid="1"/></build></model>\n'
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in ((_TYPES_NAME, _TYPES), ("_rels/.rels", _RELS), ("3D/3dmodel.model", model)):
            # A fixed date: the same mesh gives the same bytes.
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, text)
    return _shift(offset, 1e-3), "mm"


def _numbers(values: Array) -> str:
    return " ".join(f"{x:.3f}" for x in values.tolist())


_TYPES_NAME = "[Content_Types].xml"
_TYPES = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>'
    "</Types>\n"
)
_RELS = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>\n'
)

_Writer = Callable[[GapMesh, Path, Array, Array], tuple[Array, str]]
_WRITERS: dict[str, _Writer] = {
    ".3mf": _write_3mf,
    ".glb": _write_glb,
    ".obj": _write_obj,
    ".ply": _write_ply,
    ".stl": _write_stl,
}

#: Suffixes that :func:`export_mesh` knows, without the dot.
FORMATS = tuple(suffix[1:] for suffix in _WRITERS)
