"""Joints beside the one that was scanned are left out, and named."""

import dataclasses

import numpy as np
import pytest

from bimfit.config import Config
from bimfit.geometry.status import Status
from bimfit.pipeline.records import ComponentResult, JointResult, StationResult
from bimfit.pipeline.samples import sample_model
from bimfit.pipeline.shown import fitted_shown, fully_shown, left_out, share_shown
from bimfit.pipeline.simulate import designed, longest_open
from bimfit.pipeline.survey import cut_joint, model_joints
from bimfit.simulation.motion import random_truth
from bimfit.simulation.rangefinder import simulate_scan
from bimfit.simulation.scenario import Scenario


@pytest.fixture(scope="module")
def cuts():
    """One joint of the facade scanned, and every joint cut from that scan; the scanned one's id."""
    model, found = model_joints(sample_model("facade.ifc"), Config().joints)
    joint = longest_open(found)
    scenario = Scenario()
    sections = designed(model, joint, scenario)
    scan = simulate_scan(sections, random_truth(sections, scenario, 3), scenario, 3)
    return [cut_joint(model, each, scan, Config()) for each in found], joint.id


def test_only_the_scanned_joint_is_kept_and_the_others_are_named(cuts):
    made, scanned = cuts
    kept, others = fully_shown(made, Config())
    assert [cut[0].id for cut in kept] == [scanned]
    (note,) = left_out(others)
    assert f"left out {len(made) - 1} joints" in note
    assert "--joint" in note


def test_where_none_is_shown_all_are_kept(cuts):
    made, scanned = cuts
    others = [cut for cut in made if cut[0].id != scanned]
    assert fully_shown(others, Config()) == (others, [])


def test_a_missing_component_does_not_show_itself(cuts):
    made, scanned = cuts
    _, sections, slices = next(cut for cut in made if cut[0].id == scanned)
    assert share_shown(sections, slices, Config()).min() > 0.9
    one_sided = [dataclasses.replace(cut, points=cut.points[cut.points[:, 0] < -0.015]) for cut in slices]
    a, b = share_shown(sections, one_sided, Config())
    assert a > 0.9
    assert b < 0.5
    assert share_shown((), (), Config()).tolist() == np.zeros(2).tolist()


def test_fitted_joints_without_data_are_left_out_and_those_with_something_missing_stay(cuts):
    made, scanned = cuts
    _, sections, slices = next(cut for cut in made if cut[0].id == scanned)

    def fitted(cut, *statuses):
        none = ComponentResult("", None, None, None)
        stations = tuple(
            StationResult(section, slice_, status, None, (none, none), None)
            for section, slice_, status in zip(sections, slices, statuses, strict=False)
        )
        return JointResult(cut[0], "grcsm", stations, None, None)

    missing = Status("rejected", "component A: 12 beams in a row return nothing")
    nothing = Status("no_data", "component A: hardly any return lies on the component")
    empty, absent, mixed = (
        fitted(made[0], nothing, nothing, missing),
        fitted(made[1], missing, missing, missing, nothing),
        fitted(made[2], missing, nothing),
    )
    kept, others = fitted_shown([empty, absent, mixed])
    assert [each.joint.id for each in kept] == [absent.joint.id, mixed.joint.id]
    assert others == [empty.joint.id]
    assert fitted_shown([empty])[1] == []
    assert [empty.reason, mixed.reason, absent.reason] == [nothing.reason, missing.reason, missing.reason]
    assert mixed.reason == mixed.stations[0].status.reason  # of equals the first, in every run
