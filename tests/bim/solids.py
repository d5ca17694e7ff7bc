"""Meshes of prisms and models of them, for the finder's tests."""

import manifold3d
import numpy as np

from bimfit.bim.model import element_from_mesh, model_from_elements
from bimfit.geometry.mesh import TriangleMesh


def box(low, high):
    solid = manifold3d.Manifold.cube(np.subtract(high, low)).translate(low)
    return of(solid)


def of(solid):
    mesh = solid.to_mesh64()
    return TriangleMesh.of(np.asarray(mesh.vert_properties)[:, :3], mesh.tri_verts)


def prism(corners, length, start=0.0):
    """A section in x-z, drawn out along y."""
    section = manifold3d.CrossSection([np.asarray(corners, float)], manifold3d.FillRule.NonZero)
    if section.area() == 0.0:
        section = manifold3d.CrossSection([np.asarray(corners, float)[::-1]], manifold3d.FillRule.NonZero)
    mesh = of(manifold3d.Manifold.extrude(section, length))
    x, z, y = mesh.vertices.T
    # (x, z, y) to (x, y, z) is a mirror, so the faces turn round
    return TriangleMesh.of(np.stack([x, y + start, z], axis=1), mesh.faces[:, ::-1])


def model(*meshes, classes=None):
    import dataclasses

    elements = [element_from_mesh(mesh, f"part {k}", f"GUID{k}") for k, mesh in enumerate(meshes)]
    if classes:
        elements = [dataclasses.replace(e, ifc_class=c) for e, c in zip(elements, classes, strict=True)]
    return model_from_elements(elements)
