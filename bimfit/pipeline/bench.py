"""bench(): the published accuracy and speed tables."""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from bimfit.config import Config
from bimfit.pipeline.accuracy import accuracy_table, joint_errors, table_text, time_text
from bimfit.pipeline.compare import Cut
from bimfit.pipeline.fit import fit_joint
from bimfit.pipeline.records import JointResult
from bimfit.pipeline.samples import sample_model
from bimfit.pipeline.simulate import designed, longest_open
from bimfit.pipeline.survey import cut_joint, model_joints
from bimfit.simulation.accuracy import GapErrors, gap_errors
from bimfit.simulation.motion import random_truth
from bimfit.simulation.oracle import oracle_gap
from bimfit.simulation.rangefinder import simulate_scan
from bimfit.simulation.scenario import Scenario
from bimfit.simulation.truth import JointTruth

Progress = Callable[[str, float], None]
SUITES = {
    "accuracy": "bimfit.pipeline.bench:bench_accuracy",
    "matcher": "bimfit.pipeline.bench_matcher:bench_matcher",
    "matcher-3d": "bimfit.pipeline.bench:bench_space",
    "scan": "bimfit.pipeline.bench_scan:bench_scan",
    "bim": "bimfit.pipeline.bench_bim:bench_bim",
    "fuzz": "bimfit.pipeline.bench_fuzz:bench_fuzz",
    "back": "bimfit.pipeline.bench_back:bench_back",
    "refusal": "bimfit.pipeline.bench_refusal:bench_refusal",
}
"""Each suite's function of (joints, seed, progress), which returns a Bench or its (text, data)."""
REFERENCE = "square-butt-ifc4.ifc"


@dataclasses.dataclass(frozen=True)
class Bench:
    """A suite's outcome: ``text`` to print, ``data`` for JSON."""

    text: str
    data: dict[str, Any]


def bench(suite: str, *, joints: int, seed: int, progress: Progress) -> Bench:
    """Run one suite of :data:`SUITES` over so many seeded joints (fuzz: files)."""
    module, name = SUITES[suite].split(":")
    result = getattr(importlib.import_module(module), name)(joints, seed, progress)
    return result if isinstance(result, Bench) else Bench(*result)


def bench_accuracy(joints: int, seed: int, progress: Progress) -> Bench:
    """Table 1 for the joint as a whole, each slice by itself, the oracle, and the paper's method."""
    cases = {
        "auto": ("grcsm", "auto"),
        "independent": ("grcsm", "independent"),
        "paper variant": ("paper", "independent"),
    }
    errors: dict[str, list[GapErrors]] = {name: [] for name in (*cases, "oracle")}
    standardised: dict[str, list[tuple[float, float, float]]] = {"auto": [], "independent": []}
    times: list[JointResult] = []
    unflagged = dict.fromkeys(cases, 0)
    for k, (truth, cut) in enumerate(reference_joints(joints, seed)):
        progress("accuracy", k / joints)
        for name, (method, motion) in cases.items():
            fit = fit_joint(*cut, Config(), method=method, motion=motion, threads=1)
            error = joint_errors(fit, truth)
            errors[name].append(error)
            for station, far in zip(fit.stations, error.position > 0.005, strict=True):
                unflagged[name] += bool(far) and station.status.name == "ok"
            if name in standardised:
                standardised[name] += _standardised(fit, error)
            if name == "auto":
                times.append(fit)
        oracle = [
            None
            if cut_slice.beams is None
            else oracle_gap(section, station.components, cut_slice.beams, 0.003)
            for section, cut_slice, station in zip(cut[1], cut[2], truth.stations, strict=True)
        ]
        errors["oracle"].append(gap_errors(oracle, truth))
    blocks: list[str] = []
    data: dict[str, Any] = {}
    for name, found in errors.items():
        rows = accuracy_table(found)
        lost = sum(e.lost for e in found)
        data[name] = {"rows": [dataclasses.asdict(row) for row in rows], "without_estimate": lost}
        text = f"{table_text(rows, name)}\nstations without an estimate: {lost}"
        if name in unflagged:
            text += f"; over 5 mm off and not flagged: {unflagged[name]}"
            data[name]["over_5_mm_not_flagged"] = unflagged[name]
        if name in standardised:
            z = np.array(standardised[name])
            spread, cover = np.sqrt(np.mean(z**2, axis=0)), np.mean(np.abs(z) < 1.96, axis=0)
            data[name] |= {"standardised_x_z_angle": spread.tolist(), "coverage_95": cover.tolist()}
            text += "\nstandardised errors x, z, angle: " + ", ".join(f"{s:.2f}" for s in spread)
            text += "; 95 % intervals cover " + ", ".join(f"{100 * c:.1f} %" for c in cover)
        blocks.append(text)
    head = f"Reference scenario, {joints} joints, {joints * 83} slices, seeds {seed} to {seed + joints - 1}"
    return Bench("\n\n".join([head, *blocks, time_text(times)]), data)


def _standardised(fit: JointResult, found: GapErrors) -> list[tuple[float, float, float]]:
    rows = []
    for station, x, z, angle in zip(fit.stations, found.x, found.z, found.angle, strict=True):
        sigma = None if station.gap is None else station.gap.sigma
        if sigma is not None and math.isfinite(x):
            rows.append((x / sigma.x, z / sigma.y, angle / sigma.angle))
    return rows


def bench_space(joints: int, seed: int, progress: Progress) -> Bench:
    """The search in six degrees of freedom beside ICP, G-ICP and FPFH + RANSAC; ``joints`` starts."""
    from bimfit.registration.bench_3d import bench_matcher_3d, bench_tables_3d

    progress("tables", 0.0)
    tables = bench_tables_3d()
    progress("starts", 0.2)
    rows = [dataclasses.asdict(row) for row in bench_matcher_3d(joints)]
    data = {"tables": str(tables), "rows": rows}
    return Bench("\n".join([f"tables: {tables}", _head(rows[0]), *(_line(row) for row in rows)]), data)


def reference_joints(joints: int, seed: int) -> Iterator[tuple[JointTruth, Cut]]:
    """Truth and cut of so many seeded joints of the reference scenario."""
    scenario = Scenario()
    model, found = model_joints(sample_model(REFERENCE), Config().joints)
    joint = longest_open(found)
    sections = designed(model, joint, scenario)
    for k in range(seed, seed + joints):
        truth = random_truth(sections, scenario, k, joint_id=joint.id, elements=joint.elements)
        yield truth, cut_joint(model, joint, simulate_scan(sections, truth, scenario, k), Config())


def _head(row: dict[str, Any]) -> str:
    return " ".join(f"{name[:16]:>16}" for name in row)


def _line(row: dict[str, Any]) -> str:
    return " ".join(f"{v:>16.4g}" if isinstance(v, float) else f"{v!s:>16.16}" for v in row.values())
