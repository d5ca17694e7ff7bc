"""bench(): the joint finder, the loader and the cache, on sample, real, generated and damaged models."""

from __future__ import annotations

import dataclasses
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import bimfit
from bimfit.bim.joints import find_joints
from bimfit.bim.loading import tessellate
from bimfit.bim.model import Element, Model, load_model, model_from_elements
from bimfit.bim.source import read_source
from bimfit.config import JointConfig
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.section import cut
from bimfit.pipeline.bench_fuzz import bench_fuzz
from bimfit.pipeline.joint_oracle import agreement
from bimfit.pipeline.samples import sample_model

MODELS = "BIMFIT_REAL_MODELS"
"""Environment variable that names the folder of the real models; else it is looked for beside the project."""
PAIRS = (
    ("XELLA-3e_verdieping", "0IjRD_pxn9aRaRUWq6Ebnq", "2geNRwqjn30uvGChtbfnYT", 3.0, 643.0),
    ("XELLA-3e_verdieping", "2Xvgd3_obAS9WBKxab2dfp", "18Su4zPSrECA7LPdeiBdes", 30.0, 2711.0),
    ("MULTICOM-banden", "1L6a$l0008y34qCZStEJCr", "1L6a$l00091J4qCZStEJCr", 10.0, 383.0),
    ("ROOT-kalkzandsteen", "3HGDkJWG95UBZE0EMTLl3$", "2qiB0g_bbDCwZnOTvTZQ6o", 30.0, 2884.0),
)
"""Verified pairs: model, two GlobalIds, gap and length in mm."""
JUDGED = ("XELLA-3e_verdieping", "MULTICOM-banden", "ROOT-kalkzandsteen")
SAMPLES = ("square-butt-ifc4", "v-groove", "lap", "t-joint", "mitre", "facade", "curved")
PANELS = (100, 1_000, 10_000, 40_000)
CACHED = "WILLEMSEN-Laagbouw"
FUZZED = 500
_SECTIONS = 100
_PANEL, _PITCH = (2.98, 0.14, 2.98), 3.0
_RUNS = 3

Progress = Callable[[str, float], None]
Rows = list[dict[str, Any]]


def bench_bim(_joints: int, seed: int, progress: Progress) -> tuple[str, dict[str, Any]]:
    """All tables of the suite, as text to print and as plain values."""
    blocks: list[str] = []
    data: dict[str, Any] = {}
    models = {path.stem: path for path in real_models()}
    if not models:
        blocks.append(f"no real models here: name their folder in {MODELS}; what needs them is left out")
    loaded = {name: load_model(path) for name, path in models.items()}
    steps: tuple[tuple[str, Callable[[], Rows]], ...] = (
        ("verified pairs", lambda: _pairs(loaded)),
        ("finder against brute force", lambda: _judged(loaded, seed)),
        ("time of the finder and of tessellation", lambda: _times(loaded)),
        ("sections of real elements", lambda: _sections(loaded, seed)),
        ("generated facades", _facades),
        ("first and second run of bimfit joints", lambda: _runs(models)),
    )
    for k, (title, step) in enumerate(steps):
        progress(title, k / (len(steps) + 1))
        rows = step()
        data[title] = rows
        blocks.append(f"{title}\n{_table(rows)}")
    text, cases = bench_fuzz(FUZZED, seed, lambda step, share: progress(step, 0.85 + 0.15 * share))
    blocks.append(f"mutated files\n{text}")
    return "\n\n".join(blocks), {**data, "fuzz": cases["cases"]}


def real_models() -> list[Path]:
    """The real models that are to be had, sorted by name."""
    source = Path(bimfit.__file__).resolve().parents[2]
    folder = Path(os.environ.get(MODELS) or source / "shared" / "data" / "ifc")
    return sorted(folder.glob("*.ifc"))


def _pairs(models: dict[str, Model]) -> Rows:
    rows = []
    for name, a, b, gap, length in PAIRS:
        if name not in models:
            continue
        guids = tuple(sorted((a, b)))
        some = [j for j in find_joints(models[name], JointConfig(everything=True)) if j.elements == guids]
        best = max((j for j in some if j.state == "open"), key=lambda j: j.length, default=None)
        row: dict[str, Any] = {"model": name, "pair": f"{a},{b}", "gap mm": gap, "length mm": length}
        row["found gap mm"] = None if best is None else round(best.width * 1e3, 2)
        row["found length mm"] = None if best is None else round(best.length * 1e3, 1)
        row["good"] = best is not None and bool(
            abs(best.width * 1e3 - gap) <= 0.2 and abs(best.length * 1e3 - length) <= 0.05 * length
        )
        rows.append(row)
    return rows


def _judged(models: dict[str, Model], seed: int) -> Rows:
    rows = []
    some = {name: load_model(sample_model(f"{name}.ifc")) for name in SAMPLES}
    some |= {name: models[name] for name in JUDGED if name in models}
    for name, model in some.items():
        found = agreement(model, seed)
        rows.append(
            {
                "model": name,
                "listed": found.listed,
                "precision %": round(100.0 * found.precision, 2),
                "clear": found.clear,
                "recall %": round(100.0 * found.recall, 2) if found.clear else None,
            }
        )
    return rows


def _times(models: dict[str, Model]) -> Rows:
    rows = []
    for name, model in models.items():
        raw = tessellate(read_source(model.path), None, 30.0)
        plain = dataclasses.replace(model, cached=False)
        find_joints(plain)  # imports what it needs
        times = [_timed(lambda: find_joints(plain))[0] for _ in range(_RUNS)]  # noqa: B023
        found = find_joints(plain)
        rows.append(
            {
                "model": name,
                "elements": len(model.elements),
                "joints": len(found),
                "tessellation s": round(raw.seconds, 3),
                "finder s": round(float(np.median(times)), 3),
                "ratio": round(float(np.median(times)) / max(raw.seconds, 1e-9), 3),
            }
        )
    return rows


def _sections(models: dict[str, Model], seed: int) -> Rows:
    rows = []
    rng = np.random.default_rng(seed)
    everywhere: list[float] = []
    for name, model in models.items():
        found = find_joints(model)
        times = []
        for k in rng.permutation(len(found))[:_SECTIONS].tolist():
            joint = found[k]
            frame = joint.path.rough_frame(float(rng.uniform(0.02, 0.98)) * joint.path.length)
            for guid in joint.elements:
                mesh = model.element(guid).mesh
                times.append(min(_timed(lambda: cut(mesh, frame))[0] for _ in range(2)))  # noqa: B023
        everywhere += times
        rows.append(_quantiles(name, times))
    return [*rows, _quantiles("all", everywhere)] if rows else rows


def _quantiles(name: str, times: Sequence[float]) -> dict[str, Any]:
    some = 1e3 * np.array(times)
    return {
        "model": name,
        "sections": len(some),
        "median ms": round(float(np.median(some)), 2),
        "95 % ms": round(float(np.quantile(some, 0.95)), 2),
        "longest ms": round(float(some.max()), 2),
        "over 1 ms": int((some > 1.0).sum()),
    }


def _facades() -> Rows:
    rows: Rows = []
    find_joints(facade(4)[0])
    for count in PANELS:
        model, expected = facade(count)
        seconds, found = _timed(lambda: find_joints(model))  # noqa: B023
        right = sum(abs(joint.width - (_PITCH - _PANEL[0])) < 1e-9 for joint in found)
        row: dict[str, Any] = {"panels": count, "joints": expected, "found": right, "s": round(seconds, 3)}
        if rows:
            before = rows[-1]
            row["growth"] = round(
                math.log(seconds / max(before["s"], 1e-3)) / math.log(count / before["panels"]), 2
            )
        rows.append({**row, "us a panel": round(1e6 * seconds / count, 1)})
    return rows


def facade(count: int) -> tuple[Model, int]:
    """So many panels 2.98 m square in a nearly square grid, 20 mm apart, and how many joints that makes."""
    columns = math.ceil(math.sqrt(count))
    corners = np.array([(x, y, z) for z in (0.0, 1.0) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])
    sides = [(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (0, 3, 2, 1), (4, 5, 6, 7)]
    faces = [corner for a, b, c, d in sides for corner in ((a, b, c), (a, c, d))]
    elements = []
    for k in range(count):
        row, column = divmod(k, columns)
        mesh = TriangleMesh.of(corners * _PANEL + (_PITCH * column, 0.0, _PITCH * row), faces)
        elements.append(Element(f"{k:022d}", f"Panel {k}", "IfcWall", mesh))
    in_rows = [min(columns, count - k) for k in range(0, count, columns)]
    return model_from_elements(elements), sum(in_rows) - len(in_rows) + sum(in_rows[1:])


def _runs(models: dict[str, Path]) -> Rows:
    """Whole processes, with an empty cache and with what the run before left in it."""
    if CACHED not in models:
        return []
    with tempfile.TemporaryDirectory(prefix="bimfit-cache-") as folder:
        _run(models[CACHED], folder, "--version")  # the interpreter's own files are read once before
        times = [_run(models[CACHED], folder) for _ in range(1 + _RUNS)]
        without = _run(models[CACHED], folder, "--no-cache")
    second = float(np.median(times[1:]))
    row = {"model": CACHED, "first s": round(times[0], 2), "second s": round(second, 2)}
    return [{**row, "ratio": round(second / times[0], 3), "--no-cache s": round(without, 2)}]


def _run(path: Path, cache: str, *options: str) -> float:
    asked = options if options == ("--version",) else ("joints", str(path), *options)
    words = [sys.executable, "-m", "bimfit", *asked]
    home = str(Path(bimfit.__file__).resolve().parents[1])
    paths = os.pathsep.join(part for part in (home, os.environ.get("PYTHONPATH", "")) if part)
    environment = {**os.environ, "BIMFIT_CACHE": cache, "PYTHONPATH": paths}
    environment.pop("BIMFIT_NO_CACHE", None)
    nowhere = subprocess.DEVNULL
    call = lambda: subprocess.run(words, env=environment, check=True, stdout=nowhere, stderr=nowhere)  # noqa: E731
    return _timed(call)[0]


def _timed(call: Callable[[], Any]) -> tuple[float, Any]:
    begun = time.perf_counter()
    result = call()
    return time.perf_counter() - begun, result


def _table(rows: Rows) -> str:
    if not rows:
        return "(left out: no real models here)"
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [names, *([_cell(row.get(name)) for name in names] for row in rows)]
    widths = [max(len(line[k]) for line in cells) for k in range(len(names))]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in cells
    )


def _cell(value: Any) -> str:
    return (
        "" if value is None else {True: "yes", False: "NO"}[value] if isinstance(value, bool) else str(value)
    )
