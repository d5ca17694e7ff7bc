"""bench --suite accuracy: errors, calibration and times on simulated joints, beside the paper's Table 1."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bimfit.config import Config, SensorConfig
from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array
from bimfit.pipeline.accuracy import accuracy_table, joint_errors, table_text
from bimfit.pipeline.bench_times import bench_times, times_text
from bimfit.pipeline.compare import Cut
from bimfit.pipeline.fit import fit_along, fit_slices
from bimfit.pipeline.records import JointResult
from bimfit.pipeline.samples import sample_model
from bimfit.pipeline.simulate import designed, longest_open
from bimfit.pipeline.survey import cut_joint, model_joints
from bimfit.pipeline.targets import TargetCache
from bimfit.simulation.accuracy import GapErrors, gap_errors
from bimfit.simulation.disturbance import Disturbance
from bimfit.simulation.motion import random_truth
from bimfit.simulation.oracle import oracle_gap
from bimfit.simulation.rangefinder import simulate_scan
from bimfit.simulation.scenario import Scenario
from bimfit.simulation.truth import JointTruth

Progress = Callable[[str, float], None]
REFERENCE = "square-butt-ifc4.ifc"
_FAR = 0.005
_NORMAL = 1.96
_TIMED = 2
SPOILT = Config(sensor=SensorConfig(outlier_share=0.2, outlier_run=4.0))
"""A sensor of which it is known that it sees streaks of false points."""


@dataclass(frozen=True)
class Case:
    """A row of the suite: a model, how its joint has moved and is seen, and what is asked of it.

    Attributes
    ----------
    name, model : str
    scenario : Scenario
    joints : int
        How many seeded joints.
    asked : dict of str to str
        For each motion model that is run, what the project asks for.
    config : Config
        What is known of the sensor.
    """

    name: str
    model: str
    scenario: Scenario
    joints: int
    asked: dict[str, str]
    config: Config = field(default_factory=Config)


def cases(joints: int) -> tuple[Case, ...]:
    """All cases; the reference scenario has ``joints`` joints, the others a fifth or less."""
    few, sample = max(2, joints // 5), max(1, joints // 20)
    both = {"independent": "", "auto": ""}
    degraded = Scenario(outliers=0.05, dropouts=0.05)
    reference = {"independent": "0.45 / 2.0 mm, 1.7 deg", "auto": "0.18 / 1.3 mm"}
    return (
        Case("reference", REFERENCE, Scenario(), joints, reference),
        Case("linear drift", REFERENCE, Scenario(motion="linear"), few, {"auto": "0.07 mm"}),
        Case("rigid, drifting", REFERENCE, Scenario(motion="rigid"), few, {"auto": "0.09 mm"}),
        Case("bent by 5 mm", REFERENCE, Scenario(motion="bent"), few, {"auto": "0.15 mm"}),
        Case("rigid, no drift", REFERENCE, Scenario(motion="const"), few, {"auto": "0.17 mm"}),
        Case("5 % outliers, drop-outs", REFERENCE, degraded, few, {"independent": "0.55 mm", "auto": ""}),
        Case("noise correlated 0.5", REFERENCE, Scenario(correlation=0.5), few, both),
        Case("sigma 4.5, not 3 mm", REFERENCE, Scenario(sigma=0.0045), few, both),
        *(
            Case(name, f"{name}.ifc", Scenario(), 1 if name == "curved" else sample, both)
            for name in ("v-groove", "lap", "mitre", "t-joint", "curved")
        ),
        *(
            Case(f"{part}, {what}", model, Scenario(disturbance=how), sample, both, SPOILT)
            for part, model in (("reference", REFERENCE), ("v-groove", "v-groove.ifc"))
            for what, how in (
                ("streaks 20 %", Disturbance(glare=0.2)),
                ("ghosts 20 %", Disturbance(ghosts=0.2)),
                ("faces lost", Disturbance(bursts=0.3)),
            )
        ),
    )


@dataclass
class Tally:
    """What is gathered of one case under one motion model."""

    errors: list[GapErrors] = field(default_factory=list)
    scores: list[tuple[float, ...]] = field(default_factory=list)
    volumes: list[float] = field(default_factory=list)
    models: Counter[str] = field(default_factory=Counter)
    unflagged: int = 0
    flagged: int = 0

    def add(self, result: JointResult, truth: JointTruth) -> None:
        """Count one joint."""
        error = joint_errors(result, truth)
        self.errors.append(error)
        self.models[result.motion] += 1
        short = []
        rows = zip(result.stations, error.position, error.x, error.z, error.angle, error.width, error.volume,
                   error.length, strict=True)  # fmt: skip
        for station, far, x, z, angle, width, volume, length in rows:
            ok = station.status.name == "ok"
            self.flagged += not ok
            self.unflagged += bool(far > _FAR) and ok
            short.append(volume)
            sigma = None if station.gap is None else station.gap.sigma
            if sigma is not None and math.isfinite(x):
                # beyond the last stations a slice of the volume has no length
                area = volume / length / sigma.area if length > 0.0 else math.nan
                self.scores.append((x / sigma.x, z / sigma.y, angle / sigma.angle, width / sigma.width, area))
        sigma_v = None if result.volumes is None else result.volumes.sigma
        if sigma_v and np.isfinite(short).all():
            self.volumes.append(float(np.sum(short)) / sigma_v)

    def figures(self) -> dict[str, Any]:
        """The case's figures: mm, degrees, cm^3."""
        rows = {row.name: row for row in accuracy_table(self.errors)}
        z = np.array(self.scores).reshape(-1, 5)
        v = np.array(self.volumes)
        position, angle, volume = (rows[n] for n in ("||err_pos||", "|err_theta|", "|err_V|"))
        return {
            "slices": sum(len(e.x) for e in self.errors),
            "without_estimate": sum(e.lost for e in self.errors),
            "flagged": self.flagged,
            "over_5_mm_not_flagged": self.unflagged,
            "mean_mm": position.mean,
            "max_mm": position.max,
            "mean_deg": angle.mean,
            "mean_cm3": volume.mean,
            "standardised_x_z_angle_width_area": [_spread(column) for column in z.T],
            "coverage_95_x_z_angle_width_area": [_cover(column) for column in z.T],
            "standardised_volume": _spread(v),
            "coverage_95_volume": _cover(v),
            "joints_with_volume": len(v),
            "motion": dict(self.models),
        }


def _spread(z: Array) -> float:
    """Root mean square of standardised errors; NaN without any."""
    z = z[np.isfinite(z)]
    return float(np.sqrt(np.mean(z**2))) if len(z) else math.nan


def _cover(z: Array) -> float:
    """Share of standardised errors within a 95 % interval; NaN without any."""
    z = z[np.isfinite(z)]
    return float(np.mean(np.abs(z) < _NORMAL)) if len(z) else math.nan


def chosen_cases(joints: int, only: str | None) -> tuple[Case, ...]:
    """All cases, or the one of a name, with all of the joints.

    Raises
    ------
    ConfigError
        Where there is none of that name.
    """
    every = cases(joints)
    if only is None:
        return every
    named = tuple(dataclasses.replace(case, joints=joints) for case in every if case.name == only)
    if not named:
        known = "; ".join(case.name for case in every)
        raise ConfigError(f"no case of that name: {only}", remedy=f"choose from: {known}")
    return named


def bench_accuracy(
    joints: int, seed: int, progress: Progress, only: str | None = None
) -> tuple[str, dict[str, Any]]:
    """Every case (or ``only`` one), the oracle, the paper's method, and times; text and data."""
    every = chosen_cases(joints, only)
    total, done = sum(case.joints for case in every), 0
    data: dict[str, Any] = {}
    tables: list[str] = []
    lines = [_HEAD]
    for case in every:
        tallies = {motion: Tally() for motion in case.asked}
        oracle, paper = Tally(), Tally()
        cache = TargetCache(case.config)
        outlines = TargetCache(Config(), outlines=True)
        for k, (truth, cut) in enumerate(_simulated(case, seed)):
            progress(case.name, done / total)
            done += 1
            fitted = fit_slices(cut[1], cut[2], case.config, cache, threads=1)
            for motion, tally in tallies.items():
                tally.add(fit_along(cut[0], fitted, motion), truth)
            if case.name == "reference":
                oracle.errors.append(_oracle(cut, truth))
                if k < max(1, joints // 10):
                    printed = fit_slices(cut[1], cut[2], Config(), outlines, method="paper", threads=1)
                    paper.add(fit_along(cut[0], printed), truth)
        for motion, tally in tallies.items():
            data[f"{case.name}, {motion}"] = figures = tally.figures()
            lines.append(_row(case.name, motion, case.joints, figures, case.asked[motion]))
        if case.name == "reference":
            for name, tally in {**tallies, "oracle": oracle, "paper variant": paper}.items():
                rows = accuracy_table(tally.errors)
                count = sum(len(e.x) for e in tally.errors)
                tables.append(table_text(rows, f"{name}, {count} slices"))
                data.setdefault("table 1", {})[name] = [dataclasses.asdict(row) for row in rows]
            lines.append(_row("paper variant", "grid", len(paper.errors), paper.figures(), ""))
    progress("times", 1.0)
    timed = Case("times", REFERENCE, Scenario(), _TIMED, {})
    times = bench_times([cut for _, cut in _simulated(timed, seed)])
    data["times"] = times
    what = "Reference scenario" if only is None else only
    head = f"{what}, {joints} joints, seeds {seed} to {seed + joints - 1}"
    return "\n\n".join([head, *tables, "\n".join(lines), _NOTE, times_text(times)]), data


def _simulated(case: Case, seed: int) -> Iterator[tuple[JointTruth, Cut]]:
    """Truth and cut of a case's seeded joints."""
    model, found = model_joints(sample_model(case.model), Config().joints)
    joint = longest_open(found)
    sections = designed(model, joint, case.scenario)
    for k in range(seed, seed + case.joints):
        truth = random_truth(sections, case.scenario, k, joint_id=joint.id, elements=joint.elements)
        scan = simulate_scan(sections, truth, case.scenario, k)
        yield truth, cut_joint(model, joint, scan, Config())


def _oracle(cut: Cut, truth: JointTruth) -> GapErrors:
    return gap_errors(
        [
            None if s.beams is None else oracle_gap(section, station.components, s.beams, 0.003)
            for section, s, station in zip(cut[1], cut[2], truth.stations, strict=True)
        ],
        truth,
    )


_HEAD = (
    f"{'case':24}{'motion':12}{'joints':>7}{'slices':>7}{'lost':>5}{'flag':>5}{'>5mm':>5}{'mean':>7}{'max':>6}"
    f"{'deg':>6}{'cm3':>6}  {'standardised x z angle w area':30}{'95 % covers x z angle w area':30}"
    f"{'volume':>12}  asked"
)
_NOTE = (
    "mean, max: position error, mm; deg, cm3: mean errors of angle and slice volume; >5mm: not flagged;\n"
    "w: width at the mouth; volume: standardised error of the joint's volume and how often 95 % intervals "
    "cover it. Sought: 0.9 to 1.1, and 93 to 98 %."
)


def _row(name: str, motion: str, joints: int, f: dict[str, Any], asked: str) -> str:
    spread = " ".join(f"{z:5.2f}" for z in f["standardised_x_z_angle_width_area"])
    cover = " ".join(f"{100.0 * c:5.1f}" for c in f["coverage_95_x_z_angle_width_area"])
    volume = f"{f['standardised_volume']:5.2f} {100.0 * f['coverage_95_volume']:5.1f}"
    return (
        f"{name:24}{motion:12}{joints:7d}{f['slices']:7d}{f['without_estimate']:5d}{f['flagged']:5d}"
        f"{f['over_5_mm_not_flagged']:5d}{f['mean_mm']:7.3f}{f['max_mm']:6.2f}{f['mean_deg']:6.2f}"
        f"{f['mean_cm3']:6.3f}  {spread:30}{cover:30}{volume:>12}  {asked}"
    )
