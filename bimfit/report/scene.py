"""The joint in three dimensions: pictures made off-screen, and a window to look around in."""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bimfit.errors import BimfitError, ExportError
from bimfit.files import whole_file
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array
from bimfit.report.signals import held_back
from bimfit.report.style import GREY, INK, SCAN, SIDE_A, SIDE_B

_PALE = ("#c9d8e8", "#ead6c2")
_RAMP = "viridis"


@dataclass(frozen=True)
class JointScene:
    """What there is to see of a joint; all in world coordinates, m.

    Attributes
    ----------
    elements : sequence of TriangleMesh
        Components A and B, as designed or as built.
    points : ndarray, shape (n, 3), or None
        The scan.
    gap : TriangleMesh or None
        The as-built gap.
    gap_width : ndarray, shape (vertices of gap,), or None
        Width of the gap at its vertices, m; colours it.
    as_built : sequence of sequence of ndarray, shape (k, 3)
        For each component its outline as fitted at one station after the other; drawn as a skin with the
        outlines on it (the skin only between stations whose outlines have as many vertices).
    outlines : sequence of ndarray, shape (k, 3)
        Thin lines, closed by the caller where they are rings.
    marked : sequence of ndarray, shape (k, 3)
        Lines drawn stronger: the paper's transition slices, or a station that is looked at.
    sensor : ndarray, shape (n, 3), or None
        Where the sensor stood, in order.
    up, along : ndarray, shape (3,), or None
        Out of the mouth and along the joint: how the camera is held. Guessed from the gap where None.
    title : str
    """

    elements: Sequence[TriangleMesh] = ()
    points: Array | None = None
    gap: TriangleMesh | None = None
    gap_width: Array | None = None
    as_built: Sequence[Sequence[Array]] = ()
    outlines: Sequence[Array] = ()
    marked: Sequence[Array] = ()
    sensor: Array | None = None
    up: Array | None = None
    along: Array | None = None
    title: str = ""


@dataclass(frozen=True)
class View:
    """How a scene is looked at.

    Attributes
    ----------
    focus : {"joint", "gap"}
        What fills the picture.
    opacity : float
        Of the elements.
    azimuth, elevation : float
        Degrees: from the joint's direction towards its side, and above it.
    size : tuple of int
        Pixels.
    sensor : bool
        Whether the sensor's path is drawn, and the picture made wide enough for it.
    around : ndarray, shape (n, 3), or None
        World points that fill the picture instead of ``focus``; what lies farther out is cut off by its rim.
    """

    focus: Literal["joint", "gap"] = "joint"
    opacity: float = 1.0
    azimuth: float = 38.0
    elevation: float = 32.0
    size: tuple[int, int] = (1600, 1000)
    sensor: bool = False
    around: Array | None = None


_DEFAULT = View()


def render_joint(path: str | Path, scene: JointScene, view: View = _DEFAULT) -> Path:
    """Draw a scene into a PNG without a display (the paper's figures 5 and 6).

    Parameters
    ----------
    path : str or Path
    scene : JointScene
    view : View

    Raises
    ------
    ExportError
        When it cannot be written, or there is nothing to draw.
    """
    target = Path(path)
    if target.suffix.lower() != ".png":
        raise ExportError(f"no 3D picture format is called {target.suffix!r}", file=target, remedy="use .png")
    with held_back():  # a signal in the middle of VTK's work crashes the process
        plotter = _compose(scene, view, off_screen=True, path=target)
        try:
            with whole_file(target) as part:
                plotter.screenshot(str(part))
        finally:
            plotter.close()
    return target


def show(scene: JointScene, view: View = _DEFAULT) -> None:
    """Open a window on a scene and wait until it is closed.

    Raises
    ------
    BimfitError
        Without a display, or with nothing to show.
    """
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise BimfitError(
            "there is no display to open a window on", remedy="open the pictures in the output folder instead"
        )
    plotter = _compose(scene, view, off_screen=False, path=None)
    plotter.show()


def _has_display() -> bool:
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _compose(scene: JointScene, view: View, *, off_screen: bool, path: Path | None) -> Any:
    import pyvista as pv

    everything = [*(e.vertices for e in scene.elements), *scene.outlines, *scene.marked]
    everything += [ring for rings in scene.as_built for ring in rings]
    everything += [
        p for p in (scene.points, None if scene.gap is None else scene.gap.vertices) if p is not None
    ]
    solid = [p for p in everything if len(p)]
    if not solid:
        raise ExportError("there is nothing to draw", file=path)
    # VTK draws in single precision: map coordinates must be shifted first.
    origin = 0.5 * (
        np.min([p.min(axis=0) for p in solid], axis=0) + np.max([p.max(axis=0) for p in solid], axis=0)
    )
    if off_screen and not _has_display():
        # VTK tries X first and warns on stderr that it cannot; it then draws by EGL or in software.
        from vtkmodules.vtkCommonCore import vtkLogger

        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    plotter = pv.Plotter(off_screen=off_screen, window_size=list(view.size))
    plotter.set_background("white", top="#e9eef3")
    plotter.enable_anti_aliasing("ssaa" if off_screen else "fxaa")
    _add_elements(plotter, scene, view, origin)
    _add_skins(plotter, scene, view, origin)
    _add_lines(plotter, scene, view, origin)
    if scene.points is not None and len(scene.points):
        plotter.add_points(
            scene.points - origin, color=SCAN, point_size=6.0, render_points_as_spheres=True, ambient=0.4
        )
    _add_gap(plotter, scene, origin)
    if scene.title:
        plotter.add_text(
            scene.title, position=(0.02, 0.94), viewport=True, font_size=14, color=INK, font="arial"
        )
    _aim(plotter, scene, view, origin)
    return plotter


def _surface(mesh: TriangleMesh, origin: Array) -> Any:
    import pyvista as pv

    return pv.PolyData.from_regular_faces(mesh.vertices - origin, mesh.faces)


def _add_elements(plotter: Any, scene: JointScene, view: View, origin: Array) -> None:
    for n, element in enumerate(scene.elements):
        if not len(element.faces):
            continue
        surface = _surface(element, origin)
        plotter.add_mesh(
            surface,
            color=_PALE[n % 2],
            opacity=view.opacity,
            smooth_shading=False,
            ambient=0.25,
            diffuse=0.75,
            specular=0.0,
        )
        edges = surface.extract_feature_edges(25.0, manifold_edges=False, non_manifold_edges=False)
        if edges.n_points:
            plotter.add_mesh(edges, color=(SIDE_A, SIDE_B)[n % 2], line_width=1.6, lighting=False)


def _add_skins(plotter: Any, scene: JointScene, view: View, origin: Array) -> None:
    import pyvista as pv

    for n, given in enumerate(scene.as_built):
        rings = [_open_ring(ring) for ring in given]
        faces: list[int] = []
        start = np.cumsum([0, *(len(ring) for ring in rings)])
        for k, (here, there) in enumerate(itertools.pairwise(rings)):
            if len(here) != len(there):
                continue
            for i in range(len(here)):
                j = (i + 1) % len(here)
                faces += [
                    4,
                    *(int(x) for x in (start[k] + i, start[k] + j, start[k + 1] + j, start[k + 1] + i)),
                ]
        for k in (0, len(rings) - 1) if faces else ():
            faces += [len(rings[k]), *range(int(start[k]), int(start[k + 1]))]
        if not faces:
            continue
        skin = pv.PolyData(np.concatenate(list(rings)) - origin, faces=faces).triangulate()
        plotter.add_mesh(
            skin,
            color=_PALE[n % 2],
            opacity=view.opacity,
            smooth_shading=False,
            ambient=0.25,
            diffuse=0.75,
            specular=0.0,
        )
        closed = [np.concatenate([ring, ring[:1]]) for ring in rings if len(ring)]
        _add_polylines(plotter, closed, origin, (SIDE_A, SIDE_B)[n % 2], 1.0)


def _open_ring(ring: Array) -> Array:
    """A ring without its first vertex at the end again."""
    return ring[:-1] if len(ring) > 1 and np.array_equal(ring[0], ring[-1]) else ring


def _add_lines(plotter: Any, scene: JointScene, view: View, origin: Array) -> None:
    _add_polylines(plotter, scene.outlines, origin, GREY, 1.0)
    _add_polylines(plotter, scene.marked, origin, INK, 2.4)
    if scene.sensor is not None and view.sensor:
        _add_polylines(plotter, [scene.sensor], origin, SCAN, 1.5)


def _add_polylines(plotter: Any, lines: Sequence[Array], origin: Array, colour: str, width: float) -> None:
    import pyvista as pv

    drawn = [line for line in lines if len(line) > 1]
    if not drawn:
        return
    start = np.cumsum([0, *(len(line) for line in drawn)])
    cells = [
        np.concatenate([[len(line)], np.arange(k, k + len(line))])
        for k, line in zip(start, drawn, strict=False)
    ]
    path = pv.PolyData(np.concatenate(drawn) - origin, lines=np.concatenate(cells))
    plotter.add_mesh(path, color=colour, line_width=width, lighting=False)


def _add_gap(plotter: Any, scene: JointScene, origin: Array) -> None:
    if scene.gap is None or not len(scene.gap.faces):
        return
    surface = _surface(scene.gap, origin)
    look: dict[str, Any] = {"ambient": 0.35, "diffuse": 0.7, "specular": 0.0, "smooth_shading": False}
    if scene.gap_width is None:
        plotter.add_mesh(surface, color="#f2b134", **look)
        return
    surface.point_data["gap width (mm)"] = np.asarray(scene.gap_width) * 1e3
    plotter.add_mesh(
        surface,
        scalars="gap width (mm)",
        cmap=_RAMP,
        **look,
        scalar_bar_args={
            "title": "gap width (mm)\n",
            "color": INK,
            "n_labels": 5,
            "fmt": "%.0f" if float(np.ptp(scene.gap_width)) > 4e-3 else "%.1f",
            "vertical": False,
            "position_x": 0.35,
            "position_y": 0.03,
            "width": 0.3,
            "height": 0.1,
            "title_font_size": 22,
            "label_font_size": 20,
            "font_family": "arial",
        },
    )


def _aim(plotter: Any, scene: JointScene, view: View, origin: Array) -> None:
    up, along = _axes(scene)
    side = np.cross(along, up)
    azimuth, elevation = np.radians(view.azimuth), np.radians(view.elevation)
    level = -np.cos(azimuth) * along + np.sin(azimuth) * side
    toward = np.cos(elevation) * level + np.sin(elevation) * up
    shown = (
        [scene.gap.vertices] if view.focus == "gap" and scene.gap is not None and len(scene.gap.faces) else []
    )
    shown = shown or [e.vertices for e in scene.elements if len(e.vertices)]
    shown = shown or [ring for rings in scene.as_built for ring in rings if len(ring)]
    shown = shown or [p for p in (scene.points, *scene.outlines, *scene.marked) if p is not None and len(p)]
    if view.sensor and scene.sensor is not None:
        shown = [*shown, scene.sensor]
    points = (np.concatenate(shown) if view.around is None else view.around) - origin
    right = np.cross(up, toward)
    right /= np.linalg.norm(right)
    upward = np.cross(toward, right)
    # Parallel projection: lengths along the joint compare; the box of what is shown sets the scale.
    x, y = points @ right, points @ upward
    centre = 0.5 * (x.max() + x.min()) * right + 0.5 * (y.max() + y.min()) * upward
    centre = centre + float(np.mean(points @ toward)) * toward
    aspect = view.size[0] / view.size[1]
    half = max(0.5 * float(np.ptp(y)), 0.5 * float(np.ptp(x)) / aspect, 1e-3)
    reach = 10.0 * (half + float(np.linalg.norm(points, axis=1).max()))
    if scene.gap_width is not None:
        # Room for the scale below.
        half *= 1.08
        centre = centre - 0.09 * half * upward
    plotter.camera_position = [centre + reach * toward, centre, up]
    plotter.enable_parallel_projection()
    plotter.camera.parallel_scale = 1.18 * half
    plotter.reset_camera_clipping_range()


def _axes(scene: JointScene) -> tuple[Array, Array]:
    """Out of the mouth and along the joint, at right angles."""
    along = scene.along
    if along is None:
        source = scene.gap.vertices if scene.gap is not None and len(scene.gap.vertices) else None
        source = source if source is not None else scene.points
        lines = [*(ring for rings in scene.as_built for ring in rings), *scene.outlines, *scene.marked]
        source = (
            source if source is not None else np.concatenate([*(e.vertices for e in scene.elements), *lines])
        )
        along = np.linalg.svd(source - source.mean(axis=0), full_matrices=False)[2][0]
    along = np.asarray(along, float) / np.linalg.norm(along)
    up = np.array([0.0, 0.0, 1.0]) if scene.up is None else np.asarray(scene.up, float)
    if abs(float(up @ along)) > 0.95 * float(np.linalg.norm(up)):
        up = np.eye(3)[int(np.argmin(np.abs(along)))]
    up = up - (up @ along) * along
    return up / np.linalg.norm(up), along
