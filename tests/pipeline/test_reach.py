"""Walls that go on for longer than the scan is used: their cut ends must not hold the fit."""

import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.config import Config, SliceConfig
from bimfit.geometry.line_scan import joined
from bimfit.geometry.pose import Pose2D
from bimfit.pipeline.accuracy import joint_errors
from bimfit.pipeline.fit import fit_along, fit_joint, fit_slices
from bimfit.pipeline.samples import sample_model
from bimfit.pipeline.simulate import designed, longest_open
from bimfit.pipeline.survey import cut_joint, model_joints
from bimfit.pipeline.targets import TargetCache, match_reach
from bimfit.simulation.motion import random_truth
from bimfit.simulation.rangefinder import simulate_scan
from bimfit.simulation.scenario import Scenario

sys.path.insert(0, str(Path(__file__).parent))
from worlds import boards, corner_errors, fans

POSES = (Pose2D(0.004, 0.003, 0.012), Pose2D(0.006, 0.001, 0.015))


@pytest.fixture(scope="module")
def walls():
    """A joint of 10 mm between long walls, seen aslant: returns lie denser on one side."""
    model, joint, profiles = boards(0.010, 0.1, (3.0, 2.0), 0.5)
    scan = fans(
        profiles, POSES, np.linspace(0.01, 0.49, 12), (0.17, 0.36), np.radians(np.arange(-40, 40.1, 0.25)),
        0.003, np.random.default_rng(5),
    )  # fmt: skip
    return cut_joint(model, joint, scan, Config())


def test_a_cut_end_is_out_of_reach_of_every_return(walls):
    _, sections, slices = walls
    for section, cut in zip(sections, slices, strict=True):
        farthest = np.abs(cut.points[(np.abs(cut.points) <= match_reach(Config())).all(axis=1)]).max()
        for profile in section.components:
            ends = profile.edges[~profile.surface]
            assert len(ends) and np.abs(ends).max(axis=(1, 2)).min() > farthest + 0.12


def test_walls_seen_aslant_are_measured(walls):
    result = fit_joint(*walls, Config(), threads=1)
    assert sum(station.status.name == "ok" for station in result.stations) >= 10
    errors = corner_errors(result, POSES, ((-0.005, 0.0), (0.005, 0.0)))
    assert np.nanmax(errors) < 0.002


def test_stations_wider_apart_than_sweeps_do_not_mix_what_moved_in_between():
    """A component that runs off by 50 mm a metre: a slice of all sweeps of a cell would be smeared."""
    model, joint, profiles = boards(0.02, 0.03, (0.2, 0.2), 0.6)
    rng, ys = np.random.default_rng(2), np.arange(0.004, 0.6, 0.008)
    bearings = np.radians(np.arange(-35, 35.1, 0.35))
    scan = joined(
        [
            fans(profiles, (Pose2D(0.05 * (y - 0.3), 0.04 * (y - 0.3), 0.0), POSES[1]), [y], (0.0, 0.25),
                 bearings, 0.002, rng)
            for y in ys
        ]
    )  # fmt: skip
    config = Config(slices=SliceConfig(spacing=0.1))
    result = fit_joint(*cut_joint(model, joint, scan, config), config, threads=1)
    assert sum(station.status.name == "ok" for station in result.stations) >= 5
    assert all(station.slice.sweeps <= 2 for station in result.stations)


def test_faces_that_go_on_at_a_graze_do_not_pull_a_component():
    """A mitre's faces are met at 15 degrees at the scan's ends: they once slid a component by 7 mm."""
    model, found = model_joints(sample_model("mitre.ifc"), Config().joints)
    joint = longest_open(found)
    sections = designed(model, joint, Scenario())
    truth = random_truth(sections, Scenario(), 31002, joint_id=joint.id, elements=joint.elements)
    scan = simulate_scan(sections, truth, Scenario(), 31002)
    cut = cut_joint(model, joint, scan, Config())
    fits = fit_slices(cut[1], cut[2], Config(), TargetCache(Config()), threads=1)
    result = fit_along(cut[0], fits, "independent")
    assert np.nanmax(joint_errors(result, truth).position) < 0.002
