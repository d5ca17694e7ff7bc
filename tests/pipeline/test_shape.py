"""Components whose bevels differ from the design: freed, found, reported, and the gap measured with them."""

from __future__ import annotations

import csv
import dataclasses
import io
import math

import numpy as np
import pytest

from bimfit.cli.options import build_config
from bimfit.config import Config, ShapeConfig
from bimfit.errors import ConfigError
from bimfit.geometry.shape import deformed
from bimfit.pipeline.bench_refusal import scanned
from bimfit.pipeline.fit import fit_joint
from bimfit.pipeline.results import _component as component_to_dict
from bimfit.pipeline.results import stations_to_csv
from bimfit.pipeline.samples import sample_model
from bimfit.pipeline.simulate import designed, longest_open
from bimfit.pipeline.survey import model_joints
from bimfit.simulation.motion import random_truth
from bimfit.simulation.scenario import Scenario
from bimfit.simulation.truth import gap_truth

TURNED = (math.radians(4.0), math.radians(3.0))


@pytest.fixture(scope="module")
def scene():
    model, found = model_joints(sample_model("v-groove.ifc"), Config().joints)
    joint = longest_open(found)
    scenario = Scenario(spacing=0.04, sigma=0.001)
    sections = designed(model, joint, scenario)
    real = tuple(
        deformed(deformed(s, 0, {"bevel-angle": TURNED[0]}), 1, {"bevel-angle": TURNED[1]}) for s in sections
    )
    truth = random_truth(sections, scenario, 3, joint_id=joint.id, elements=joint.elements)
    return joint, sections, real, truth, scanned(real, truth, scenario, 3)


def _errors(fit, real, truth):
    """Error of the root's width over its deviation, and the error itself, m."""
    out = []
    for station, section, true in zip(fit.stations, real, truth.stations, strict=True):
        if station.gap is not None:
            wanted = gap_truth(section, *true.components).width_root
            error = station.gap.width_root - wanted
            out.append((error / station.gap.sigma.width_root, error))
    return np.array(out)


def test_freed_bevels_are_found_and_the_gap_is_measured_with_them(scene):
    joint, sections, real, truth, slices = scene
    sensor = dataclasses.replace(Config().sensor, sigma=0.001)
    rigid = dataclasses.replace(Config(), sensor=sensor)
    free = dataclasses.replace(rigid, shape=ShapeConfig(bevel_angle=math.radians(3.0), thickness=0.002))
    fit = fit_joint(joint, sections, slices, free, threads=1)
    for which, wanted in enumerate(TURNED):
        freedom = {f.name: f for f in fit.stations[10].components[which].shape}
        bevel = freedom["bevel-angle"]
        assert bevel.state == "estimated"
        assert abs(bevel.value - wanted) < 3.5 * bevel.sigma < math.radians(2.0)
        assert freedom["thickness"].state == "unseen"
        assert freedom["thickness"].value is None
    ours, designed_shape = (
        _errors(fit, real, truth),
        _errors(fit_joint(joint, sections, slices, rigid, threads=1), real, truth),
    )
    assert len(ours) > 15
    assert np.sqrt(np.mean(ours[:, 0] ** 2)) < 1.8
    assert np.abs(ours[:, 1]).mean() < 0.5 * np.abs(designed_shape[:, 1]).mean()
    station = fit.stations[10]
    written = component_to_dict(station.components[0], station.section.frame)["shape"]
    assert written["thickness"] == {
        "value": None, "sigma": None, "unit": "m", "state": "unseen", "pooled": "",
    }  # fmt: skip
    row = list(csv.DictReader(io.StringIO(stations_to_csv([fit]))))[10]
    assert float(row["a_bevel_angle_rad"]) == written["bevel-angle"]["value"]
    assert row["a_thickness_m"] == ""


def test_outer_faces_that_lean_the_same_way_are_not_taken_for_a_turn_of_the_joint():
    model, found = model_joints(sample_model("v-groove.ifc"), Config().joints)
    joint = longest_open(found)
    scenario = Scenario(spacing=0.05)
    sections = designed(model, joint, scenario)
    leaning = (math.radians(4.0), math.radians(-4.0))
    real = tuple(
        deformed(deformed(s, 0, {"face-angle": leaning[0]}), 1, {"face-angle": leaning[1]}) for s in sections
    )
    truth = random_truth(sections, scenario, 43000, joint_id=joint.id, elements=joint.elements)
    slices = scanned(real, truth, scenario, 43000)
    free = dataclasses.replace(Config(), shape=ShapeConfig(face_angle=math.radians(2.0)))
    fit = fit_joint(joint, sections, slices, free, motion="independent", threads=1)
    for component, wanted in zip(fit.stations[8].components, leaning, strict=True):
        (face,) = component.shape
        assert face.state == "estimated"
        assert abs(face.value - wanted) < 2.5 * face.sigma < math.radians(2.5)


def test_a_freedom_at_its_limit_is_weak_and_says_so(scene):
    joint, sections, _, _, slices = scene
    sensor = dataclasses.replace(Config().sensor, sigma=0.001)
    tight = dataclasses.replace(
        Config(), sensor=sensor, shape=ShapeConfig(bevel_angle=math.radians(1.0), limit=1.0)
    )
    fit = fit_joint(joint, sections[:12], slices[:12], tight, motion="independent", threads=1)
    first = [s for s in fit.stations if s.components[0].shape[0].state == "at its limit"]
    assert len(first) == 12
    assert all(s.status.name != "ok" and s.status.reason for s in first)


def test_freedoms_on_the_command_line():
    config = build_config(None, shape="bevel-angle=2deg, thickness=1mm")
    assert config.shape.freedoms == pytest.approx({"bevel-angle": math.radians(2.0), "thickness": 0.001})
    for wrong in ("bevel=2deg", "bevel-angle", "bevel-angle=2mm", "bevel-angle=-1deg", ""):
        if wrong:
            with pytest.raises(ConfigError):
                build_config(None, shape=wrong)
