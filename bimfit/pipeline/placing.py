"""Where a scan lies: its file's coordinates carried to the model's, and what of it lies near the joints."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from bimfit.config import Config
from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.path import JointPath
from bimfit.geometry.pose import Array, rigid_inverse
from bimfit.pipeline.scan_file import load_pieces
from bimfit.pipeline.targets import match_reach
from bimfit.scan.boxes import Boxes
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import unit_taken
from bimfit.scan.formats.options import ANY, ReadOptions, unit_name
from bimfit.scan.formats.summary import seen_from
from bimfit.scan.nearby import Gatherer, Nearby, read_ahead
from bimfit.scan.trajectory import Trajectory

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint
    from bimfit.bim.model import Model
    from bimfit.registration.alignment import AlignConfig, Alignment

Scan = LineScan | PointCloud
Crs = Literal["auto", "project", "map"]
CRS: tuple[Crs, ...] = ("auto", "project", "map")
NEAR = 0.3
_PIECE = 0.5
_SLACK = 0.05
_OTHER_UNITS = (1e-3, 1e3, 1e-2, 1e2, 0.3048, 1.0 / 0.3048, 1200.0 / 3937.0)
_SMALLEST = 0.02


@dataclass(frozen=True)
class Placing:
    """What a user says of a scan file and of where it lies.

    Attributes
    ----------
    pose : ndarray, shape (4, 4), or None
        T_frame_scanner of a scan in scanner coordinates; the frame is the project's or the map's. With a
        trajectory T_body_scanner: how the scanner sits on the body that moves.
    trajectory : Trajectory or None
        T_frame_body while the scan was made.
    crs : {"auto", "project", "map"}
        Which of the two; auto looks in which one the scan shows joints.
    options : ReadOptions
        How to read the file.
    align : AlignConfig or None
        How far the scan may still be off; None takes it to be in place.
    """

    pose: Array | None = None
    trajectory: Trajectory | None = None
    crs: Crs = "auto"
    options: ReadOptions = ANY
    align: AlignConfig | None = None


@dataclass(frozen=True)
class Placed:
    """A scan near the joints, in the model's coordinates.

    Attributes
    ----------
    nearby : Nearby
    crs : {"project", "map"}
        The frame that the scan was taken to be in.
    T_world_file : ndarray, shape (4, 4)
        What carried the file's coordinates (m), or those of the trajectory's frame, to the model's: a rigid
        motion times the map's scale.
    notes : tuple of str
    alignment : Alignment or None
        What the scan was then moved by, where that was asked for; ``T_world_file`` includes it.
    """

    nearby: Nearby
    crs: str
    T_world_file: Array
    notes: tuple[str, ...] = ()
    alignment: Alignment | None = None


def joint_boxes(joint: Joint, config: Config, margin: float = 0.0) -> Boxes:
    """Boxes along a joint that hold whatever of a scan its coverage, stations and slices depend on.

    Parameters
    ----------
    joint : Joint
    config : Config
    margin : float
        How much farther they reach, m.
    """
    reach = math.sqrt(2.0) * max(NEAR, match_reach(config)) + joint.depth + _SLACK + margin
    reach += 0.5 * (config.slices.thickness or 0.0)
    return path_boxes(joint.path, reach)


def path_boxes(path: JointPath, reach: float) -> Boxes:
    """Boxes around pieces of a path, at most half a metre each, that reach so far (m) beyond it."""
    boxes = []
    for a, b in zip(path.points[:-1], path.points[1:], strict=True):
        count = max(1, math.ceil(float(np.linalg.norm(b - a)) / _PIECE))
        stops = a + (b - a) * np.linspace(0.0, 1.0, count + 1)[:, None]
        boxes.append(np.stack([stops[:-1], stops[1:]], axis=1))
    return Boxes.of(np.concatenate(boxes)).grown(reach)


def place_scan(
    path: Path,
    model: Model,
    joints: Sequence[Joint],
    config: Config,
    placing: Placing,
    margin: float = 0.0,
) -> Placed:
    """Read a scan once, a piece at a time, and keep what lies near the joints, or ``margin`` (m) farther.

    Raises
    ------
    ScanError
        When it cannot be read, or nothing of it lies near a joint: then with what would help.
    """
    frames = _frames(model, placing)
    places = Boxes.of(np.concatenate([joint_boxes(joint, config, margin).array for joint in joints]))
    still = np.eye(4) if placing.pose is None or placing.trajectory is not None else placing.pose
    moves = {name: T @ still for name, T in frames.items()}
    gatherers = {name: Gatherer(places) for name in moves}
    own = {name: places.moved(similarity_inverse(T)) for name, T in moves.items()}
    wanted = Boxes(np.concatenate([boxes.array for boxes in own.values()]))
    for piece in _pieces(path, placing, wanted):
        for name, T in moves.items():
            _show(gatherers[name], piece, T, own[name])
    found = {name: gatherer.done() for name, gatherer in gatherers.items()}
    counts = {name: nearby.returns for name, nearby in found.items()}
    best = max(counts, key=lambda name: counts[name])
    if not counts[best]:
        raise _nothing_near(path, model, places, moves, placing)
    note = _choice_note(best, counts, model)
    notes = (*found[best].scan.notes, what_is_near(found[best]), *([note] if note else []))
    return Placed(found[best], best, moves[best], notes)


def what_is_near(nearby: Nearby) -> str:
    """What a scan shows near the joints, in a line that a user can check."""
    if isinstance(nearby.scan, LineScan):
        beams, sweeps = len(nearby.scan), len(nearby.scan.sweeps)
        near = f"{nearby.returns:,} of their returns near the joints"
        return f"{beams:,} beams in {sweeps:,} sweeps, {near}, {seen_from(nearby.scan.origins)}"
    low, high = nearby.scan.bounds
    corners = " to ".join("(" + ", ".join(f"{x:.10g}" for x in np.round(c, 4)) + ")" for c in (low, high))
    eyes = [eye for _, eye in nearby.eyes if eye is not None]
    places = seen_from(np.array(eyes) if eyes else None)
    return f"{len(nearby.scan):,} points near the joints, from {corners} m, {places}"


def moved(scan: Scan, T: Array) -> Scan:
    """A scan carried by a 4 x 4 matrix that turns, shifts and scales."""
    from bimfit.scan.formats import scaled

    scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
    if abs(scale - 1.0) < 1e-12:
        return scan.transformed(T)
    rigid = np.array(T)
    rigid[:3, :3] /= scale
    return scaled(scan, scale).transformed(rigid)


def _frames(model: Model, placing: Placing) -> dict[str, Array]:
    """What carries each frame that comes into question to the project's."""
    place = model.georeference
    if placing.crs == "map" and place is None:
        raise ScanError(
            "--scan-crs map needs a model with a map conversion, and this one has none",
            file=model.path,
            remedy="leave it out, or give --scan-pose",
        )
    out = {} if placing.crs == "map" else {"project": np.eye(4)}
    if place is not None and placing.crs != "project":
        out["map"] = similarity_inverse(place.T_map_project)
    return out


def similarity_inverse(T: Array) -> Array:
    """Inverse of a 4 x 4 matrix that turns, shifts and scales."""
    scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
    rigid = np.array(T)
    rigid[:3, :3] /= scale
    out = rigid_inverse(rigid)
    out[:3] /= scale
    return out


def _pieces(path: Path, placing: Placing, boxes: Boxes | None) -> Iterator[Scan]:
    boxes = None if placing.trajectory is not None else boxes
    options = replace(placing.options, boxes=None if boxes is None else boxes.array)
    for piece in read_ahead(load_pieces(path, options)):
        if placing.trajectory is not None:
            yield _along(path, piece, placing.trajectory, placing.pose)
        else:
            yield piece


def _along(path: Path, piece: Scan, trajectory: Trajectory, mount: Array | None) -> LineScan:
    if isinstance(piece, PointCloud):
        raise ScanError(
            "a trajectory needs beams with times, and this is a cloud of points",
            file=path,
            remedy="give a line scan with a column time",
        )
    return trajectory.carry(piece if mount is None else piece.transformed(mount))


def _show(gatherer: Gatherer, piece: Scan, T: Array, own: Boxes) -> None:
    """Show a piece to whoever gathers, carried by T; of a cloud only the bare points that lie in ``own``."""
    if isinstance(piece, LineScan):
        gatherer.add(piece if np.array_equal(T, np.eye(4)) else moved(piece, T))
        return
    index, _ = own.find(*piece.points.T)
    points = piece.points[index]
    part = PointCloud(points, piece.viewpoint, source=piece.source, notes=piece.notes)
    if np.array_equal(T, np.eye(4)):
        gatherer.add(part)
    else:
        gatherer.add(moved(part, T), points)


def _choice_note(best: str, counts: dict[str, int], model: Model) -> str:
    place = model.georeference
    if place is None:
        return ""
    where = f"map coordinates ({place.crs or place.source})" if best == "map" else "project coordinates"
    others = [name for name in counts if name != best]
    if not others:
        return f"the scan was taken to be in {where}, as asked"
    share = ", ".join(f"{counts[name]:,} in {name} coordinates" for name in counts)
    return f"the scan was taken to be in {where}: of its returns lie near the joints {share}"


# -- why nothing was found ---------------------------------------------------------------------------


def _nothing_near(
    path: Path, model: Model, places: Boxes, moves: dict[str, Array], placing: Placing
) -> ScanError:
    """Look once more, at everything: how far it is, and whether another unit would bring it to the joints."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    tries = [(f, name, _other_unit(places, T, f)) for f in _OTHER_UNITS for name, T in moves.items()]
    hits = np.zeros(len(tries), np.int64)
    total = 0
    for piece in _pieces(path, placing, None):
        points = piece.points if isinstance(piece, PointCloud) else piece.hits
        total += len(points)
        if len(points):
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
        hits += [int(np.count_nonzero(boxes.inside(points))) for _, _, boxes in tries]
    if not total:
        return ScanError("the scan holds no return", file=path)
    extent = float(np.linalg.norm(high - low))
    good = [k for k in np.argsort(-hits, kind="stable") if hits[k] and extent * tries[k][0] > _SMALLEST]
    if good:
        factor, name, _ = tries[good[0]]
        return _unit_error(path, model, factor, name, placing)
    bounds = np.stack([low, high])
    apart = {name: _apart(model.bounds, Boxes.of(bounds[None]).moved(T).bounds) for name, T in moves.items()}
    name = min(apart, key=lambda name: apart[name])
    frames = f" in {name} coordinates" if model.georeference is not None else ""
    reason = (
        f"the scan is far from the model: {apart[name]:.3g} m lie between them{frames}"
        if apart[name] > NEAR
        else "the scan shows none of the joints"
    )
    return ScanError(
        reason,
        file=path,
        remedy=(
            f"leave out --scan-crs {placing.crs}, or check its units and its frame"
            if placing.crs != "auto"
            else "check its units and its frame; --scan-pose places a scan that is in scanner coordinates"
        ),
    )


def _other_unit(places: Boxes, T: Array, factor: float) -> Boxes:
    """The places in a file whose lengths are to be multiplied by ``factor``."""
    return places.moved(similarity_inverse(T)).scaled(1.0 / factor)


def _unit_error(path: Path, model: Model, factor: float, name: str, placing: Placing) -> ScanError:
    unit = unit_name(unit_taken(path, placing.options) * factor)
    frame = f", in {name} coordinates" if model.georeference is not None else ""
    if any("is its unit" in note for note in model.notes):
        return ScanError(
            f"the model's lengths do not fit the scan's: they would if the model were {1.0 / factor:g}"
            f" times as large{frame}; its own size speaks for a wrong length unit in the model",
            file=model.path,
            remedy="correct the model's length unit",
        )
    return ScanError(
        f"the scan shows the joints only if its lengths are {unit}{frame}",
        file=path,
        remedy=f"give --scan-unit {_unit_word(unit)}"
        if _unit_word(unit)
        else "check the units of both files",
    )


def _unit_word(name: str) -> str:
    from bimfit.scan.formats.options import UNITS

    return next((word for word, size in UNITS.items() if unit_name(size) == name), "")


def _apart(a: Array, b: Array) -> float:
    """Distance between two boxes (2, 3) each, m."""
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(a[0] - b[1], b[0] - a[1]))))
