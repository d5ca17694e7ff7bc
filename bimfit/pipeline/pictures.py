"""Pictures of a run: the paper's figures 2 to 7 for any joint."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bimfit.config import Config
from bimfit.errors import ConfigError
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array
from bimfit.pipeline.document import read_results
from bimfit.pipeline.fit import DESIGNED
from bimfit.pipeline.gap_files import load_gap
from bimfit.pipeline.issues import joint_elements, open_building
from bimfit.pipeline.output import safe_name
from bimfit.pipeline.records import JointResult, StationResult, SurveyResult
from bimfit.pipeline.targets import expected_viewpoint, make_targets, matched_edges, matched_slice
from bimfit.registration.lattice import Lattice
from bimfit.registration.matchers import match
from bimfit.report.plots import GapSeries, plot_gap_poses, plot_slice
from bimfit.report.scene import JointScene, render_joint, show
from bimfit.report.tables import TableLevel, plot_tables

if TYPE_CHECKING:
    from bimfit.geometry.line_scan import LineScan
    from bimfit.scan.cloud import PointCloud
    from bimfit.simulation.truth import JointTruth

MOST_POINTS = 60_000
MOST_JOINTS = 12


def write_pictures(
    survey: SurveyResult, folder: Path, truths: Mapping[str, JointTruth] | None = None
) -> tuple[Path, ...]:
    """Draw each joint: scene, gap poses and volumes along it, one slice, and its look-up tables.

    Only the first dozen joints are drawn.

    Raises
    ------
    ExportError
        When a picture cannot be written.
    """
    made: list[Path] = []
    for joint in [j for j in survey.joints if j.measured][:MOST_JOINTS]:
        name = safe_name(joint.joint.id)
        truth = (truths or {}).get(joint.joint.id)
        elements = [survey.building.element(guid).mesh for guid in joint.joint.elements]
        scene = joint_scene(joint, elements, survey.cloud)
        made.append(render_joint(folder / f"scene-{name}.png", scene))
        series = gap_series(joint)
        status = [station.status.name for station in joint.stations]
        true = None if truth is None else truth_series(truth)
        made.append(plot_gap_poses(folder / f"gap-poses-{name}.png", series, status=status, truth=true))
        middle = typical_station(joint)
        made.append(draw_slice(folder / f"slice-{name}.png", middle))
        made.append(draw_tables(folder / f"tables-{name}.png", middle, survey.config))
    return tuple(made)


def joint_scene(joint: JointResult, elements: list[TriangleMesh], scan: LineScan | PointCloud) -> JointScene:
    """The joint with its scan and its gap, in 3D (the paper's figures 5 and 6)."""
    frames = [station.section.frame for station in joint.stations]
    measured = [station for station in joint.stations if station.gap is not None]
    as_built = []
    for k in range(2):
        outlines = []
        for station in measured:
            pose = station.components[k].pose
            profile = station.section.components[k]
            if pose is not None and profile.loops:
                ring = pose.apply(profile.loops[0])
                outlines.append(station.section.frame.to_world(np.concatenate([ring, ring[:1]])))
        as_built.append(outlines)
    points = np.concatenate([f.to_world(s.slice.points) for f, s in zip(frames, joint.stations, strict=True)])
    step = max(1, len(points) // MOST_POINTS)
    eyes = [
        station.section.frame.to_world(station.slice.viewpoint)
        for station in joint.stations
        if station.slice.viewpoint is not None and station.slice.beams is not None
    ]
    mesh = joint.mesh
    return JointScene(
        elements=elements if len(elements) and not any(as_built) else (),
        points=points[::step],
        gap=None if mesh is None else mesh.triangles,
        gap_width=None if mesh is None else mesh.width,
        as_built=as_built,
        sensor=np.array(eyes) if len(eyes) > 1 else None,
        up=frames[0].v,
        along=frames[0].n,
        title=f"{joint.joint.id}: as-built gap and scan",
    )


def gap_series(joint: JointResult) -> GapSeries:
    """Gap poses and differential volumes along a joint, NaN where there are none."""
    columns: dict[str, list[float]] = {name: [] for name in ("x", "z", "angle", "sx", "sz", "sa", "sarea")}
    for station in joint.stations:
        gap = station.gap
        sigma = None if gap is None else gap.sigma
        columns["x"].append(np.nan if gap is None else float(gap.origin[0]))
        columns["z"].append(np.nan if gap is None else float(gap.origin[1]))
        columns["angle"].append(np.nan if gap is None else gap.angle)
        for key, name in (("sx", "x"), ("sz", "y"), ("sa", "angle"), ("sarea", "area")):
            columns[key].append(np.nan if sigma is None else float(getattr(sigma, name)))
    s = np.array([station.section.s for station in joint.stations])
    c = {name: np.array(values) for name, values in columns.items()}
    volumes = joint.volumes
    volume = np.full(len(s), np.nan) if volumes is None else volumes.increments
    area = np.array([np.nan if t.gap is None else t.gap.area for t in joint.stations])
    share = volume / np.where(area > 0.0, area, np.nan)
    known = bool(np.isfinite(c["sx"]).any())
    return GapSeries(
        s,
        c["x"],
        c["z"],
        c["angle"],
        volume,
        *((c["sx"], c["sz"], c["sa"], c["sarea"] * share) if known else (None,) * 4),
    )


def truth_series(truth: JointTruth) -> GapSeries:
    """The same of a simulated joint's truth."""
    s = np.array([station.s for station in truth.stations])
    local = np.array([t.frame.to_section(t.gap.origin) for t in truth.stations])
    angle = np.array([t.gap.angle for t in truth.stations])
    area = np.array([t.gap.area for t in truth.stations])
    return GapSeries(s, local[:, 0], local[:, 1], angle, area * _half_distances(s))


def typical_station(joint: JointResult) -> StationResult:
    """The measured station nearest to the middle of the joint."""
    measured = [station for station in joint.stations if station.gap is not None]
    return min(measured, key=lambda station: abs(station.section.s - 0.5 * joint.joint.length))


def draw_slice(path: Path, station: StationResult) -> Path:
    """One slice with its designed and fitted outlines and its gap."""
    gap = station.gap
    fitted = [
        profile.moved(component.pose)
        for profile, component in zip(station.section.components, station.components, strict=True)
        if component.pose is not None
    ]
    note = "" if gap is None else f"mouth {gap.width_mouth * 1e3:.2f} mm, area {gap.area * 1e6:.0f} mm²"
    return plot_slice(
        path,
        station.slice,
        station.section.components,
        fitted=fitted,
        gap=() if gap is None else gap.parts,
        title=f"Slice at {station.section.s * 1e3:.0f} mm",
        note=f"{note}\n{station.status.name} {station.status.reason}".strip(),
    )


def draw_tables(path: Path, station: StationResult, config: Config) -> Path:
    """Look-up tables from coarse to fine, with the scan at the best pose of each level (figures 2 to 4)."""
    edges = matched_edges(station.section, expected_viewpoint(station.slice, station.section), config)
    target = make_targets(edges, config).combined
    near = matched_slice(station.slice, config)
    start = near.points
    finest = Lattice.of(config.search)
    table = target.tables(finest, "overlap", float(np.hypot(*(start - start.mean(axis=0)).T).max()))
    levels = []
    for level in range(finest.levels[0], 0, -1):
        factor = finest.tests[0] ** (level - 1)
        coarse = tuple(
            q * s ** min(level - 1, count - 1)
            for q, s, count in zip(finest.step, finest.tests, finest.levels, strict=True)
        )
        found = match(target, near, DESIGNED, dataclasses.replace(config.search, tolerance=coarse))
        values, extent = _blocks(table.leaf, table.origin, finest.step, factor)
        label = f"level {level}: {finest.step[0] * factor * 1e3:.3g} mm"
        moved = found.pose.inverse().apply(start) if found.found else None
        levels.append(TableLevel(values, extent, label, moved, start))
    return plot_tables(path, levels)


def _blocks(
    leaf: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], origin: Array, step: Sequence[float], factor: int
) -> tuple[Array, tuple[float, float, float, float]]:
    """Block maxima of a look-up table (paper, Fig. 3), and the extent that they cover."""
    rows, columns = (-(-n // factor) * factor for n in leaf.shape)
    padded = np.zeros((rows, columns))
    padded[: leaf.shape[0], : leaf.shape[1]] = leaf / 255.0
    values = padded.reshape(rows // factor, factor, columns // factor, factor).max(axis=(1, 3))
    low_u, low_v = float(origin[0]), float(origin[1])
    return values, (low_u, low_u + columns * step[0], low_v, low_v + rows * step[1])


def view_folder(folder: Path, picture: Path | None = None) -> None:
    """Show what a results folder holds, in a window or as a picture.

    Raises
    ------
    BimfitError
        When the folder holds no results, or there is no display.
    """
    scene = folder_scene(folder)
    if picture is not None:
        render_joint(picture, scene)
    else:
        show(scene)


def folder_scene(folder: Path) -> JointScene:
    """The gap meshes of a results folder, with the model they are from where it is still there.

    Raises
    ------
    ConfigError
        When the folder holds no results of bimfit.
    """
    results = read_results(folder)
    gaps = [gap for gap in (load_gap(joint, folder) for joint in results.joints) if gap is not None]
    if not gaps:
        raise ConfigError("holds no gap mesh: no joint could be estimated", file=folder)
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh, _ in gaps)])
    whole = TriangleMesh.of(
        np.concatenate([mesh.vertices for mesh, _ in gaps]),
        np.concatenate([mesh.faces + start for (mesh, _), start in zip(gaps, starts, strict=False)]),
    )
    building = open_building(results)
    drawn = [mesh for joint in results.joints for mesh in joint_elements(joint, building)]
    elements = list({id(mesh): mesh for mesh in drawn}.values())
    widths = np.concatenate([width for _, width in gaps])
    return JointScene(elements=elements, gap=whole, gap_width=widths, title=str(folder))


def _half_distances(s: Array) -> Array:
    """Half the distance to each neighbouring station, added up (paper, section 5)."""
    if len(s) < 2:
        return np.ones_like(s)
    steps = np.diff(s)
    return np.asarray(0.5 * (np.append(steps, 0.0) + np.insert(steps, 0, 0.0)))
