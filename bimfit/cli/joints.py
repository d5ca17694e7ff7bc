"""``bimfit joints``: what joints a model has."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from bimfit.cli.options import joint_config


def run(
    model: Path = typer.Argument(..., metavar="MODEL.ifc", help="The building model."),
    as_json: bool = typer.Option(False, "--json", help="Print an array of objects instead of a table."),
    max_gap: str | None = typer.Option(None, "--max-gap", help="Widest gap, such as 60mm."),
    min_length: str | None = typer.Option(None, "--min-length", help="Shortest joint, such as 100mm."),
) -> int:
    """List the joints of a model."""
    from bimfit.pipeline.survey import model_joints

    building, joints = model_joints(model, joint_config(max_gap, min_length))
    if as_json:
        print(json.dumps([joint.to_dict() for joint in joints], indent=1, ensure_ascii=False))
        return 0
    names = {element.guid: element.name for element in building.elements}
    print(f"{'id':14} {'kind':12} {'width mm':>8} {'length mm':>9}  elements")
    for joint in joints:
        pair = "  ".join(f"{guid} {names.get(guid, '')}".rstrip() for guid in joint.elements)
        print(f"{joint.id:14} {joint.kind:12} {joint.width * 1e3:8.1f} {joint.length * 1e3:9.0f}  {pair}")
    print(f"{len(joints)} joints in {len(building.elements)} elements")
    return 0
