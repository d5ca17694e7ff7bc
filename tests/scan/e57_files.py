"""E57 files written by libE57 itself, with what pye57's writer leaves out."""

from __future__ import annotations

import uuid

import numpy as np

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


def write_e57(path, scans, *, kind="double", by_name=False):
    """Write scans: dicts of ``points`` (n, 3), optional ``T`` (4, 4), ``spherical``, and further columns.

    kind is how coordinates are stored: double, single or scaled (to 0.1 mm).
    """
    from pye57 import libe57 as lib
    from scipy.spatial.transform import Rotation

    image = lib.ImageFile(str(path), "w")
    image.extensionsAdd("", lib.E57_V1_0_URI)
    root = image.root()
    root.set("formatName", lib.StringNode(image, "ASTM E57 3D Imaging Data File"))
    root.set("guid", lib.StringNode(image, str(uuid.UUID(int=1))))
    root.set("versionMajor", lib.IntegerNode(image, lib.E57_FORMAT_MAJOR))
    root.set("versionMinor", lib.IntegerNode(image, lib.E57_FORMAT_MINOR))
    data = lib.VectorNode(image, True)
    root.set("data3D", data)
    for scan in scans:
        node = lib.StructureNode(image)
        node.set("guid", lib.StringNode(image, str(uuid.UUID(int=2))))
        T = scan.get("T")
        if T is not None:
            x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
            turn, shift = lib.StructureNode(image), lib.StructureNode(image)
            # the standard names them; their order is nobody's business
            order = ("x", "y", "z", "w") if by_name else ("w", "x", "y", "z")
            for name in order:
                turn.set(name, lib.FloatNode(image, {"x": x, "y": y, "z": z, "w": w}[name]))
            for name in ("z", "y", "x") if by_name else ("x", "y", "z"):
                shift.set(name, lib.FloatNode(image, float(T["xyz".index(name), 3])))
            pose = lib.StructureNode(image)
            node.set("pose", pose)
            pose.set("rotation", turn)
            pose.set("translation", shift)
        columns = dict(zip(SPHERICAL if scan.get("spherical") else CARTESIAN, scan["points"].T, strict=True))
        columns |= {k: v for k, v in scan.items() if k not in ("points", "T", "spherical")}
        prototype = lib.StructureNode(image)
        buffers = lib.VectorSourceDestBuffer()
        keep = []
        for name, values in columns.items():
            if name in (*CARTESIAN, *SPHERICAL, "intensity"):
                array = np.ascontiguousarray(values, np.float64)
                if kind == "scaled" and name in CARTESIAN:
                    element = lib.ScaledIntegerNode(image, 0, -(2**31), 2**31 - 1, 1e-4, 0.0)
                else:
                    single = kind == "single"
                    precision = lib.FloatPrecision.E57_SINGLE if single else lib.FloatPrecision.E57_DOUBLE
                    element = lib.FloatNode(image, 0.0, precision)
            else:
                array = np.ascontiguousarray(values, np.longlong)
                element = lib.IntegerNode(image, 0, 0, max(int(array.max()), 1))
            prototype.set(name, element)
            keep.append(array)
            buffers.append(lib.SourceDestBuffer(image, name, array, len(array), True, True))
        points = lib.CompressedVectorNode(image, prototype, lib.VectorNode(image, True))
        node.set("points", points)
        data.append(node)
        writer = points.writer(buffers)
        writer.write(len(scan["points"]))
        writer.close()
    image.close()
