"""A virtual scan of a model's joints, with its truth."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bimfit.bim.stations import design_sections
from bimfit.config import Config, FitConfig
from bimfit.errors import JointError
from bimfit.geometry.line_scan import LineScan, joined
from bimfit.pipeline.survey import by_name, model_joints
from bimfit.simulation.motion import random_truth
from bimfit.simulation.rangefinder import aim, simulate_scan
from bimfit.simulation.scenario import Scenario
from bimfit.simulation.truth import JointTruth

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint
    from bimfit.bim.model import Model
    from bimfit.bim.selection import Selection
    from bimfit.geometry.joint_section import JointSection


def simulate(
    model_path: Path,
    scenario: Scenario,
    seed: int,
    *,
    joints: Selection | Sequence[str] = (),
    config: Config | None = None,
    told: Callable[[str], None] = lambda text: None,
) -> tuple[LineScan, tuple[JointTruth, ...]]:
    """Move the components of joints at random and scan them, one joint after the other.

    Parameters
    ----------
    model_path : Path
    scenario : Scenario
        What moves how far, and the sensor.
    seed : int
        The k-th joint uses ``seed + k``.
    joints : Selection, or sequence of str
        Ids or ``GUID,GUID``; empty takes the longest open joint. Of a selection that names no joint, all
        that it finds, but for those that cannot be looked into.
    told : callable
        Told of joints that are left out.

    Raises
    ------
    BimfitError
        When the model or a joint cannot be used.
    """
    model, found = model_joints(model_path, (config or Config()).joints, joints)
    given = bool(joints) if isinstance(joints, Sequence) else joints.given
    chosen = _scannable(model, found if given else (longest_open(found),), scenario, by_name(joints), told)
    scans, truths = [], []
    for k, (joint, sections) in enumerate(chosen):
        truth = random_truth(
            sections, scenario, seed + k, joint_id=joint.id, elements=joint.elements, kind=joint.kind
        )
        scans.append(simulate_scan(sections, truth, scenario, seed + k))
        truths.append(truth)
    return joined(scans, f"simulated from {model_path.name}, seed {seed}"), tuple(truths)


def _scannable(
    model: Model,
    joints: Sequence[Joint],
    scenario: Scenario,
    named: bool,
    told: Callable[[str], None],
) -> list[tuple[Joint, tuple[JointSection, ...]]]:
    """The joints with their designed sections; one that has none is left out unless it was named."""
    found, fault = [], None
    for joint in joints:
        try:
            found.append((joint, designed(model, joint, scenario)))
        except JointError as error:
            if named:
                raise
            told(f"left out: {error}")
            fault = error
    if fault is not None and not found:
        raise fault
    return found


def designed(model: Model, joint: Joint, scenario: Scenario) -> tuple[JointSection, ...]:
    """The joint's design where the scenario's sweeps cross it, from the side that is easier to look into.

    Raises
    ------
    JointError
        When no cross-section shows both components.
    """
    reach = sensor_reach(scenario)
    middle = np.array([0.5 * joint.length])
    sides = [joint]
    if joint.two_sided:
        sides.append(dataclasses.replace(joint, path=joint.path.flipped()))
    seen = [(side, design_sections(model, side, middle, reach)) for side in sides]
    slants = [(_slant(cut[0], scenario), k) for k, (_, cut) in enumerate(seen) if cut]
    best = sides[min(slants)[1]] if slants else joint
    sections = design_sections(model, best, scenario.stations(joint.length), reach)
    if not sections:
        raise JointError("no cross-section shows a gap between both elements", place=f"joint {joint.id}")
    return sections


def _slant(section: JointSection, scenario: Scenario) -> float:
    """How far from straight out of the mouth the sensor has to be held, rad, to the degree."""
    out = aim(section, scenario.sensor_height)
    return round(math.degrees(math.atan2(abs(out[0]), out[1])))


def sensor_reach(scenario: Scenario) -> float:
    """How far from the joint the components are kept, m: a slanting view meets them far out."""
    return max(FitConfig.reach, min(4.0 * scenario.sensor_height, scenario.max_range))


def longest_open(joints: Sequence[Joint]) -> Joint:
    """The longest joint that can be looked into, else the longest."""
    return max(joints, key=lambda joint: (joint.state == "open", joint.length, joint.id))
