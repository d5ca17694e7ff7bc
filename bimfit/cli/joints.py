"""``bimfit joints``: what joints a model has."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bimfit.cli.choosing import choosing
from bimfit.cli.options import joint_config

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint
    from bimfit.bim.model import Model
    from bimfit.bim.selection import Selection


@choosing
def run(
    choice: Selection,
    model: Path = typer.Argument(..., metavar="MODEL.ifc", help="The building model."),
    as_json: bool = typer.Option(False, "--json", help="Print an array of objects instead of a table."),
    max_gap: str | None = typer.Option(
        None, "--max-gap", help="How far apart the finder looks, such as 60mm; as --width ..60mm."
    ),
) -> int:
    """List the joints of a model; what was left out of it is named on standard error."""
    from bimfit.pipeline.listing import model_joints

    building, joints = model_joints(model, joint_config(max_gap), choice)
    if as_json:
        names = {element.guid: element.name for element in building.elements}
        print(json.dumps([_plain(joint, names) for joint in joints], indent=1, ensure_ascii=False))
    else:
        print("\n".join(_table(building, joints)))
    _tell_notes(building)
    return 0


def _plain(joint: Joint, names: dict[str, str]) -> dict[str, Any]:
    """The joint as plain values, with the names that the model gives its elements."""
    filler = names.get(joint.filler) if joint.filler else None
    return {**joint.to_dict(), "names": [names.get(guid) for guid in joint.elements], "filler_name": filler}


def _table(model: Model, joints: tuple[Joint, ...]) -> list[str]:
    names = {element.guid: element.name for element in model.elements}

    def named(guid: str) -> str:
        return f"{guid} {names.get(guid, '')}".rstrip()

    lines = [f"{'id':8} {'kind':12} {'state':6} {'mouth':5} {'width mm':>8} {'length mm':>9}  elements"]
    for joint in joints:
        filler = f"; filled with {named(joint.filler)}" if joint.filler else ""
        mouth = "both" if joint.two_sided else "one" if joint.accessible else "none"
        lines.append(
            f"{joint.id:8} {joint.kind:12} {joint.state:6} {mouth:5} {joint.width * 1e3:8.1f} "
            f"{joint.length * 1e3:9.0f}  {'  '.join(map(named, joint.elements))}{filler}"
        )
    counts = {state: sum(joint.state == state for joint in joints) for state in joint_states(joints)}
    told = ", ".join(f"{count} {_STATES[state]}" for state, count in counts.items())
    return [
        *lines,
        f"{len(joints)} joint{'s' if len(joints) != 1 else ''} in {len(model.elements)} elements: {told}",
    ]


_STATES = {"open": "open", "filled": "filled", "touch": "touching", "clash": "overlapping (clash)"}


def joint_states(joints: tuple[Joint, ...]) -> list[str]:
    """The states that occur, in the order of the list."""
    return [state for state in _STATES if any(joint.state == state for joint in joints)]


def _tell_notes(model: Model) -> None:
    """Say on standard error how the file was read, and what was left out of it."""
    for note in (*model.notes, *model.left_out()):
        print(f"bimfit: note: {note}", file=sys.stderr)
