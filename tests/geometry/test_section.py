"""Sections against closed forms, manifold3d and trimesh; on closed, broken and real meshes."""

import math
from pathlib import Path

import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.profile import Profile, signed_area
from bimfit.geometry.section import clip_window, cut
from bimfit.geometry.visibility import visible_edges

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "ifc"
EAST = np.array([458657.0, 5438232.0, 112.0])
ACROSS = SectionFrame.from_axes((0, 0, 0), (1, 0, 0), (0, 0, 1))
seeds = st.integers(0, 2**31)


def mesh_of(solid):
    return TriangleMesh.of(solid.vertices, solid.faces)


def box(size=(0.2, 0.82, 0.025), centre=(0.0, 0.0, 0.0)):
    solid = trimesh.creation.box(size)
    solid.apply_translation(centre)
    return solid


def shape_of(profile):
    """Even-odd area of a profile's loops, by shapely."""
    out = shapely.Polygon()
    for loop in profile.loops:
        out = out.symmetric_difference(shapely.Polygon(loop))
    return out


def sliced_area(mesh, frame):
    """The same by manifold3d."""
    manifold3d = pytest.importorskip("manifold3d")
    local = np.ascontiguousarray(frame.to_section(mesh.vertices))
    solid = manifold3d.Manifold(manifold3d.Mesh64(local, np.ascontiguousarray(mesh.faces, np.uint64)))
    return solid.slice(0.0).area() if solid.status() == manifold3d.Error.NoError else math.nan


def random_frame(rng, origin):
    return SectionFrame.from_axes(origin, rng.normal(size=3), rng.normal(size=3))


def random_prism(rng):
    """A star-shaped prism, turned and moved."""
    count = int(rng.integers(3, 10))
    bearing = (np.arange(count) + rng.uniform(0, 0.45, count)) * 2 * math.pi / count
    loop = np.column_stack([np.cos(bearing), np.sin(bearing)]) * rng.uniform(0.1, 0.4, (count, 1))
    wall = np.column_stack([np.arange(count), np.roll(np.arange(count), -1)])
    vertices = np.vstack(
        [np.column_stack([loop, np.zeros(count)]), np.column_stack([loop, np.full(count, 0.5)]),
         [[0, 0, 0], [0, 0, 0.5]]]
    )  # fmt: skip
    i, j = wall.T
    faces = np.vstack(
        [
            np.column_stack([i, j, j + count]),
            np.column_stack([i, j + count, i + count]),
            np.column_stack([j, i, np.full(count, 2 * count)]),
            np.column_stack([i + count, j + count, np.full(count, 2 * count + 1)]),
        ]
    )
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn = q * np.sign(np.linalg.det(q))
    return TriangleMesh.of(vertices @ turn.T + rng.normal(size=3), faces)


def inside_point(mesh, rng):
    return mesh.vertices[-2] * 0.5 + mesh.vertices[-1] * 0.5 + rng.normal(scale=0.02, size=3)


def test_box_is_a_rectangle_of_four_corners():
    profile = cut(mesh_of(box()), ACROSS)
    assert len(profile.loops) == 1
    np.testing.assert_allclose(
        profile.loops[0], [[-0.1, -0.0125], [0.1, -0.0125], [0.1, 0.0125], [-0.1, 0.0125]], atol=1e-12
    )
    assert profile.guessed_length == 0.0
    assert profile.surface.all()


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_prisms_at_random_planes_agree_with_manifold(seed):
    rng = np.random.default_rng(seed)
    mesh = random_prism(rng)
    frame = random_frame(rng, inside_point(mesh, rng))
    profile = cut(mesh, frame)
    assert profile.area == pytest.approx(sliced_area(mesh, frame), abs=2e-6)
    assert profile.area > 1e-3
    assert profile.guessed_length == 0.0


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_area_is_the_same_in_doubled_jittered_mis_wound_triangles(seed):
    rng = np.random.default_rng(seed)
    mesh = random_prism(rng)
    frame = random_frame(rng, inside_point(mesh, rng))
    soup = mesh.triangles.reshape(-1, 3) + rng.uniform(-2e-7, 2e-7, (3 * len(mesh.faces), 3))
    faces = np.arange(len(soup)).reshape(-1, 3)
    flipped = rng.random(len(faces)) < 0.3
    faces[flipped] = faces[flipped, ::-1]
    broken = cut(TriangleMesh.of(soup, faces), frame)
    assert broken.area == pytest.approx(cut(mesh, frame).area, abs=2e-6)
    assert broken.guessed_length == 0.0


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_one_missing_triangle_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    mesh = random_prism(rng)
    frame = random_frame(rng, inside_point(mesh, rng))
    lacking = TriangleMesh(mesh.vertices, np.delete(mesh.faces, rng.integers(len(mesh.faces)), axis=0))
    whole, healed = cut(mesh, frame), cut(lacking, frame)
    # a section of a star can have several loops, but one missing triangle always leaves one way to close
    assert healed.area == pytest.approx(whole.area, abs=1e-6)


def test_planes_through_vertices_edges_and_faces():
    solid = box((0.2, 0.8, 0.1))
    for y in (-0.4, 0.4, -0.4 + 3e-7, 0.4 - 3e-7, 0.4 + 3e-7):  # in the end faces, and rounding beside
        frame = SectionFrame.from_axes((0, y, 0), (1, 0, 0), (0, 0, 1))
        assert cut(mesh_of(solid), frame).area == pytest.approx(0.02, abs=1e-9), y
    assert cut(mesh_of(solid), SectionFrame.from_axes((0, 0.4001, 0), (1, 0, 0), (0, 0, 1))).empty
    # the plane through four edges' diagonal corners
    frame = SectionFrame.from_axes((0, 0, 0), (0.2, 0.8, 0), (0, 0, 1))
    assert cut(mesh_of(solid), frame).area == pytest.approx(0.1 * math.hypot(0.2, 0.8), abs=1e-9)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    rng = np.random.default_rng(5)
    for _ in range(40):  # through three vertices each
        a, b, c = ball.vertices[rng.choice(len(ball.vertices), 3, replace=False)]
        frame = SectionFrame.from_axes(a, b - a, c - a)
        area = cut(mesh_of(ball), frame).area
        radius2 = 0.09 - float(a @ frame.n) ** 2
        if radius2 > 0.02:
            assert area == pytest.approx(math.pi * radius2, rel=0.12)


def test_step_in_the_plane_gives_one_of_its_sides():
    step = trimesh.util.concatenate([box((0.2, 0.4, 0.1), (0, -0.2, 0)), box((0.4, 0.4, 0.1), (0, 0.2, 0))])
    area = cut(mesh_of(step), ACROSS).area
    assert min(abs(area - 0.02), abs(area - 0.04)) < 1e-9


def test_hole_and_hollow_are_kept():
    tube = trimesh.creation.annulus(0.1, 0.2, 1.0)
    frame = SectionFrame.from_axes((0, 0, 0.1), (1, 0, 0), (0, 1, 0))
    profile = cut(mesh_of(tube), frame)
    assert [signed_area(loop) > 0 for loop in profile.loops] == [True, False]
    assert profile.area == pytest.approx(sliced_area(mesh_of(tube), frame), abs=1e-9)
    upright = cut(mesh_of(tube), SectionFrame.from_axes((0, 0, 0), (1, 0, 0), (0, 0, 1)))
    assert [signed_area(loop) > 0 for loop in upright.loops] == [True, True]


def test_overlapping_bodies_are_one():
    solid = trimesh.util.concatenate([box(), box(centre=(0.1, 0, 0.01))])
    union = 2 * 0.2 * 0.025 - 0.1 * 0.015
    assert cut(mesh_of(solid), ACROSS).area == pytest.approx(union, abs=1e-9)
    faces = solid.faces.copy()
    faces[::5] = faces[::5, ::-1]
    profile = cut(TriangleMesh.of(solid.vertices, faces), ACROSS)
    assert profile.area == pytest.approx(union, abs=1e-9)
    assert len(profile.loops) == 1


def test_bar_inside_a_body_is_no_hole():
    solid = trimesh.util.concatenate([box((0.2, 0.8, 0.2)), box((0.02, 0.9, 0.02))])
    assert cut(mesh_of(solid), ACROSS).area == pytest.approx(0.04, abs=1e-9)


def test_touching_and_doubled_bodies():
    solid = trimesh.util.concatenate([box(), box(centre=(0.2, 0, 0))])
    profile = cut(mesh_of(solid), ACROSS)
    assert profile.area == pytest.approx(2 * 0.2 * 0.025, abs=1e-9)
    solid = trimesh.util.concatenate([box(), box()])
    assert cut(mesh_of(solid), ACROSS).area == pytest.approx(0.2 * 0.025, abs=1e-9)


def test_inside_out_mesh_is_turned():
    solid = box()
    profile = cut(TriangleMesh.of(solid.vertices, solid.faces[:, ::-1]), ACROSS)
    assert profile.area == pytest.approx(0.005, abs=1e-12)


def test_missing_face_is_closed_counted_and_marked():
    solid = box((0.2, 0.8, 0.1))
    right = np.isclose(solid.face_normals[:, 0], 1.0)
    profile = cut(TriangleMesh.of(solid.vertices, solid.faces[~right]), ACROSS)
    assert profile.area == pytest.approx(0.02, abs=1e-9)
    assert profile.guessed_length == pytest.approx(0.1, abs=1e-9)
    guessed = profile.edges[~profile.surface]
    assert len(guessed) == 1
    np.testing.assert_allclose(guessed[0, :, 0], 0.1, atol=1e-9)
    assert not len(visible_edges([profile], (3.0, 0.0))[0])


def test_missing_triangle_of_a_flat_face_stays_surface():
    solid = box((0.2, 0.8, 0.1))
    top = np.flatnonzero(np.isclose(solid.face_normals[:, 2], 1.0))
    profile = cut(TriangleMesh.of(solid.vertices, np.delete(solid.faces, top[0], axis=0)), ACROSS)
    assert 0.0 < profile.guessed_length < 0.2
    assert profile.surface.all()


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_map_coordinates_cost_nothing(seed):
    rng = np.random.default_rng(seed)
    mesh = random_prism(rng)
    frame = random_frame(rng, inside_point(mesh, rng))
    far = TriangleMesh(mesh.vertices + EAST, mesh.faces)
    there = cut(far, SectionFrame(frame.origin + EAST, frame.u, frame.v, frame.n))
    here = cut(mesh, frame)
    # the coordinates themselves are only good to a nanometre there
    assert shape_of(there).hausdorff_distance(shape_of(here)) < 1e-5
    assert there.area == pytest.approx(here.area, abs=1e-6)


def test_far_away_and_unusable_meshes_are_empty():
    assert cut(mesh_of(box(centre=(0, 5, 0))), ACROSS).empty
    assert cut(TriangleMesh.of(np.zeros((0, 3)), np.zeros((0, 3), int)), ACROSS).empty
    nan = TriangleMesh.of(np.full((3, 3), np.nan), [[0, 1, 2]])
    assert cut(nan, ACROSS).empty
    flat = TriangleMesh.of([[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 1, 2]])  # lies in the plane
    assert cut(flat, ACROSS).empty


def test_one_bad_vertex_spoils_only_its_triangles():
    solid = box()
    vertices = np.vstack([solid.vertices, [[np.nan] * 3]])
    faces = np.vstack([solid.faces, [[0, 1, 8]]])
    assert cut(TriangleMesh.of(vertices, faces), ACROSS).area == pytest.approx(0.005, abs=1e-12)


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_window_keeps_what_is_in_it(seed):
    rng = np.random.default_rng(seed)
    mesh = random_prism(rng)
    frame = random_frame(rng, inside_point(mesh, rng))
    whole = cut(mesh, frame)
    reach = rng.uniform(0.02, 0.3)
    clipped = cut(mesh, frame, reach)
    wanted = shape_of(whole).intersection(shapely.box(-reach, -reach, reach, reach))
    assert clipped.area == pytest.approx(wanted.area, abs=1e-6)
    # what is left of the surface is old surface, and all else lies on the window's border
    border = shapely.box(-reach, -reach, reach, reach).exterior
    outline = shape_of(whole).boundary
    for edge, real in zip(clipped.edges, clipped.surface, strict=True):
        distance = (outline if real else border).distance(shapely.Point(edge.mean(axis=0)))
        assert distance < 2e-6


def test_cut_edges_are_never_seen():
    whole = cut(mesh_of(box((6.0, 0.8, 0.1), (2.9, 0, 0))), ACROSS)
    clipped = clip_window(whole, (-0.3, -0.3), (0.3, 0.3))
    for eye in [(0, 0.5), (2.0, 0.2), (0.5, -0.02), (1.0, -1.0), (-1.0, 0.1)]:
        inside = [p for p in visible_edges([whole], eye)[0] if p[:, 0].min() < 0.3 - 1e-9]
        seen = visible_edges([clipped], eye)[0]
        length = np.linalg.norm(seen[:, 1] - seen[:, 0], axis=1).sum()
        clipped_inside = [np.column_stack([np.minimum(p[:, 0], 0.3), p[:, 1]]) for p in inside]
        wanted = sum(np.linalg.norm(p[1] - p[0]) for p in clipped_inside)
        assert length == pytest.approx(wanted, abs=1e-9), eye
        assert not np.any(np.isclose(seen[:, :, 0], 0.3).all(axis=1))


def test_window_splits_and_keeps_islands():
    island = Profile((*Profile.polygon([(-1, -1), (1, -1), (1, 1), (-1, 1)],
                                       holes=[[(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]]).loops,
                      np.array([(-0.2, -0.2), (0.2, -0.2), (0.2, 0.2), (-0.2, 0.2)])))  # fmt: skip
    clipped = clip_window(island, (-0.6, -0.6), (0.6, 0.6))
    assert clipped.area == pytest.approx(1.44 - 1.0 + 0.16)
    assert len(clipped.loops) == 3
    assert clip_window(island, (3, 3), (4, 4)).empty
    assert clip_window(island, (-2, -2), (2, 2)) is island
    arch = Profile.polygon([(-1, 0), (1, 0), (1, 1), (0.5, 1), (0.5, 0.5), (-0.5, 0.5), (-0.5, 1), (-1, 1)])
    assert len(clip_window(arch, (-2, 0.7), (2, 2)).loops) == 2


@pytest.mark.parametrize("name", ["XELLA-3e_verdieping.ifc", "MULTICOM-banden.ifc", "ROOT-kalkzandsteen.ifc"])
def test_real_elements_agree_with_manifold(name):
    path = REAL / name
    if not path.exists():
        pytest.skip("the shared models are not there")
    ifcopenshell = pytest.importorskip("ifcopenshell")
    geom = pytest.importorskip("ifcopenshell.geom")
    settings_ = geom.settings()
    settings_.set("use-world-coords", True)
    model = ifcopenshell.open(path)
    chosen = [e for e in model.by_type("IfcBuildingElement") if e.Representation][::4]
    iterator = geom.iterator(settings_, model, 1, include=chosen)
    assert iterator.initialize()
    rng = np.random.default_rng(3)
    compared = 0
    while True:
        geometry = iterator.get().geometry
        raw = trimesh.Trimesh(
            np.array(geometry.verts).reshape(-1, 3), np.array(geometry.faces).reshape(-1, 3), process=False
        )
        merged = raw.copy()
        merged.merge_vertices(digits_vertex=6)
        middle = raw.vertices.mean(axis=0)
        for _ in range(2):
            frame = random_frame(rng, 0.3 * raw.vertices[rng.integers(len(raw.vertices))] + 0.7 * middle)
            wanted = sliced_area(mesh_of(merged), frame)
            if math.isfinite(wanted):
                compared += 1
                assert cut(mesh_of(raw), frame).area == pytest.approx(wanted, rel=1e-4, abs=1e-6)
        if not iterator.next():
            break
    assert compared > 40
