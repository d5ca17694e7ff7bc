"""bench(): results written back into models: valid, whole, and not taken for building when read again."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bimfit.bim.as_built import GAP_CLASS, GAP_TYPE
from bimfit.bim.model import load_model
from bimfit.bim.opening import open_ifc
from bimfit.bim.selection import Selection, choose_joints
from bimfit.bim.validation import lost_ids, new_messages
from bimfit.config import Config
from bimfit.errors import BimfitError
from bimfit.pipeline.as_built import moved_elements, write_model
from bimfit.pipeline.bench_bim import SAMPLES, real_models
from bimfit.pipeline.samples import sample_model
from bimfit.pipeline.simulate import simulate
from bimfit.pipeline.survey import survey
from bimfit.scan.formats import write_scan
from bimfit.simulation.scenario import Scenario

OTHERS = ("square-butt-ifc2x3", "square-butt-ifc4x3")
MOST_JOINTS, SPACING = 3, 0.2
Progress = Callable[[str, float], None]


def bench_back(_joints: int, seed: int, progress: Progress) -> tuple[str, dict[str, Any]]:
    """Simulate and fit a few joints of every sample and real model, write them back, and check the files."""
    models = [sample_model(f"{name}.ifc") for name in (*SAMPLES, *OTHERS)] + list(real_models())
    rows = []
    for k, path in enumerate(models):
        progress(path.stem, k / len(models))
        with tempfile.TemporaryDirectory(prefix="bimfit-") as folder:
            rows.append(_row(path, seed, Path(folder)))
    head = f"{'model':34}{'joints':>7}{'gaps':>6}{'moved':>7}{'new messages':>14}"
    head += f"{'lost ids':>10}{'taken':>7}{'s':>7}"
    lines = [
        f"{row['model']:34}{row['joints']:7d}{row['gaps']:6d}{row['moved']:7d}{row['messages']:14d}"
        f"{row['lost']:10d}{row['taken']:7d}{row['seconds']:7.1f}"
        for row in rows
    ]
    told = (
        "as-built.ifc with gaps and moved elements against the model it was made from: messages of "
        "ifcopenshell's validator that the model did not give, GlobalIds lost, and gap elements that a "
        "second run takes for elements of the building"
    )
    return "\n".join([head, *lines, told]), {"rows": rows}


def _row(path: Path, seed: int, folder: Path) -> dict[str, Any]:
    begin = time.perf_counter()
    names = _spread(path)
    scan_path = folder / "scan.npz"
    scan, chosen = None, names
    while scan is None and chosen:
        try:
            scan, _ = simulate(path, Scenario(spacing=SPACING), seed, joints=chosen)
        except BimfitError:  # a joint that no sensor can look into
            chosen = chosen[:-1]
    row: dict[str, Any] = {"model": path.stem, "joints": len(chosen)}
    if scan is None:
        return {**row, "gaps": 0, "moved": 0, "messages": 0, "lost": 0, "taken": 0, "seconds": 0.0}
    write_scan(scan, scan_path)
    result = survey(path, scan_path, Config(), joints=chosen)
    output = write_model(result, folder, move_elements=True)
    made = {e.GlobalId for e in open_ifc(output).by_type(GAP_CLASS) if e.ObjectType == GAP_TYPE}
    again = {element.guid for element in load_model(output, cache=False).elements}
    moved = moved_elements(result.joints)
    return {
        **row,
        "gaps": len(made),
        "moved": len(moved),
        "messages": len(new_messages(path, output)),
        "lost": len(lost_ids(path, output)),
        "taken": len(made & again),
        "seconds": time.perf_counter() - begin,
    }


def _spread(path: Path) -> list[str]:
    """Ids of the longest joint, and of two along the list of lengths; open ones where there are any."""
    joints = choose_joints(load_model(path), Selection())
    usable = [joint for joint in joints if joint.state == "open"] or list(joints)
    ordered = sorted(usable, key=lambda joint: (-joint.length, joint.id))
    picks = np.unique(np.linspace(0, len(ordered) // 2, MOST_JOINTS).astype(int))
    return [ordered[k].id for k in picks]
