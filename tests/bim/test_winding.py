"""Meshes made fit for use, whichever way round their triangles come."""

import manifold3d
import numpy as np
import pytest
from solids import of

from bimfit.bim.winding import welded, wound_outwards
from bimfit.geometry.mesh import TriangleMesh

CUBE, BALL = manifold3d.Manifold.cube((2.0, 1.0, 0.1)), manifold3d.Manifold.sphere(0.5, 24)
SHAPES = {
    "plate": CUBE,
    "ball": BALL,
    "two apart": CUBE + BALL.translate((5, 0, 0)),
    "with a hole": CUBE - manifold3d.Manifold.cylinder(1, 0.2, 0.2, 16).translate((1, 0.5, -0.2)),
}


def volume(vertices, faces):
    return TriangleMesh.of(vertices, faces).volume


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 1.0])
@pytest.mark.parametrize("name", SHAPES)
def test_closed_surfaces_enclose_their_volume(name, share):
    mesh = of(SHAPES[name])
    turned = np.random.default_rng(5).random(len(mesh.faces)) < share
    faces = np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces)
    out = wound_outwards(mesh.vertices - mesh.vertices.mean(axis=0), faces)
    assert volume(mesh.vertices, out) == pytest.approx(SHAPES[name].volume())
    assert {frozenset(face) for face in out.tolist()} == {frozenset(face) for face in mesh.faces.tolist()}


@pytest.mark.parametrize("turned", [slice(0, 0), slice(None), slice(0, None, 3)])
def test_open_surfaces_look_outwards(turned):
    mesh = of(CUBE)
    faces = mesh.faces.copy()
    faces[turned] = faces[turned, ::-1]
    middle = mesh.vertices.mean(axis=0)
    for lost in range(0, 12, 2):  # two triangles of a box that belong together or not
        kept = np.delete(np.arange(12), [lost, lost + 1])
        out = TriangleMesh.of(mesh.vertices, wound_outwards(mesh.vertices - middle, faces[kept]))
        away = out.triangles.mean(axis=1) - middle
        assert np.all(np.einsum("ij,ij->i", out.face_vectors, away) > 0.0)


def test_a_void_stays_a_void_and_solids_that_touch_are_told_apart():
    hollow = CUBE.scale((2, 2, 20)) - BALL.scale((0.5, 0.5, 0.5)).translate((2, 1, 1))
    mesh = of(hollow)
    out = wound_outwards(mesh.vertices - mesh.vertices.mean(axis=0), mesh.faces)
    assert volume(mesh.vertices, out) == pytest.approx(hollow.volume())
    # two boxes that share an edge, one of them inside out
    one, two = of(CUBE), of(CUBE.translate((2.0, 1.0, 0.0)))
    vertices = np.concatenate([one.vertices, two.vertices])
    kept, faces = welded(vertices, np.concatenate([one.faces, two.faces[:, ::-1] + len(one.vertices)]))
    assert len(kept) == 14
    vertices = vertices[kept]
    assert volume(vertices, wound_outwards(vertices - vertices.mean(axis=0), faces)) == pytest.approx(0.4)


def test_what_has_no_inside_stays_as_it_is():
    # a sheet, and a band with a twist
    sheet = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    np.testing.assert_array_equal(wound_outwards(sheet - sheet.mean(axis=0), faces), faces)
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rail = [
        np.stack(
            [
                (1 + s * 0.3 * np.cos(angle / 2)) * np.cos(angle),
                (1 + s * 0.3 * np.cos(angle / 2)) * np.sin(angle),
                s * 0.3 * np.sin(angle / 2),
            ],
            axis=1,
        )
        for s in (-1, 1)
    ]
    band = np.concatenate(rail)
    quads = [(k, k + 1, k + 13, k + 12) for k in range(11)] + [(11, 12, 0, 23)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    out = wound_outwards(band, faces)
    assert sorted(map(sorted, out.tolist())) == sorted(map(sorted, faces.tolist()))


def test_welding_drops_what_collapses():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 4e-7], [0, 0, 2e-3]])
    kept, faces = welded(vertices, np.array([[0, 1, 2], [1, 2, 3], [0, 1, 3], [0, 1, 4]]))
    assert len(kept) == 4
    assert len(faces) == 3
