"""The as-built gaps written back into the building model."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bimfit.bim.as_built import AsBuiltGap, MovedElement, write_as_built
from bimfit.errors import BimfitError
from bimfit.estimation.element_motion import Seen, element_motion
from bimfit.pipeline.document import TRUSTED, closest
from bimfit.pipeline.records import JointResult, SurveyResult

NAME = "as-built.ifc"


def write_model(survey: SurveyResult, folder: Path, *, move_elements: bool = False) -> Path:
    """Write the survey's model with a virtual element for each joint into ``folder``.

    Parameters
    ----------
    survey : SurveyResult
    folder : Path
    move_elements : bool
        Whether the joints' components are moved to where they are.

    Raises
    ------
    BimfitError
        When the model cannot be written back, or the file cannot be written.
    """
    gaps = [as_built_gap(joint) for joint in survey.joints]
    moved = moved_elements(survey.joints) if move_elements else {}
    return write_as_built(survey.model, gaps, folder / NAME, moved=moved)


def moved_elements(joints: Sequence[JointResult]) -> dict[str, MovedElement]:
    """For each component the one rigid motion that fits all stations of all its joints."""
    seen: dict[str, list[Seen]] = {}
    for joint in joints:
        for station in joint.stations:
            if station.status.name not in TRUSTED:
                continue
            for part in station.components:
                if part.pose is not None:
                    one = Seen(station.section.frame, part.pose, part.covariance)
                    seen.setdefault(part.element, []).append(one)
    out = {}
    for guid, all_seen in sorted(seen.items()):
        found = element_motion(all_seen)
        out[guid] = MovedElement(found.T_world, found.stations, found.rms, found.undetermined)
    return out


def try_write_model(
    survey: SurveyResult, folder: Path, *, move_elements: bool = False
) -> tuple[Path | None, tuple[str, ...]]:
    """Write the as-built model, or say why that cannot be; the other results stand either way."""
    try:
        return write_model(survey, folder, move_elements=move_elements), ()
    except BimfitError as error:
        return None, (f"no {NAME}: {error}",)


def as_built_gap(result: JointResult) -> AsBuiltGap:
    """A joint's figures in plain values; None where nothing was measured."""
    joint = result.joint
    first, second = sorted(joint.elements)
    trusted = [station for station in result.stations if station.status.name in TRUSTED]
    gaps = [station.gap for station in trusted if station.gap is not None]
    nothing = AsBuiltGap(
        id=joint.id,
        kind=joint.kind,
        elements=(first, second),
        status="not estimated",
        designed_width=joint.width,
        reason=result.reason or (f"none of {len(result.stations)} stations is trusted" if not gaps else ""),
        stations=len(result.stations),
        measured=len(gaps),
    )
    if not gaps:
        return nothing
    widths = np.array([gap.width_mouth for gap in gaps])
    sigmas = np.array([gap.sigma.width for gap in gaps if gap.sigma is not None])
    volumes = result.volumes
    flagged = sum(station.status.name != "ok" for station in result.stations)
    return dataclasses.replace(
        nothing,
        status="ok" if not flagged else "flagged",
        reason=""
        if not flagged
        else f"{flagged} of {len(result.stations)} stations are not ok; see results.json",
        contact=closest(station.nearness for station in trusted),
        width_min=float(widths.min()),
        width_mean=float(widths.mean()),
        width_max=float(widths.max()),
        width_sigma=float(np.sqrt(np.mean(sigmas**2))) if len(sigmas) else None,
        length=joint.length,
        area=float(np.mean([gap.area for gap in gaps])),
        volume=None if volumes is None else volumes.mesh,
        volume_sigma=None if volumes is None else volumes.sigma,
        mesh=None if result.mesh is None else result.mesh.triangles,
    )
