"""Design sections: the samples' known figures, curved paths, real pairs, and stations that are missing."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import shapely
import trimesh

from bimfit.bim.model import element_from_mesh, load_model, model_from_elements
from bimfit.bim.stations import (
    default_stations,
    design_section,
    design_sections,
    missing_stations,
    same_profile,
)
from bimfit.errors import BimfitError, ConfigError, JointError
from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.path import JointPath
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "ifc_samples"
REAL = ROOT.parent / "shared" / "data" / "ifc"
MM = 1e-3


@dataclass(frozen=True)
class Pair:
    """Stands in for a Joint."""

    elements: tuple[str, str]
    path: JointPath


def box(low, high):
    low, high = np.asarray(low, float), np.asarray(high, float)
    solid = trimesh.creation.box(high - low)
    solid.apply_translation((low + high) / 2)
    return TriangleMesh.of(solid.vertices, solid.faces)


def sample(name, a, b, start, end, u):
    """The model and the pair of two named elements, with a straight path (mm)."""
    model = load_model(SAMPLES / name, cache=False)
    guids = {element.name: element.guid for element in model.elements}
    path = JointPath.straight(np.array(start) * MM, np.array(end) * MM, u)
    return model, Pair((guids[a], guids[b]), path)


GROOVE = 2.5 + 22 * math.tan(math.radians(30))
# file, A, B, path's start and end, u; wanted: first origin, side A and B in the section (mm)
KNOWN = {
    "butt, IFC2X3": (
        ("square-butt-ifc2x3.ifc", "Board B", "Board A", (0, 0, 37), (0, 820, 37), (-1, 0, 0)),
        (0, None, 50), [(-12.5, 0), (-12.5, -25)], [(12.5, 0), (12.5, -25)],
    ),
    "butt, IFC4": (
        ("square-butt-ifc4.ifc", "Board B", "Board A", (0, 0, 37), (0, 820, 37), (-1, 0, 0)),
        (0, None, 50), [(-12.5, 0), (-12.5, -25)], [(12.5, 0), (12.5, -25)],
    ),
    "butt, IFC4X3": (
        ("square-butt-ifc4x3.ifc", "Board B", "Board A", (0, 0, 37), (0, 820, 37), (-1, 0, 0)),
        (0, None, 50), [(-12.5, 0), (-12.5, -25)], [(12.5, 0), (12.5, -25)],
    ),
    "V": (
        ("v-groove.ifc", "Plate B", "Plate A", (1, 0, 35), (1, 820, 35), (-1, 0, 0)),
        (0, None, 50),
        [(-GROOVE, 0), (-2.5, -22), (-2.5, -25)], [(GROOVE, 0), (2.5, -22), (2.5, -25)],
    ),
    "lap": (
        ("lap.ifc", "Lower board", "Upper board", (0, 0, 28), (0, 820, 28), (0, 0, 1)),
        (25, None, 28), [(-3, 0), (-3, -50)], [(3, 0), (3, -50)],
    ),
    "T": (
        ("t-joint.ifc", "Base", "Stem", (0, 0, 30), (0, 820, 30), (0, 0, 1)),
        (20, None, 31), [(-6, 0), (-6, -40)], [(6, 0), (6, -40)],
    ),
    "mitre": (
        ("mitre.ifc", "South wall", "West wall", (60, 60, 0), (60, 60, 1000), (-1, 1, 0)),
        (10 / math.sqrt(2), 10 / math.sqrt(2), None),
        [(-10, 0), (-10, -120 * math.sqrt(2))], [(10, 0), (10, -120 * math.sqrt(2))],
    ),
    "facade, upright": (
        ("facade.ifc", "Panel 1.1", "Panel 1.2", (3010, 70, 2980), (3010, 70, 0), (1, 0, 0)),
        (3010, 0, None), [(-10, 0), (-10, -140)], [(10, 0), (10, -140)],
    ),
    "facade, level": (
        ("facade.ifc", "Panel 1.3", "Panel 2.3", (6040, 70, 2990), (9040, 70, 2990), (0, 0, 1)),
        (None, 0, 2990), [(-10, 0), (-10, -140)], [(10, 0), (10, -140)],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", KNOWN)
def test_samples_have_their_designed_gaps(name):
    source, origin, side_a, side_b = KNOWN[name]
    model, pair = sample(*source)
    stations = default_stations(pair.path.length, 0.05)
    sections = design_sections(model, pair, stations, 0.2)
    np.testing.assert_allclose([section.s for section in sections], stations)
    for section in sections:
        for value, wanted in zip(section.frame.origin, origin, strict=True):
            assert wanted is None or value == pytest.approx(wanted * MM, abs=1e-8)
        np.testing.assert_allclose(section.gap.side_a, np.array(side_a) * MM, atol=1e-8)
        np.testing.assert_allclose(section.gap.side_b, np.array(side_b) * MM, atol=1e-8)
        np.testing.assert_allclose(sum(section.gap.mouth), 0.0, atol=1e-12)
    # one design for all stations: the very same objects
    assert len({id(section.components[k]) for section in sections for k in (0, 1)}) == 2
    assert len({id(section.gap) for section in sections}) == 1


def test_reach_bounds_the_components_and_marks_the_cut():
    model, pair = sample(*KNOWN["facade, upright"][0])
    (near,) = design_sections(model, pair, [1.0], 0.2)
    (far,) = design_sections(model, pair, [1.0], 10.0)
    a, b = near.components
    np.testing.assert_allclose(a.bounds, [[-0.21, -0.14], [-0.01, 0.0]], atol=1e-8)
    np.testing.assert_allclose(a.edges[~a.surface][:, :, 0], -0.21, atol=1e-8)
    np.testing.assert_allclose(b.edges[~b.surface][:, :, 0], 0.21, atol=1e-8)
    assert far.components[0].surface.all()
    assert far.components[0].area == pytest.approx(3.0 * 0.14, abs=1e-8)
    np.testing.assert_allclose(far.gap.side_a, near.gap.side_a, atol=1e-12)


def test_windows_beside_a_joint_change_the_profile_but_not_the_gap():
    # the second column's panels have a window 900 from the joint, between 900 and 2300 up
    model, pair = sample(*KNOWN["facade, upright"][0])
    sections = design_sections(model, pair, default_stations(2.98, 0.04), 3.0)
    assert len(sections) == 74
    assert len({id(section.components[1]) for section in sections}) == 2
    pierced = [2.98 - s.s for s in sections if len(s.components[1].loops) == 2]
    assert 0.9 < min(pierced) < 0.94
    assert 2.26 < max(pierced) < 2.3
    assert len({id(section.gap) for section in sections}) == 1


def arc_path(radius, height, facets):
    """Along 60 degrees, u up and v outwards: u x v runs along increasing bearing."""
    bearing = np.linspace(0, math.pi / 3, facets + 1)
    middle = 0.5 * (bearing[1:] + bearing[:-1])
    points = np.column_stack(
        [radius * np.cos(bearing), radius * np.sin(bearing), np.full(facets + 1, height)]
    )
    outward = np.column_stack([np.cos(middle), np.sin(middle), np.zeros(facets)])
    return JointPath(points, np.tile([0.0, 0.0, 1.0], (facets, 1)), outward)


def test_sections_of_an_arc_are_radial():
    model = load_model(SAMPLES / "curved.ifc", cache=False)
    guids = {element.name: element.guid for element in model.elements}
    path = arc_path(2.95, 0.61, 29)
    pair = Pair((guids["Lower panel"], guids["Upper panel"]), path)
    stations = default_stations(path.length, 0.02)
    sections = design_sections(model, pair, stations, 0.2)
    assert len(sections) == len(stations) == 154
    for section in sections:
        frame = section.frame
        radial = frame.origin * (1, 1, 0)
        radial /= np.linalg.norm(radial)
        assert math.degrees(math.acos(min(1.0, frame.v @ radial))) < 0.2
        # the panels are facets: their outside lies up to a millimetre within the radius
        assert 2.9985 < np.hypot(*frame.origin[:2]) < 3.0 + 1e-9
        a, b = section.gap.mouth
        np.testing.assert_allclose(b - a, (0.02, 0.0), atol=2e-5)
        a, b = section.gap.root
        np.testing.assert_allclose(b - a, (0.02, 0.0), atol=2e-5)


def rough_path(a, b):
    """The path along the largest pair of faces that look at one another within 60 mm, and its gap."""
    best = None
    sizes = [np.linalg.norm(m.face_vectors, axis=1) for m in (a, b)]
    for i in np.flatnonzero(sizes[0] > 1e-4):
        n = a.face_vectors[i] / sizes[0][i]
        middle = a.triangles[i].mean(axis=0)
        for j in np.flatnonzero(sizes[1] > 1e-4):
            if n @ b.face_vectors[j] / sizes[1][j] > -0.999:
                continue
            gap = float((b.triangles[j].mean(axis=0) - middle) @ n)
            if not 0.0 < gap < 0.06:
                continue
            faces = [m.triangles[(np.abs((m.triangles - p) @ n).max(axis=1) < 1e-4)].reshape(-1, 3)
                     for m, p in ((a, middle), (b, b.triangles[j].mean(axis=0)))]  # fmt: skip
            frames = _rectangle_axes(faces[0], n)
            spans = [np.stack([(f @ frames).min(axis=0), (f @ frames).max(axis=0)]) for f in faces]
            low, high = np.maximum(spans[0][0], spans[1][0]), np.minimum(spans[0][1], spans[1][1])
            if np.any(high - low < 0.005):
                continue
            area = float(np.prod(high - low))
            if best is None or area > best[0]:
                order = int(np.argmax(high - low))
                ends = np.tile(0.5 * (low + high), (2, 1))
                ends[:, order] = low[order], high[order]
                base = n * (middle @ n + gap / 2)
                best = area, gap, n, ends @ frames.T + base
    assert best is not None
    _, gap, n, ends = best
    return JointPath.straight(*ends, n), gap


def _rectangle_axes(points, n):
    """Sides of the least rectangle around coplanar points, shape (3, 2)."""
    plane = np.linalg.svd(n[None])[2][1:].T
    corners = shapely.get_coordinates(shapely.MultiPoint(points @ plane).minimum_rotated_rectangle)
    side = plane @ (corners[1] - corners[0])
    side /= np.linalg.norm(side)
    return np.column_stack([side, np.cross(n, side)])


@pytest.mark.parametrize(
    ("name", "a", "b", "gap", "length"),
    [
        ("XELLA-3e_verdieping.ifc", "0IjRD_pxn9aRaRUWq6Ebnq", "2geNRwqjn30uvGChtbfnYT", 3.0, 643),
        ("XELLA-3e_verdieping.ifc", "2Xvgd3_obAS9WBKxab2dfp", "18Su4zPSrECA7LPdeiBdes", 30.0, 2711),
        ("MULTICOM-banden.ifc", "1L6a$l0008y34qCZStEJCr", "1L6a$l00091J4qCZStEJCr", 10.0, 383),
        ("ROOT-kalkzandsteen.ifc", "3HGDkJWG95UBZE0EMTLl3$", "2qiB0g_bbDCwZnOTvTZQ6o", 30.0, 2884),
    ],
)
def test_real_pairs_have_their_designed_gap(name, a, b, gap, length):
    if not (REAL / name).exists():
        pytest.skip("the shared models are not there")
    model = load_model(REAL / name, include=[a, b], cache=False)
    path, measured = rough_path(model.element(a).mesh, model.element(b).mesh)
    assert measured == pytest.approx(gap * MM, abs=0.2 * MM)
    stations = default_stations(path.length, 0.05)
    for way in (path, path.flipped()):
        sections = design_sections(model, Pair((a, b), way), stations, 0.2)
        assert len(sections) >= 0.95 * len(stations)
        for section in sections:
            (a1, b1), (a2, b2) = section.gap.mouth, section.gap.root
            narrow = shapely.LineString(section.gap.side_a).distance(shapely.LineString(section.gap.side_b))
            assert narrow == pytest.approx(gap * MM, abs=0.2 * MM)
            assert b1[0] - a1[0] == pytest.approx(gap * MM, abs=0.6 * MM)
            assert b2[0] - a2[0] == pytest.approx(gap * MM, abs=0.6 * MM)
            assert min(a1[1], b1[1]) > max(a2[1], b2[1])
    assert path.length == pytest.approx(length * MM, rel=0.06)


def test_stations_where_a_component_is_missing_are_left_out_and_named():
    a = box((-0.2, 0, -0.1), (-0.01, 1.0, 0))
    b = box((0.01, 0.3, -0.1), (0.2, 1.0, 0))
    path = JointPath.straight((0, 1, -0.05), (0, 0, -0.05), (1, 0, 0))
    stations = default_stations(1.0, 0.1)
    elements = {"a": element_from_mesh(a, "a"), "b": element_from_mesh(b, "b")}
    sections = design_sections(elements, Pair(("a", "b"), path), stations, 0.2)
    assert [round(s.s, 9) for s in sections] == [0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65]
    np.testing.assert_allclose(missing_stations(stations, sections), [0.75, 0.85, 0.95])


def test_stations_where_the_gap_opens_to_a_hole_are_left_out():
    upper = box((0.01, 0.6, -0.1), (0.3, 1.0, 0))
    lower = box((0.01, 0.0, -0.1), (0.3, 0.4, 0))
    back = box((0.25, 0.3, -0.1), (0.3, 0.7, 0))
    b = trimesh.util.concatenate([trimesh.Trimesh(m.vertices, m.faces) for m in (upper, lower, back)])
    elements = {
        "a": element_from_mesh(box((-0.2, 0, -0.1), (-0.01, 1.0, 0)), "a"),
        "b": element_from_mesh(TriangleMesh.of(b.vertices, b.faces), "b"),
    }
    path = JointPath.straight((0, 1, -0.05), (0, 0, -0.05), (1, 0, 0))
    stations = default_stations(1.0, 0.1)
    sections = design_sections(elements, Pair(("a", "b"), path), stations, 0.2)
    np.testing.assert_allclose(missing_stations(stations, sections), [0.45, 0.55])


def test_a_gap_far_wider_than_the_joint_is_none():
    @dataclass(frozen=True)
    class Wide(Pair):
        width: float = 0.02

    elements = {
        "a": element_from_mesh(box((-0.5, 0, -0.1), (-0.2, 1.0, 0)), "a"),
        "b": element_from_mesh(box((0.5, 0, -0.1), (0.9, 1.0, 0)), "b"),
    }
    path = JointPath.straight((0.3, 1, -0.05), (0.3, 0, -0.05), (1, 0, 0))
    assert design_sections(elements, Wide(("a", "b"), path), [0.5], 0.2) == ()
    # two that are named and known to be that far apart are another matter
    (section,) = design_sections(elements, Wide(("a", "b"), path, 0.7), [0.5], 0.2)
    assert section.gap.mouth[1][0] - section.gap.mouth[0][0] == pytest.approx(0.7)


def test_a_tapering_gap_keeps_its_own_section_at_every_station():
    b = box((0.01, 0, -0.1), (0.2, 1.0, 0))
    vertices = b.vertices.copy()
    near = np.isclose(vertices[:, 0], 0.01) & np.isclose(vertices[:, 1], 1.0)
    vertices[near, 0] += 0.01
    elements = {
        "a": element_from_mesh(box((-0.2, 0, -0.1), (-0.01, 1.0, 0)), "a"),
        "b": element_from_mesh(TriangleMesh(vertices, b.faces), "b"),
    }
    path = JointPath.straight((0, 1, -0.05), (0, 0, -0.05), (1, 0, 0))
    sections = design_sections(elements, Pair(("a", "b"), path), default_stations(1.0, 0.1), 0.2)
    widths = [float(s.gap.mouth[1][0] - s.gap.mouth[0][0]) for s in sections]
    np.testing.assert_allclose(widths, [0.02 + 0.01 * (1 - s.s) for s in sections], atol=1e-9)
    assert len({id(s.gap) for s in sections}) == 10
    for section in sections:  # the frame sits midway, wherever the path ran
        np.testing.assert_allclose(sum(section.gap.mouth), 0.0, atol=1e-12)
        assert section.frame.origin[0] == pytest.approx(0.005 * (1 - section.s), abs=1e-9)
        assert section.frame.origin[2] == pytest.approx(0.0, abs=1e-12)


def test_map_coordinates():
    east = np.array([458657.0, 5438232.0, 112.0])
    a = box((-0.2, 0, -0.1), (-0.01, 1.0, 0)).transformed(_shift(east))
    b = box((0.01, 0, -0.1), (0.2, 1.0, 0)).transformed(_shift(east))
    path = JointPath.straight(np.add(east, (0, 1, -0.05)), np.add(east, (0, 0, -0.05)), (1, 0, 0))
    elements = {"a": element_from_mesh(a, "a"), "b": element_from_mesh(b, "b")}
    sections = design_sections(elements, Pair(("a", "b"), path), default_stations(1.0, 0.1), 0.2)
    assert len(sections) == 10
    for section in sections:
        np.testing.assert_allclose(section.gap.side_a, [(-0.01, 0), (-0.01, -0.1)], atol=5e-9)
        np.testing.assert_allclose(section.frame.origin[[0, 2]], east[[0, 2]], atol=5e-9)
    assert len({id(section.components[0]) for section in sections}) == 1


def _shift(by):
    T = np.eye(4)
    T[:3, 3] = by
    return T


def test_what_does_not_face_has_no_section():
    element = element_from_mesh(box((-0.2, 0, -0.1), (-0.01, 1.0, 0)), "a")
    other = element_from_mesh(box((-0.2, 0, 0.3), (-0.01, 1.0, 0.4)), "b")
    frame = SectionFrame.from_axes((0, 0.5, 0), (1, 0, 0), (0, 0, 1))
    assert design_section(element, other, frame, 0.5, 0.2) is None


def test_elements_that_are_not_there_are_named():
    path = JointPath.straight((0, 1, 0), (0, 0, 0), (1, 0, 0))
    element = element_from_mesh(box((-0.2, 0, -0.1), (-0.01, 1.0, 0)), "a", "1L6a$l0008y34qCZStEJCr")
    for elements in ({element.guid: element}, model_from_elements([element])):
        with pytest.raises(JointError, match="0IjRD_pxn9aRaRUWq6Ebnq"):
            design_sections(elements, Pair((element.guid, "0IjRD_pxn9aRaRUWq6Ebnq"), path), [0.5], 0.2)


@pytest.mark.parametrize(("length", "spacing", "count"), [(0.82, 0.01, 82), (1.0, 0.3, 3), (0.05, 0.2, 1)])
def test_default_stations_share_the_length_evenly(length, spacing, count):
    stations = default_stations(length, spacing)
    assert len(stations) == count
    edges = np.concatenate([[0.0], 0.5 * (stations[1:] + stations[:-1]), [length]])
    np.testing.assert_allclose(np.diff(edges), length / count, atol=1e-12)


@pytest.mark.parametrize("spacing", [0.0, -1.0, math.nan, math.inf])
def test_bad_spacing_is_refused(spacing):
    with pytest.raises(ConfigError, match="spacing"):
        default_stations(1.0, spacing)
    assert issubclass(ConfigError, BimfitError)


def test_same_profile_sees_through_the_start_of_a_loop_only():
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    mask = np.array([False, True, False, False])
    p = Profile((square,), 0.0, (mask,))
    assert same_profile(p, Profile((np.roll(square, 1, axis=0),), 0.0, (np.roll(mask, 1),)))
    assert same_profile(p, p.moved(Pose2D(9e-7, 0, 0)))
    assert not same_profile(p, p.moved(Pose2D(2e-6, 0, 0)))
    assert not same_profile(p, Profile((square,)))
    assert not same_profile(p, Profile((square[:3],), 0.0, (mask[:3],)))
