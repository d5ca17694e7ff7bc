"""bench --suite refusal: what is not the joint is found, and what is, is kept (METHOD, section 5)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bimfit.config import Config
from bimfit.errors import ConfigError
from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array
from bimfit.geometry.slice import Beams, Slice
from bimfit.pipeline.fit import fit_joint, fit_station
from bimfit.pipeline.samples import sample_model
from bimfit.pipeline.simulate import designed, longest_open
from bimfit.pipeline.survey import model_joints
from bimfit.pipeline.targets import TargetCache, prepare
from bimfit.simulation.motion import random_truth
from bimfit.simulation.rangefinder import simulate_scan
from bimfit.simulation.scenario import Scenario
from bimfit.simulation.scenes import SCENES, impostor, narrowed
from bimfit.simulation.truth import JointTruth

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint

Progress = Callable[[str, float], None]
REFERENCE = "square-butt-ifc4.ifc"
DEGRADED = {"clean": (0.0, 0.0), "degraded": (0.05, 0.05)}
"""Shares of outliers and of drop-outs."""
NEAR = 0.005


@dataclasses.dataclass
class Tally:
    """What became of the slices of one scene.

    Attributes
    ----------
    slices, flagged, refused : int
        Slices; those whose own status is not ``ok``; of these, those without a number.
    joint_flagged : int
        Stations whose status is not ``ok`` when the joint is fitted as a whole.
    joints, joints_flagged : int
        Joints; those of which at least 99 % of the stations are flagged.
    wrong, wrong_flagged : int
        Slices by themselves whose gap is more than 5 mm from the truth; of these, those flagged.
    right, right_measured, right_ok : int
        The others: all, those that still give a number, those that are ``ok``.
    """

    slices: int = 0
    flagged: int = 0
    refused: int = 0
    joint_flagged: int = 0
    joints: int = 0
    joints_flagged: int = 0
    wrong: int = 0
    wrong_flagged: int = 0
    right: int = 0
    right_measured: int = 0
    right_ok: int = 0


def bench_refusal(
    joints: int,
    seed: int,
    progress: Progress,
    scenes: Sequence[str] = tuple(SCENES),
    spacing: float = 0.010,
    only: str | None = None,
) -> tuple[str, dict[str, Any]]:
    """Every scene at so many seeded joints (83 slices at 10 mm), clean and degraded; text and data.

    Raises
    ------
    ConfigError
        Where there is no scene named ``only``.
    """
    if only is not None and only not in SCENES:
        raise ConfigError(f"no case of that name: {only}", remedy=f"choose from: {'; '.join(SCENES)}")
    scenes = scenes if only is None else (only,)
    model, found = model_joints(sample_model(REFERENCE), Config().joints)
    joint = longest_open(found)
    base = Scenario(spacing=spacing)
    sections = designed(model, joint, base)
    tallies: dict[str, dict[str, Tally]] = {}
    for k in range(joints):
        for j, name in enumerate(scenes):
            progress(name, (k + j / len(scenes)) / joints)
            for how, (outliers, dropouts) in DEGRADED.items():
                scenario = dataclasses.replace(base, outliers=outliers, dropouts=dropouts)
                tally = tallies.setdefault(name, {}).setdefault(how, Tally())
                _one(joint, sections, name, scenario, seed + k, tally)
    text = "\n".join(
        [
            f"Refusals, reference design, {joints} joints of {len(sections)} slices a scene, "
            f"seeds {seed} to {seed + joints - 1}",
            _table(tallies),
        ]
    )
    data = {name: {how: dataclasses.asdict(t) for how, t in row.items()} for name, row in tallies.items()}
    return text, data


def _one(
    joint: Joint, sections: Sequence[JointSection], name: str, scenario: Scenario, seed: int, tally: Tally
) -> None:
    """One joint of one scene: every slice by itself, then all of them together."""
    scene = SCENES[name]
    design = sections if scene.width is None else narrowed(sections, scene.width)
    there = impostor(name, design, seed)
    scenario = dataclasses.replace(scenario, **scene.changes)
    truth = random_truth(design, scenario, seed, joint_id=joint.id, elements=joint.elements)
    slices = [displaced(cut, scene.shift) for cut in scanned(there, truth, scenario, seed)]
    config = Config()
    sensor = dataclasses.replace(
        config.sensor,
        outlier_share=max(config.sensor.outlier_share, scenario.outliers),
        miss_share=max(config.sensor.miss_share, scenario.dropouts),
    )
    config = dataclasses.replace(config, sensor=sensor)
    targets = prepare(design, slices, TargetCache(config))
    errors = np.zeros(len(slices))
    for i, (section, cut, target) in enumerate(zip(design, slices, targets, strict=True)):
        estimate = fit_station(section, cut, target, config).estimate
        assert estimate is not None
        tally.slices += 1
        tally.flagged += estimate.status.name != "ok"
        tally.refused += not estimate.status.measured
        a, b = (c.pose for c in estimate.components)
        if a is None or b is None:
            continue
        middle = 0.5 * (a.apply(section.gap.mouth[0]) + b.apply(section.gap.mouth[1]))
        real = section.frame.to_section(truth.stations[i].gap.origin)[:2]
        errors[i] = float(np.hypot(*(middle - real - (scene.shift, 0.0))))
        if errors[i] > NEAR:
            tally.wrong += 1
            tally.wrong_flagged += estimate.status.name != "ok"
        else:
            tally.right += 1
            tally.right_measured += estimate.status.measured
            tally.right_ok += estimate.status.name == "ok"
    whole = fit_joint(joint, design, slices, Config(), threads=1)
    flagged = sum(station.status.name != "ok" for station in whole.stations)
    tally.joint_flagged += flagged
    tally.joints += 1
    tally.joints_flagged += flagged >= 0.99 * len(whole.stations)


def scanned(
    sections: Sequence[JointSection], truth: JointTruth, scenario: Scenario, seed: int
) -> list[Slice]:
    """A virtual scan of ``sections`` moved as in ``truth``, a slice a station, in the stations' frames."""
    scan = simulate_scan(sections, truth, scenario, seed)
    count = len(scenario.bearings)
    out = []
    for k, section in enumerate(sections):
        of = slice(k * count, (k + 1) * count)
        out.append(_slice(section.frame, section.s, scan.origins[of], scan.directions[of], scan.ranges[of]))
    return out


def _slice(frame: SectionFrame, s: float, origins: Array, directions: Array, ranges: Array) -> Slice:
    beams = Beams(frame.to_section(origins)[:, :2], frame.direction_to_section(directions)[:, :2], ranges)
    return Slice(s, beams.points, beams, beams.origins.mean(axis=0), 1)


def displaced(cut: Slice, shift: float) -> Slice:
    """A slice placed ``shift`` too far along u, m."""
    if shift == 0.0 or cut.beams is None:
        return cut
    beams = Beams(cut.beams.origins + np.array([shift, 0.0]), cut.beams.directions, cut.beams.ranges)
    return Slice(cut.s, beams.points, beams, beams.origins.mean(axis=0), cut.sweeps)


def _table(tallies: dict[str, dict[str, Tally]]) -> str:
    lines = [
        f"{'scene':22}{'':10}{'slices':>7}{'not ok':>16}{'no number':>11}{'in the joint':>14}"
        f"{'whole joints':>14}{'over 5 mm: flagged':>20}{'right: number, ok':>20}  asked"
    ]
    for name, row in tallies.items():
        for how, t in row.items():
            lines.append(
                f"{name:22}{how:10}{t.slices:7d}{f'{t.flagged} = {_percent(t.flagged, t.slices)}':>16}"
                f"{t.refused:11d}{_percent(t.joint_flagged, t.slices):>14}"
                f"{f'{t.joints_flagged} of {t.joints}':>14}{f'{t.wrong_flagged} of {t.wrong}':>20}"
                f"{f'{t.right_measured}, {t.right_ok} of {t.right}':>20}  {SCENES[name].asked}"
            )
    return "\n".join(lines)


def _percent(part: int, whole: int) -> str:
    return f"{100.0 * part / max(whole, 1):.2f} %"
