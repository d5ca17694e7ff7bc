"""Align a scan that is nearly in place with the surroundings of the joints that it shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bimfit.config import Config
from bimfit.errors import ScanError
from bimfit.geometry.mesh import TriangleMesh
from bimfit.pipeline.placing import Placed, joint_boxes, path_boxes, what_is_near
from bimfit.registration.alignment import AlignConfig, Alignment, align_scan
from bimfit.scan.boxes import Boxes
from bimfit.scan.cloud import PointCloud
from bimfit.scan.nearby import Gatherer

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint
    from bimfit.bim.model import Model

SURROUNDINGS = 0.3
"""How far from the joints the model is matched, m."""


def reach_of(config: AlignConfig, joints: Sequence[Joint]) -> float:
    """How far (m) a scan's point near the joints may be from where it belongs."""
    corners = np.concatenate([joint.path.points for joint in joints])
    half = 0.5 * float(np.linalg.norm(np.ptp(corners, axis=0))) + SURROUNDINGS
    return math.sqrt(3.0) * (config.shift + 2.0 * math.sin(0.5 * config.turn) * half)


def aligned(
    placed: Placed, model: Model, joints: Sequence[Joint], config: Config, align: AlignConfig
) -> Placed:
    """The scan carried to where it fits the model near these joints best, with the certificate.

    Parameters
    ----------
    placed : Placed
        Gathered with boxes that reach :func:`reach_of` farther.
    model : Model
    joints : sequence of Joint
        Those that the scan shows.
    config : Config
    align : AlignConfig

    Raises
    ------
    ScanError
        When it cannot be aligned safely.
    """
    scan = placed.nearby.scan
    around = Boxes(np.concatenate([path_boxes(j.path, 0.5 * j.depth + SURROUNDINGS).array for j in joints]))
    wide = around.grown(reach_of(align, joints))
    points = scan.points if isinstance(scan, PointCloud) else scan.hits
    eye = scan.viewpoint if isinstance(scan, PointCloud) else None
    if not isinstance(scan, PointCloud):
        near = scan.returned & wide.inside(
            scan.origins + scan.directions * np.nan_to_num(scan.ranges)[:, None]
        )
        eye = scan.origins[near].mean(axis=0) if near.any() else None
    directions = [direction for joint in joints for direction in joint.path.leg_directions]
    blur = max(align.blur, math.hypot(2.0 * config.sensor.sigma, config.fit.placement_sigma))
    found = align_scan(
        _mesh_near(model, around),
        around.array,
        points[wide.inside(points)],
        directions,
        replace(align, blur=blur),
        eye,
    )
    places = Boxes(np.concatenate([joint_boxes(joint, config).array for joint in joints]))
    gatherer = Gatherer(places)
    gatherer.add(scan.transformed(found.T_model_scan))
    nearby = gatherer.done()
    notes = tuple(note for note in placed.notes if note != what_is_near(placed.nearby))
    if found.held:
        open_ = ", ".join(found.held)
        notes = (*notes, f"aligned but for the {open_}: along the joint nothing shows where the scan lies")
    return replace(
        placed,
        nearby=nearby,
        T_world_file=found.T_model_scan @ placed.T_world_file,
        notes=(*notes, what_is_near(nearby)),
        alignment=found,
    )


def describe_alignment(found: Alignment) -> str:
    """One line on an alignment and its certificate, for the terminal."""
    r = found.result
    share = r.gap / max(r.score, 1e-300)
    return (
        f"aligned: moved {1e3 * found.moved:.1f} mm, turned {math.degrees(found.turned):.2f} deg; "
        f"score {r.score:.1f} of {found.points}, bound {r.bound:.1f} (gap {share:.1%}), {r.evaluations:,} "
        f"evaluations, {r.stop}, {r.seconds:.1f} s"
    )


def alignment_to_dict(found: Alignment) -> dict[str, Any]:
    """An alignment in plain values for results.json."""
    r = found.result
    return {
        "transform": found.T_model_scan.ravel(),
        "moved": found.moved,
        "turned": found.turned,
        "window": {"shift": found.config.shift, "turn": found.config.turn},
        "points": found.points,
        "score": r.score,
        "bound": r.bound,
        "gap": r.gap,
        "evaluations": r.evaluations,
        "levels": list(r.levels),
        "stop": r.stop,
        "status": r.status.name,
        "reason": r.status.reason,
        "held": list(found.held),
        "fitness": r.fitness,
        "inlier_rmse": r.inlier_rmse,
        "seconds": r.seconds,
    }


def _mesh_near(model: Model, around: Boxes) -> TriangleMesh:
    """All elements that reach into the surroundings, as one mesh."""
    meshes = [e.mesh for e in model.elements if around.meets(*e.mesh.bounds[:, None])[0]]
    if not meshes:
        raise ScanError("cannot be aligned: no element is near the joints", file=model.path)
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return TriangleMesh.of(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
    )
