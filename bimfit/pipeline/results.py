"""results.json and stations.csv (CONTRACT: schema 1)."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from bimfit import __version__
from bimfit.gap.section import gap_section
from bimfit.geometry.pose import Pose2D
from bimfit.pipeline.records import ComponentResult, FreedomResult, JointResult, StationResult, SurveyResult

if TYPE_CHECKING:
    from bimfit.bim.model import Model
    from bimfit.gap.section import GapSection
    from bimfit.geometry.frame import SectionFrame
    from bimfit.registration.result import MatchResult

SCHEMA = 1


def survey_to_dict(
    survey: SurveyResult,
    meshes: Mapping[str, Mapping[str, Any]],
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> dict[str, Any]:
    """The whole run as results.json holds it.

    Parameters
    ----------
    survey : SurveyResult
    meshes : mapping
        For each joint id: ``mesh`` (file name) and what else is known of its files, such as ``offset``.
    limits : mapping, optional
        What joints may measure, m, by :class:`bimfit.pipeline.limits.Limits`' names; null is an open end.
    """
    return {
        "schema": SCHEMA,
        "bimfit": __version__,
        "model": str(survey.model),
        "scan": str(survey.scan),
        "units": {"length": "m", "angle": "rad"},
        "notes": list(survey.notes),
        "placing": _placing(survey),
        "limits": dict(limits) if limits else None,
        "joints": [_joint(joint, survey.building, meshes.get(joint.joint.id, {})) for joint in survey.joints],
    }


def _placing(survey: SurveyResult) -> dict[str, Any] | None:
    """How the scan's file became world coordinates."""
    from bimfit.pipeline.aligning import alignment_to_dict

    placed = survey.placed
    if placed is None:
        return None
    found = placed.alignment
    return {
        "crs": placed.crs,
        "transform": placed.T_world_file.ravel(),
        "align": None if found is None else alignment_to_dict(found),
    }


def _joint(result: JointResult, building: Model, files: Mapping[str, Any]) -> dict[str, Any]:
    volumes = result.volumes
    elements = [building.element(guid) for guid in result.joint.elements]
    path = result.joint.path
    return {
        **result.joint.to_dict(),
        "names": [element.name for element in elements],
        "classes": [element.ifc_class for element in elements],
        "storeys": [element.storey for element in elements],
        "path": {"points": path.points, "u": path.u, "v": path.v, "closed": path.closed},
        "method": result.method,
        "motion": result.motion,
        "noise": None
        if result.noise is None
        else {
            "sigma": result.noise.sigma,
            "correlation": result.noise.correlation,
            "outlier_share": result.noise.outlier_share,
            "miss_share": result.noise.miss_share,
        },
        "status": "ok" if result.measured else "not estimated",
        "reason": result.reason,
        "stations": [_station(station) for station in result.stations],
        "volume": None
        if volumes is None
        else {"slices": volumes.slices, "mesh": volumes.mesh, "sigma": volumes.sigma},
        "length": result.joint.length,
        "mesh": None,
        **files,
        "seconds": {"joint": result.seconds, "tables": result.table_seconds},
    }


def _station(station: StationResult) -> dict[str, Any]:
    frame = station.section.frame
    return {
        "s": station.section.s,
        "frame": {axis: getattr(frame, axis) for axis in ("origin", "u", "v", "n")},
        "status": station.status.name,
        "reason": station.status.reason,
        "points": len(station.slice.points),
        "combined": None if station.combined is None else _search(station.combined, frame),
        "components": [_component(component, frame) for component in station.components],
        "gap": None if station.gap is None else _gap(station, station.gap),
        "seconds": station.seconds,
    }


def _component(component: ComponentResult, frame: SectionFrame) -> dict[str, Any]:
    pose = component.pose
    return {
        "element": component.element,
        "transform": None if pose is None else frame.lift(pose).ravel(),
        "pose": None if pose is None else pose.as_array(),
        "covariance": component.covariance,
        "residual": component.rms,
        "search": None if component.match is None else _search(component.match, frame),
        **({"shape": {f.name: _freedom(f) for f in component.shape}} if component.shape else {}),
    }


def _freedom(freedom: FreedomResult) -> dict[str, Any]:
    """One freedom of shape: its difference from the design, null where the data do not show it."""
    return {
        "value": freedom.value,
        "sigma": freedom.sigma,
        "unit": "m" if freedom.name == "thickness" else "rad",
        "state": freedom.state,
        "pooled": freedom.pooled,
    }


def _search(match: MatchResult, frame: SectionFrame) -> dict[str, Any]:
    return {
        "method": match.method,
        "transform": frame.lift(match.pose).ravel() if match.found else None,
        "pose": match.parameters if match.found else None,
        "score": match.score,
        "bound": match.bound,
        "evaluations": match.evaluations,
        "levels": list(match.levels),
        # nothing stopped where nothing was searched
        "stop": match.stop if match.found or match.evaluations else None,
        "fitness": match.fitness,
        "inlier_rmse": match.inlier_rmse,
        "modes": [{"pose": mode.parameters, "score": mode.score} for mode in match.modes],
        "seconds": match.seconds,
    }


def _gap(station: StationResult, gap: GapSection) -> dict[str, Any]:
    sigma, step = gap.sigma, station.step
    return {
        "origin": gap.origin_world,
        "angle": gap.angle,
        "width": {"mouth": gap.width_mouth, "root": gap.width_root, "narrowest": gap.width_narrowest},
        "area": gap.area,
        "overlap": gap.overlap_area,
        "contact": gap.contact,
        "step": None if step is None else step.value,
        "designed": _designed(station),
        "polygon": gap.polygon_world,
        "sigma": None
        if sigma is None
        else {
            **{name: getattr(sigma, name) for name in ("x", "y", "angle", "width", "area")},
            "root": sigma.width_root,
            "narrowest": sigma.width_narrowest,
            "step": None if step is None else step.sigma,
        },
    }


def _designed(station: StationResult) -> dict[str, Any]:
    """The same gap as designed, measured in the same way."""
    section = station.section
    design = gap_section(section.s, section.frame, section.gap, Pose2D(), Pose2D())
    return {
        "width": {
            "mouth": design.width_mouth,
            "root": design.width_root,
            "narrowest": design.width_narrowest,
        },
        "area": design.area,
        "step": None if station.step is None else station.step.designed,
    }


def to_json(value: Any) -> str:
    """JSON text in which what is not known is null: NaN and infinities have no place in it."""
    return json.dumps(_plain(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


COLUMNS = [
    "joint",
    "element_a",
    "element_b",
    "kind",
    "s_m",
    "status",
    "reason",
    "points",
    "width_mouth_m",
    "width_root_m",
    "width_narrowest_m",
    "area_m2",
    "angle_rad",
    "origin_x_m",
    "origin_y_m",
    "origin_z_m",
    "sigma_x_m",
    "sigma_y_m",
    "sigma_width_m",
    "sigma_angle_rad",
    "sigma_area_m2",
    "a_u_m",
    "a_v_m",
    "a_theta_rad",
    "b_u_m",
    "b_v_m",
    "b_theta_rad",
    "search_stop",
    "evaluations",
    "contact",
    "designed_width_mouth_m",
    "step_m",
    "designed_step_m",
    "sigma_width_root_m",
    "sigma_width_narrowest_m",
    "sigma_step_m",
]


def stations_to_csv(joints: Iterable[JointResult]) -> str:
    """One row a station, for a spreadsheet; what is not known is left empty."""
    text = io.StringIO()
    joints = tuple(joints)
    writer = csv.DictWriter(text, [*COLUMNS, *_shape_columns(joints)], lineterminator="\n")
    writer.writeheader()
    for joint in joints:
        for station in joint.stations:
            row = {key: value for key, value in _row(joint, station).items() if not _unknown(value)}
            writer.writerow({key: repr(float(v)) if isinstance(v, float) else v for key, v in row.items()})
    return text.getvalue()


def _shape_columns(joints: Iterable[JointResult]) -> list[str]:
    """Columns of the shape freedoms that any station has, in order."""
    found = [
        column
        for joint in joints
        for station in joint.stations
        for name, component in zip("ab", station.components, strict=True)
        for column in _shape_row(name, component)
    ]
    return sorted(set(found), key=found.index)


def _shape_row(name: str, component: ComponentResult) -> dict[str, float | None]:
    row: dict[str, float | None] = {}
    for freedom in component.shape:
        what = f"{name}_{freedom.name.replace('-', '_')}"
        unit = "m" if freedom.name == "thickness" else "rad"
        row |= {f"{what}_{unit}": freedom.value, f"sigma_{what}_{unit}": freedom.sigma}
    return row


def _unknown(value: Any) -> bool:
    return value is None or (isinstance(value, float) and not math.isfinite(value))


def _row(joint: JointResult, station: StationResult) -> dict[str, Any]:
    a, b = joint.joint.elements
    row: dict[str, Any] = {
        "joint": joint.joint.id,
        "element_a": a,
        "element_b": b,
        "kind": joint.joint.kind,
        "s_m": float(station.section.s),
        "status": station.status.name,
        "reason": station.status.reason,
        "points": len(station.slice.points),
    }
    for name, component in zip("ab", station.components, strict=True):
        row |= _shape_row(name, component)
        if component.pose is not None:
            row |= {
                f"{name}_u_m": component.pose.u,
                f"{name}_v_m": component.pose.v,
                f"{name}_theta_rad": component.pose.theta,
            }
    if station.combined is not None:
        row["evaluations"] = station.combined.evaluations
        if station.combined.found or station.combined.evaluations:
            row["search_stop"] = station.combined.stop
    gap = station.gap
    if gap is not None:
        row |= {
            f"width_{name}_m": float(getattr(gap, f"width_{name}")) for name in ("mouth", "root", "narrowest")
        }
        row |= {"area_m2": float(gap.area), "angle_rad": float(gap.angle)}
        row |= {f"origin_{axis}_m": float(x) for axis, x in zip("xyz", gap.origin_world, strict=True)}
        if gap.sigma is not None:
            for name, unit in (("x", "m"), ("y", "m"), ("width", "m"), ("angle", "rad"), ("area", "m2")):
                row[f"sigma_{name}_{unit}"] = float(getattr(gap.sigma, name))
            for name in ("width_root", "width_narrowest"):
                row[f"sigma_{name}_m"] = float(getattr(gap.sigma, name))
        designed = _designed(station)
        row |= {"contact": gap.contact, "designed_width_mouth_m": float(designed["width"]["mouth"])}
        step = station.step
        if step is not None:
            row |= {"step_m": step.value, "designed_step_m": step.designed, "sigma_step_m": step.sigma}
    return row
