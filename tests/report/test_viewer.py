"""What the report's 3D view is given, decoded as a browser would."""

from __future__ import annotations

import base64
import json

import numpy as np
import pytest
import trimesh

from bimfit.geometry.mesh import TriangleMesh
from bimfit.report.viewer import MOST_FACES, sharp_edges, viewer_model, viewer_script

FAR = np.array([458657.0, 5438232.0, 112.0])


def mesh_of(solid, shift=(0.0, 0.0, 0.0)):
    return TriangleMesh.of(solid.vertices + shift, solid.faces)


def decoded(text, name, kind):
    return np.frombuffer(base64.b64decode(json.loads(text)[name]), kind)


def test_a_box_has_twelve_edges_and_a_ball_none():
    lines = sharp_edges(mesh_of(trimesh.creation.box((1.0, 2.0, 3.0))))
    assert lines.shape == (12, 2, 3)
    lengths = np.sort(np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1))
    np.testing.assert_allclose(lengths, np.repeat([1.0, 2.0, 3.0], 4))
    assert len(sharp_edges(mesh_of(trimesh.creation.icosphere(3)))) == 0


def test_an_open_mesh_shows_where_it_ends():
    square = TriangleMesh.of([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    assert len(sharp_edges(square)) == 4


def test_single_precision_holds_it_at_map_coordinates():
    solid = trimesh.creation.box((2.0, 0.02, 0.1))
    gap = mesh_of(solid, FAR)
    width = 0.02 + 0.001 * np.arange(8)
    text = viewer_model(gap, width, [mesh_of(trimesh.creation.box((2.0, 0.5, 0.1)), FAR)])
    vertices = decoded(text, "vertices", "<f4").reshape(-1, 3)
    np.testing.assert_allclose(vertices, gap.vertices - gap.bounds.mean(axis=0), atol=1e-6)
    np.testing.assert_array_equal(decoded(text, "faces", "<u4").reshape(-1, 3), gap.faces)
    assert decoded(text, "lines", "<f4").size == 12 * 2 * 3
    colours = decoded(text, "colours", "u1").reshape(-1, 3)
    assert tuple(colours[0]) == (68, 1, 84) and tuple(colours[-1]) == (253, 231, 37)  # viridis' ends
    value = json.loads(text)
    assert value["radius"] == pytest.approx(np.linalg.norm([1.0, 0.01, 0.05]))
    assert value["reach"] == pytest.approx(np.linalg.norm([1.0, 0.25, 0.05]))


def test_what_is_empty_or_too_large_is_left_to_the_pictures():
    nothing = TriangleMesh.of(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    assert viewer_model(nothing, np.zeros(0), []) == ""
    many = np.tile([[0, 1, 2]], (MOST_FACES + 1, 1))
    assert viewer_model(TriangleMesh.of(np.eye(3), many), np.zeros(3), []) == ""


def test_the_script_asks_for_nothing():
    script = viewer_script()
    for word in ("http", "fetch", "import ", "XMLHttpRequest", "</script"):
        assert word not in script
