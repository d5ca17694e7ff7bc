"""What is true of a simulated joint, and its file: the same shape as results.json."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bimfit import __version__
from bimfit.errors import BimfitError, ConfigError
from bimfit.files import write_text
from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D, wrap_angle
from bimfit.geometry.profile import signed_area


@dataclass(frozen=True)
class GapTruth:
    """The gap at one station as it really is.

    Attributes
    ----------
    origin : ndarray, shape (3,)
        Midway between the moved mouth corners, world, m.
    angle : float
        Of the line through them, less its designed angle, rad; NaN where the corners coincide.
    width_mouth, width_root, width_narrowest : float
        m.
    area : float
        Of the polygon between the moved sides, m^2; negative where they have passed through one another.
    polygon : ndarray, shape (k, 3)
        That polygon: A's side from mouth to root, then B's from root to mouth; world, m.
    """

    origin: Array
    angle: float
    width_mouth: float
    width_root: float
    width_narrowest: float
    area: float
    polygon: Array


@dataclass(frozen=True)
class StationTruth:
    """One station: the poses of both components (as built = pose * designed, in ``frame``) and the gap.

    ``common`` is the part of the motion that both share; None where it is not known.
    """

    s: float
    frame: SectionFrame
    common: Pose2D | None
    components: tuple[Pose2D, Pose2D]
    gap: GapTruth


@dataclass(frozen=True)
class JointTruth:
    """A whole joint as it really is.

    Attributes
    ----------
    id : str
    elements : tuple of 2 str
        GlobalIds of A and B.
    kind : str
    width : float
        Designed distance of the mouth corners, m.
    length : float
        From the first station to the last, m.
    stations : tuple of StationTruth
    seed : int or None
        What it was drawn with.
    """

    id: str
    elements: tuple[str, str]
    kind: str
    width: float
    length: float
    stations: tuple[StationTruth, ...]
    seed: int | None = None


def gap_truth(section: JointSection, pose_a: Pose2D, pose_b: Pose2D) -> GapTruth:
    """The gap between components that moved by ``pose_a`` and ``pose_b``.

    Origin, angle and area as METHOD section 1 defines them; exact, by moving the designed outline.
    """
    import shapely

    side_a, side_b = pose_a.apply(section.gap.side_a), pose_b.apply(section.gap.side_b)
    polygon = np.concatenate([side_a, side_b[::-1]])
    designed = np.concatenate([section.gap.side_a, section.gap.side_b[::-1]])
    # The designed winding says which sign an open gap has; both are known to be open where they have an area.
    sense = -1.0 if signed_area(designed) < 0.0 else 1.0
    narrowest = shapely.distance(shapely.linestrings(side_a), shapely.linestrings(side_b))
    return GapTruth(
        origin=section.frame.to_world(0.5 * (side_a[0] + side_b[0])),
        angle=_turn(section.gap.side_b[0] - section.gap.side_a[0], side_b[0] - side_a[0]),
        width_mouth=float(np.linalg.norm(side_b[0] - side_a[0])),
        width_root=float(np.linalg.norm(side_b[-1] - side_a[-1])),
        width_narrowest=float(narrowest),
        area=sense * signed_area(polygon),
        polygon=section.frame.to_world(polygon),
    )


def _turn(before: Array, after: Array) -> float:
    if min(np.linalg.norm(before), np.linalg.norm(after)) < 1e-9:
        return math.nan
    return wrap_angle(math.atan2(after[1], after[0]) - math.atan2(before[1], before[0]))


# -- file ------------------------------------------------------------------------------------------


def write_truth(
    truths: Sequence[JointTruth], path: str | Path, *, model: object = "", scan: object = ""
) -> None:
    """Write joints as a truth file, whole or not at all.

    Raises
    ------
    ExportError
        When it cannot be written.
    """
    value = {
        "schema": 1,
        "bimfit": __version__,
        "model": str(model),
        "scan": str(scan),
        "truth": True,
        "units": {"length": "m", "angle": "rad"},
        "joints": [_joint_to_dict(truth) for truth in truths],
    }
    write_text(path, json.dumps(_known(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_truth(path: str | Path) -> tuple[JointTruth, ...]:
    """Read a truth file, or the results of a fit as if they were the truth.

    Stations without poses of both components or without a gap are left out.

    Raises
    ------
    ConfigError
        When it cannot be read or is not such a file.
    """
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", file=path) from error
    except ValueError as error:
        raise ConfigError(f"not JSON: {error}", file=path) from error
    if not isinstance(value, dict) or value.get("schema") != 1 or not isinstance(value.get("joints"), list):
        raise ConfigError("not a truth file", file=path, remedy="bimfit simulate --truth writes one")
    truths = []
    for k, joint in enumerate(value["joints"]):
        try:
            truths.append(_joint_from_dict(joint))
        except BimfitError:
            raise
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ConfigError(f"not a truth file: {error!r}", file=path, place=f"joint {k + 1}") from error
    return tuple(truths)


def _joint_to_dict(truth: JointTruth) -> dict[str, Any]:
    return {
        "id": truth.id,
        "elements": list(truth.elements),
        "kind": truth.kind,
        "designed": {"width": truth.width, "length": truth.length},
        "seed": truth.seed,
        "stations": [_station_to_dict(station, truth.elements) for station in truth.stations],
        "length": truth.length,
    }


def _station_to_dict(station: StationTruth, elements: tuple[str, str]) -> dict[str, Any]:
    frame, gap = station.frame, station.gap
    return {
        "s": station.s,
        "frame": {axis: getattr(frame, axis) for axis in ("origin", "u", "v", "n")},
        "status": "ok",
        "reason": "",
        "combined": None
        if station.common is None
        else {"transform": frame.lift(station.common).ravel(), "pose": station.common.as_array()},
        "components": [
            {"element": element, "transform": frame.lift(pose).ravel(), "pose": pose.as_array()}
            for element, pose in zip(elements, station.components, strict=True)
        ],
        "gap": {
            "origin": gap.origin,
            "angle": gap.angle,
            "width": {"mouth": gap.width_mouth, "root": gap.width_root, "narrowest": gap.width_narrowest},
            "area": gap.area,
            "polygon": gap.polygon,
        },
    }


def _joint_from_dict(joint: Mapping[str, Any]) -> JointTruth:
    first, second = joint["elements"]
    stations = tuple(
        _station_from_dict(station)
        for station in joint["stations"]
        if station["gap"] is not None and all(c["pose"] is not None for c in station["components"])
    )
    designed = joint["designed"]
    return JointTruth(
        str(joint["id"]),
        (str(first), str(second)),
        str(joint.get("kind", "")),
        _number(designed["width"]),
        _number(designed["length"]),
        stations,
        joint.get("seed"),
    )


def _station_from_dict(station: Mapping[str, Any]) -> StationTruth:
    frame = SectionFrame(*(_vector(station["frame"][axis]) for axis in ("origin", "u", "v", "n")))
    common = station.get("combined")
    a, b = (Pose2D.from_array(component["pose"]) for component in station["components"])
    gap = station["gap"]
    widths = gap["width"]
    return StationTruth(
        _number(station["s"]),
        frame,
        None if common is None or common.get("pose") is None else Pose2D.from_array(common["pose"]),
        (a, b),
        GapTruth(
            _vector(gap["origin"]),
            _number(gap["angle"]),
            _number(widths["mouth"]),
            _number(widths["root"]),
            _number(widths["narrowest"]),
            _number(gap["area"]),
            np.asarray(gap["polygon"], float).reshape(-1, 3),
        ),
    )


def _vector(values: Any) -> Array:
    out = np.asarray(values, float)
    if out.shape != (3,):
        raise ValueError(f"expected three numbers, got {values}")
    return out


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _known(value: Any) -> Any:
    """Plain JSON values in which what is not known is null."""
    if isinstance(value, Mapping):
        return {key: _known(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _known(value.tolist())
    if isinstance(value, list | tuple):
        return [_known(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
