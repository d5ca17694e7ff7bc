"""Lofted gaps against closed forms, trimesh, Open3D and manifold3d, and files against what was written."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from bimfit.errors import ExportError
from bimfit.gap import sheets
from bimfit.gap.export import FORMATS, export_mesh
from bimfit.gap.ladder import ladder
from bimfit.gap.mesh import loft
from bimfit.gap.runs import find_runs
from bimfit.gap.volume import gap_volumes
from bimfit.geometry.frame import SectionFrame

_spec = importlib.util.spec_from_file_location("gap_shapes", Path(__file__).with_name("shapes.py"))
shapes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(shapes)
section, row = shapes.section, shapes.row


def body(mesh):
    return trimesh.Trimesh(mesh.vertices - mesh.vertices.mean(axis=0), mesh.faces, process=False)


def check_closed(mesh):
    """Watertight, oriented and outward by trimesh; an edge has two faces and a vertex one fan by Open3D."""
    import open3d

    solid = body(mesh)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume == pytest.approx(mesh.volume, rel=1e-9)
    parts = solid.split(only_watertight=False)
    assert len(parts) == mesh.bodies
    assert all(part.volume > 0.0 for part in parts)
    other = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(solid.vertices), open3d.utility.Vector3iVector(solid.faces)
    )
    assert other.is_edge_manifold(allow_boundary_edges=False)
    assert other.is_vertex_manifold()
    return other


@pytest.mark.parametrize("name", shapes.SHAPES)
def test_a_uniform_joint_is_a_prism(name):
    sections = row(np.zeros((12, 6)), shapes.SHAPES[name], origin=shapes.MAP)
    mesh = loft(sections)
    assert not check_closed(mesh).is_self_intersecting()
    assert mesh.bodies == 1
    v = gap_volumes(sections, mesh)
    expected = sections[0].area * 0.11
    assert v.slices == pytest.approx(expected, rel=1e-12)
    # Map coordinates leave 1 nm of each vertex.
    assert v.mesh == pytest.approx(expected, rel=3e-7)
    assert v.length == pytest.approx(0.11)
    # Every vertex of both sides is a vertex of the mesh.
    for s in (sections[0], sections[-1]):
        corners = s.frame.to_world(np.concatenate([s.side_a, s.side_b]))
        assert np.abs(corners[:, None] - mesh.vertices[None]).max(axis=2).min(axis=1).max() < 1e-8


@pytest.mark.parametrize("ring", [False, True])
def test_open_rows_close_the_same_way_at_once_and_step_by_step(ring):
    rng = np.random.default_rng(4)
    sections = row(rng.normal(size=(7, 6)) * np.tile([5e-4, 5e-4, 5e-3], 2), shapes.STEPPED)
    rows = ladder(sections)
    if ring:
        rows = [dataclasses.replace(r, plane=None) for r in rows]
    fast, slow = sheets.close_rows(rows, ring=ring), sheets._Sheets(rows, ring=ring).build()

    def triangles(mesh):
        corners = mesh[0][mesh[1]]
        first = np.argmin(corners @ [1.0, 3.0, 7.0], axis=1)
        turned = corners[np.arange(len(corners))[:, None], (first[:, None] + np.arange(3)) % 3]
        return np.unique(np.round(turned.reshape(-1, 9), 12), axis=0)

    assert np.array_equal(triangles(fast), triangles(slow))
    assert sorted(fast[2]) == pytest.approx(sorted(slow[2]))


def test_a_widening_gap_is_a_prismatoid():
    poses = np.zeros((2, 6))
    poses[1, 3] = 0.010
    sections = row(poses, shapes.V_GROOVE, spacing=0.1)
    areas = [s.area for s in sections]
    # Linear in s: Simpson's rule with the middle section is exact.
    middle = section(shapes.V_GROOVE, b=(0.005, 0, 0)).area
    assert loft(sections).volume == pytest.approx(0.1 * (areas[0] + 4 * middle + areas[1]) / 6, rel=1e-9)


def test_a_gap_that_closes_ends_in_a_wedge():
    poses = np.zeros((4, 6))
    poses[:, 3] = [0.0, -0.015, -0.035, -0.045]
    mesh = loft(row(poses, spacing=0.1))
    assert not check_closed(mesh).is_self_intersecting()
    # 25 to 10 mm over 100 mm, then 10 mm to nothing at the middle of the next 100 mm.
    assert mesh.volume == pytest.approx(0.025 * (0.0175 * 0.1 + 0.5 * 0.010 * 0.05), rel=1e-9)
    assert mesh.vertices[:, 1].max() == pytest.approx(0.15, abs=1e-9)
    assert mesh.width.min() == 0.0


def test_a_gap_that_is_closed_midway_is_two_bodies():
    poses = np.zeros((5, 6))
    poses[2, 3] = -0.050
    mesh = loft(row(poses, spacing=0.1, origin=shapes.MAP))
    check_closed(mesh)
    assert mesh.bodies == 2
    assert mesh.volume == pytest.approx(2 * 0.025 * 0.025 * (0.1 + 0.5 * 0.05), rel=1e-6)


def test_a_gap_closed_at_its_root_is_half_a_bow_tie():
    lean = shapes.outline([(0, 0), (0, -0.025)], [(0.004, 0), (-0.004, -0.025)])
    sections = row(np.zeros((6, 6)), lean)
    mesh = loft(sections)
    assert not check_closed(mesh).is_self_intersecting()
    assert mesh.volume == pytest.approx(0.5 * 0.0125 * 0.004 * 0.05, rel=1e-9)
    assert gap_volumes(sections, mesh).slices == pytest.approx(mesh.volume, rel=1e-9)


def test_a_joint_that_touches_everywhere_has_no_body_and_no_volume():
    touching = shapes.outline([(0, 0), (0, -0.025)], [(0, 0), (0, -0.025)])
    sections = row(np.zeros((5, 6)), touching)
    mesh = loft(sections)
    assert mesh.empty
    assert mesh.volume == 0.0
    v = gap_volumes(sections, mesh)
    assert (v.slices, v.mesh) == (0.0, 0.0)


pose = st.tuples(*(st.floats(-x, x) for x in (0.015, 0.003, 0.1) * 2))


@given(poses=st.lists(pose, min_size=2, max_size=7), name=st.sampled_from([*shapes.SHAPES, "fillet"]))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_whatever_the_poses_the_mesh_is_closed(poses, name):
    shape = shapes.FILLET if name == "fillet" else shapes.SHAPES[name]
    sections = row(poses, shape, origin=shapes.MAP)
    mesh = loft(sections)
    if mesh.empty:
        assert all(s.area < 0.25 * section(shape).area for s in sections)
        return
    check_closed(mesh)
    assert (mesh.width >= 0.0).all()


def test_noisy_touching_joints_do_not_intersect_themselves():
    rng = np.random.default_rng(8)
    for scale in (0.003, 0.012):
        poses = rng.normal(size=(60, 6)) * np.tile([scale, scale / 4, 4 * scale], 2)
        mesh = loft(row(poses, origin=shapes.MAP))
        assert not check_closed(mesh).is_self_intersecting()
        import manifold3d

        solid = body(mesh)
        made = manifold3d.Manifold(
            manifold3d.Mesh64(solid.vertices.astype(np.float64), solid.faces.astype(np.uint64))
        )
        assert made.status() == manifold3d.Error.NoError
        assert made.volume() == pytest.approx(mesh.volume, rel=1e-6)


def test_sides_with_other_vertices_at_every_station():
    sections = []
    for k, count in enumerate((5, 9, 6, 12)):
        t = np.linspace(0, 1, count)
        bow = np.stack([-0.01 - 0.003 * np.sin(np.pi * t), -0.03 * t], axis=1)
        sections.append(
            section(shapes.outline(bow, bow[::2] * (-1, 1) if count % 2 else bow * (-1, 1)), s=0.01 * k)
        )
    mesh = loft(sections)
    assert not check_closed(mesh).is_self_intersecting()
    assert mesh.volume == pytest.approx(gap_volumes(sections, mesh).slices, rel=0.02)


def test_a_ring_has_a_hole_and_no_ends():
    n, radius, half, depth = 48, 0.2, 0.01, 0.03
    shape = shapes.outline([(-half, 0), (-half, -depth)], [(half, 0), (half, -depth)])
    sections, length = [], 2 * math.pi * radius
    for k in range(n):
        t = 2 * math.pi * k / n
        out, up = np.array([math.cos(t), math.sin(t), 0]), np.array([0, 0, 1])
        # n = u x v must run along increasing angle: u points inwards.
        sections.append(
            section(shape, s=length * k / n, frame=SectionFrame.from_axes(radius * out, -out, up))
        )
    mesh = loft(sections, ring=length)
    assert not check_closed(mesh).is_self_intersecting()
    assert body(mesh).euler_number == 0
    polygon = 0.5 * n * math.sin(2 * math.pi / n)
    assert mesh.volume == pytest.approx(
        polygon * ((radius + half) ** 2 - (radius - half) ** 2) * depth, rel=1e-9
    )
    v = gap_volumes(sections, mesh, ring=length)
    assert v.slices == pytest.approx(2 * half * depth * length, rel=1e-9)
    opened = [*sections[:20], *[None] * 8, *sections[28:]]
    assert body(loft(opened, ring=length)).euler_number == 2
    assert gap_volumes(opened, ring=length).length == pytest.approx(length * 39 / 48)


def test_short_stretches_are_bridged_and_long_ones_left_out():
    sections = row(np.zeros((20, 6)))
    holed = [None if k in (5, 10, 11, 12, 13) else s for k, s in enumerate(sections)]
    mesh = loft(holed)
    assert mesh.bodies == 2
    assert mesh.bridged == (pytest.approx((0.04, 0.06)),)
    assert mesh.unmeasured == (pytest.approx((0.09, 0.14)),)
    v = gap_volumes(holed, mesh)
    assert v.length == pytest.approx(0.14)
    assert v.slices == pytest.approx(v.mesh, rel=1e-9)
    assert np.isnan(v.increments[5])
    assert v.increments[4] == pytest.approx(sections[0].area * 0.015)
    assert loft(holed, max_bridge=0.05).bodies == 1
    assert loft(holed, max_bridge=0.0).bodies == 3


def test_one_station_alone_has_no_volume():
    assert gap_volumes([None, section(), None]) is None
    assert loft([None, section(), None]).empty
    assert loft([]).empty
    assert gap_volumes([]) is None


def test_stations_out_of_order_are_refused():
    with pytest.raises(ValueError, match="in order"):
        find_runs([section(s=0.1), section(s=0.0)])


def test_volume_sigma_between_independent_and_alike():
    cov = np.diag([3e-4, 3e-4, 1e-2]) ** 2
    sections = [section(s=0.01 * k, cov_a=cov, cov_b=cov) for k in range(9)]
    share = np.array([0.005, *[0.01] * 7, 0.005])
    one = sections[0].sigma.area
    assert gap_volumes(sections).sigma == pytest.approx(one * math.sqrt((share**2).sum()))
    assert gap_volumes(sections, correlation=1.0).sigma == pytest.approx(one * share.sum())
    rho = 0.6 ** np.abs(np.subtract.outer(np.arange(9), np.arange(9)))
    rng = np.random.default_rng(3)
    drawn = rng.multivariate_normal(np.zeros(9), one**2 * rho, 20000) @ share
    assert gap_volumes(sections, correlation=0.6).sigma == pytest.approx(drawn.std(), rel=0.02)
    assert gap_volumes(sections, correlation=rho).sigma == pytest.approx(drawn.std(), rel=0.02)
    with pytest.raises(ValueError, match="correlation"):
        gap_volumes(sections, correlation=1.5)
    assert gap_volumes([*sections, section(s=0.09)]).sigma is None


def wandering(count=83):
    rng = np.random.default_rng(2)
    return row(rng.normal(size=(count, 6)) * np.tile([0.002, 0.002, 0.02], 2), origin=shapes.MAP)


@pytest.mark.parametrize("suffix", FORMATS)
def test_files_hold_the_same_body_at_map_coordinates(tmp_path, suffix):
    mesh = loft(wandering())
    out = export_mesh(mesh, tmp_path / f"gap.{suffix}")
    read = trimesh.load(out.path, force="mesh")
    assert read.is_watertight
    assert read.is_winding_consistent
    assert len(read.faces) == len(mesh.faces)
    scale = {"m": 1.0, "mm": 1e-9}[out.unit]
    local = trimesh.Trimesh(read.vertices - read.vertices.mean(axis=0), read.faces, process=False)
    assert local.volume * scale == pytest.approx(mesh.volume, rel=1e-6)
    world = read.vertices @ out.T_world_file[:3, :3].T + out.T_world_file[:3, 3]
    assert np.allclose(np.sort(world.min(axis=0)), np.sort(mesh.vertices.min(axis=0)), atol=1e-7, rtol=0)
    assert np.allclose(world.max(axis=0), mesh.vertices.max(axis=0), atol=1e-7, rtol=0)
    assert np.allclose(out.T_world_file[:3, 3], out.offset, atol=0)
    assert [p.name for p in tmp_path.iterdir()] == [out.path.name]
    again = export_mesh(mesh, tmp_path / f"again.{suffix}")
    assert again.path.read_bytes() == out.path.read_bytes()


def test_offsets_are_told_inside_the_files(tmp_path):
    mesh = loft(wandering(5))
    stl = export_mesh(mesh, tmp_path / "g.stl")
    header = stl.path.read_bytes()[:80].decode()
    assert np.allclose([float(x) for x in header.split("offset")[1].split()], stl.offset)
    glb = export_mesh(mesh, tmp_path / "g.glb")
    blob = glb.path.read_bytes()
    tree = json.loads(blob[20 : 20 + int.from_bytes(blob[12:16], "little")])
    assert tree["asset"]["extras"]["offset"] == list(glb.offset)
    assert np.allclose(np.reshape(tree["asset"]["extras"]["T_world_file"], (4, 4)), glb.T_world_file)
    assert glb.T_world_file @ (0, 1, 0, 0) == pytest.approx([0, 0, 1, 0])  # glTF's up is the world's
    three = export_mesh(mesh, tmp_path / "g.3mf")
    with zipfile.ZipFile(three.path) as archive:
        model = archive.read("3D/3dmodel.model").decode()
    assert 'unit="millimeter"' in model
    assert json.dumps(list(three.offset)) in model
    assert trimesh.load(three.path, force="mesh").vertices.min() >= 0.0


def test_what_cannot_be_written_leaves_what_was_there(tmp_path):
    kept = tmp_path / "gap.stl"
    kept.write_text("earlier")
    with pytest.raises(ExportError, match="no faces"):
        export_mesh(loft([]), kept)
    with pytest.raises(ExportError, match=r"use one of \.3mf"):
        export_mesh(loft(wandering(3)), tmp_path / "gap.dwg")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(ExportError, match="folder"):
        export_mesh(loft(wandering(3)), tmp_path / "folder.ply")
    assert kept.read_text() == "earlier"
    assert {p.name for p in tmp_path.iterdir()} == {"gap.stl", "folder.ply"}


def perimeter(spacing, start, size=(0.6, 0.4), half=0.01, depth=0.06):
    """Sections along the joint round a rectangular panel, axes kept on every leg as geometry.path does."""
    shape = shapes.outline([(-half, 0), (-half, -depth)], [(half, 0), (half, -depth)])
    corners = shapes.MAP + np.array([(0, 0, 0), (size[0], 0, 0), (*size, 0), (0, size[1], 0)])
    sections, before = [], 0.0
    for k in range(4):
        leg = corners[(k + 1) % 4] - corners[k]
        length = float(np.linalg.norm(leg))
        along = leg / length
        up = np.array([0.0, 0.0, 1.0])
        for s in np.arange(
            math.ceil((before - start) / spacing) * spacing + start, before + length - 1e-9, spacing
        ):
            frame = SectionFrame.from_axes(corners[k] + (s - before) * along, np.cross(up, along), up)
            sections.append(section(shape, s=float(s), frame=frame))
        before += length
    return sections, before


@pytest.mark.parametrize(("spacing", "start"), [(0.01, 0.005), (0.01, 0.0), (0.007, 0.002), (0.05, 0.013)])
def test_a_joint_round_a_panel_has_mitred_corners(spacing, start):
    sections, length = perimeter(spacing, start)
    mesh = loft(sections, ring=length)
    assert not check_closed(mesh).is_self_intersecting()
    assert mesh.bodies == 1
    assert body(mesh).euler_number == 0
    assert mesh.volume == pytest.approx((0.62 * 0.42 - 0.58 * 0.38) * 0.06, rel=1e-6)


def test_two_legs_of_an_open_joint_have_a_mitre():
    sections, _ = perimeter(0.01, 0.005)
    legs = [s for s in sections if s.s < 1.0]
    mesh = loft(legs)
    assert not check_closed(mesh).is_self_intersecting()
    # From 5 mm behind the first corner to 5 mm before the third, 20 mm wide, mitred once.
    assert mesh.volume == pytest.approx((0.595 + 0.395) * 0.02 * 0.06, rel=1e-6)


def test_a_corner_that_turns_out_of_the_plane():
    """A joint that runs along a wall's face and then round its edge: the mouth turns with it."""
    sections = []
    for k in range(10):
        at = np.add(shapes.MAP, (0, 0.01 * k - 0.095, 0))
        sections.append(section(s=0.01 * k, frame=SectionFrame.from_axes(at, (-1, 0, 0), (0, 0, 1))))
    for k in range(10):
        at = np.add(shapes.MAP, (0, 0, -0.005 - 0.01 * k))
        sections.append(section(s=0.1 + 0.01 * k, frame=SectionFrame.from_axes(at, (-1, 0, 0), (0, 1, 0))))
    mesh = loft(sections)
    assert not check_closed(mesh).is_self_intersecting()
    # An angle section 25 deep: 95 along each face outside, less the square that both legs share.
    assert mesh.volume == pytest.approx(0.025 * (0.095 * 0.025 + 0.095 * 0.025 - 0.025 * 0.025), rel=1e-6)


def test_corners_of_wandering_panels_stay_closed():
    rng = np.random.default_rng(6)
    for _ in range(6):
        designed, length = perimeter(float(rng.uniform(0.006, 0.03)), 0.003)
        shape = shapes.outline(designed[0].side_a, designed[0].side_b)
        poses = rng.normal(size=(len(designed), 6)) * np.tile([0.003, 0.002, 0.03], 2)
        sections = [
            section(shape, p[:3], p[3:], d.s, frame=d.frame) for d, p in zip(designed, poses, strict=True)
        ]
        check_closed(loft(sections, ring=length))
