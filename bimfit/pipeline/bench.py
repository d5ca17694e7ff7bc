"""bench(): the published accuracy and speed tables."""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Callable, Iterator
from typing import Any

from bimfit.config import Config
from bimfit.pipeline.compare import Cut
from bimfit.pipeline.samples import sample_model
from bimfit.pipeline.simulate import designed, longest_open
from bimfit.pipeline.survey import cut_joint, model_joints
from bimfit.simulation.motion import random_truth
from bimfit.simulation.rangefinder import simulate_scan
from bimfit.simulation.scenario import Scenario
from bimfit.simulation.truth import JointTruth

Progress = Callable[[str, float], None]
SUITES = {
    "accuracy": "bimfit.pipeline.bench_accuracy:bench_accuracy",
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


def bench(suite: str, *, joints: int, seed: int, progress: Progress, case: str | None = None) -> Bench:
    """Run one suite of :data:`SUITES` over so many seeded joints (fuzz: files); one case of it where named.

    Raises
    ------
    ConfigError
        For a case that the suite does not have.
    """
    module, name = SUITES[suite].split(":")
    chosen = {} if case is None else {"only": case}
    result = getattr(importlib.import_module(module), name)(joints, seed, progress, **chosen)
    return result if isinstance(result, Bench) else Bench(*result)


def bench_space(joints: int, seed: int, progress: Progress) -> Bench:
    """The search in six degrees of freedom beside ICP, G-ICP and FPFH + RANSAC; ``joints`` starts."""
    from bimfit.registration.bench_3d import bench_matcher_3d, bench_tables_3d

    progress("tables", 0.0)
    tables = bench_tables_3d()
    progress("starts", 0.2)
    found = bench_matcher_3d(joints, seed=seed)
    wide = ((0.100, math.radians(10.0)),)
    progress("the wide window", 0.6)
    found += bench_matcher_3d(max(1, joints // 4), wide, seed=seed)
    rows = [dataclasses.asdict(row) for row in found]
    data = {"tables": dataclasses.asdict(tables), "rows": rows}
    said = f"{tables.seconds:.2f} s to build, {tables.mebibytes:.0f} MiB, lattice {tables.spacing_mm:g} mm"
    return Bench("\n".join([f"tables: {said}", _head(rows[0]), *(_line(row) for row in rows)]), data)


def reference_joints(
    joints: int, seed: int, scenario: Scenario | None = None
) -> Iterator[tuple[JointTruth, Cut]]:
    """Truth and cut of so many seeded joints of the reference scenario, or of another."""
    scenario = scenario or Scenario()
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
