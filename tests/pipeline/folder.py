"""Results folders as bimfit fit writes them, made without fitting anything."""

from __future__ import annotations

import json
import math
from pathlib import Path

ELEMENTS = ("0DxgvzF$LNHwSJzkjceeZ$", "0_DIpo1crRbeCFy2twdoOp")


def station(s, width, *, step=0.0, status="ok", reason="", sigma=0.0002, origin=(0.0, 0.0, 0.0)):
    """A station on a joint along world x, its mouth towards +z; no gap where ``width`` is None."""
    place = [origin[0] + s, origin[1], origin[2]]
    gap = None
    if width is not None:
        a, b = place[1] - width / 2, place[1] + width / 2
        polygon = [[place[0], y, z] for y, z in ((a, 0), (a, -0.02), (b, -0.02), (b, 0))]
        gap = {
            "origin": place, "angle": 0.0, "area": 0.02 * width, "overlap": 0.0,
            "width": {"mouth": width, "root": width + 0.001, "narrowest": width - 0.001},
            "polygon": [[x, y, z + origin[2]] for x, y, z in polygon],
            "contact": "clearance" if width > 0.001 else "overlap", "step": step,
            "designed": {
                "width": dict.fromkeys(("mouth", "root", "narrowest"), 0.02), "area": 4e-4, "step": 0.0,
            },
            "sigma": {
                "x": 1e-4, "y": 1e-4, "angle": 1e-3, "width": sigma, "area": 1e-6,
                "root": sigma, "narrowest": sigma, "step": sigma,
            },
        }  # fmt: skip
    return {
        "s": s, "status": status, "reason": reason, "points": 40, "combined": None, "components": [],
        "gap": gap, "frame": {"origin": place, "u": [0, 1, 0], "v": [0, 0, 1], "n": [1, 0, 0]},
        "seconds": 0.01,
    }  # fmt: skip


def joint(name, stations, *, volume=None, names=("Panel 1", "Panel 2"), origin=(0.0, 0.0, 0.0), reason=""):
    return {
        "id": name, "elements": list(ELEMENTS), "kind": "square-butt", "state": "open",
        "designed": {"width": 0.02, "length": 1.0, "depth": 0.02, "width_min": 0.02, "width_max": 0.02},
        "names": list(names), "classes": ["IfcWall", "IfcWall"], "storeys": ["Storey 1", "Storey 1"],
        "path": {"points": [origin, (origin[0] + 1.0, *origin[1:])], "u": [[0, 1, 0]], "v": [[0, 0, 1]]},
        "motion": "rigid", "status": "ok", "reason": reason, "stations": stations, "length": 1.0,
        "mesh": None,
        "volume": None if volume is None else {"slices": volume, "mesh": volume, "sigma": 0.01 * volume},
    }  # fmt: skip


def document(joints, model="model.ifc"):
    return {
        "schema": 1, "bimfit": "0.1", "model": str(model), "scan": "scan.csv", "notes": ["a note"],
        "units": {"length": "m", "angle": "rad"}, "joints": joints,
    }  # fmt: skip


def write_folder(folder: Path, joints, model="model.ifc") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(json.dumps(document(joints, model)), encoding="utf-8")
    return folder


def sample_joints(origin=(0.0, 0.0, 0.0)):
    """One that passes 12..30mm, one too wide, one with a step, one unmeasured, one that the scan misses."""
    s = [0.1 * k for k in range(11)]
    good = [station(x, 0.02 + 0.002 * math.sin(6 * x), origin=origin) for x in s]
    wide = [station(x, 0.02 + 0.014 * x, origin=origin) for x in s]
    steps = [station(x, 0.02, step=0.004 if k == 4 else 0.001, origin=origin) for k, x in enumerate(s)]
    lost = [station(x, None, status="no_data", reason="no returns near the joint", origin=origin) for x in s]
    return [
        joint("good", good, volume=4e-4, origin=origin),
        joint("wide", wide, volume=5e-4, origin=origin),
        joint("steps", steps, volume=4e-4, names=("=HYPERLINK(1)", "Größe 2"), origin=origin),
        joint("lost", lost, origin=origin, reason="no returns near the joint"),
        joint("unseen", [], origin=origin, reason="the scan shows no station of it"),
    ]
