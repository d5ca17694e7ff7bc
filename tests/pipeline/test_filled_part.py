"""A filler over part of a joint: no width is invented there, and the rest of the joint keeps its own."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from bimfit.config import Config
from bimfit.geometry.profile import Profile
from bimfit.pipeline.bench_refusal import scanned
from bimfit.pipeline.fit import fit_joint
from bimfit.pipeline.samples import sample_model
from bimfit.pipeline.simulate import designed, longest_open
from bimfit.pipeline.survey import model_joints
from bimfit.simulation.motion import random_truth
from bimfit.simulation.scenario import Scenario


def _sealant(a, b, root_a, root_b):
    """From root to 3 mm below the mouth."""
    return np.array([root_a, root_b, b - (0.0, 0.003), a - (0.0, 0.003)])


def _weld(a, b, root_a, root_b):
    """A bead that laps 3 mm over both sides and stands 2 mm above them."""
    t = np.linspace(1.0, 0.0, 11)[:, None]
    p, q = a - (0.003, 0.0), b - (-0.003, 0.0)
    cap = p + t * (q - p) + np.column_stack([0.0 * t, 0.008 * t * (1.0 - t)])
    return np.concatenate([[p - (0.0, 0.01), q - (0.0, 0.01)], cap])


@pytest.mark.parametrize("fill", [_sealant, _weld])
def test_filled_stations_are_flagged_and_the_others_are_not(fill):
    model, found = model_joints(sample_model("square-butt-ifc4.ifc"), Config().joints)
    joint = longest_open(found)
    scenario = Scenario(spacing=0.02)
    sections = designed(model, joint, scenario)
    truth = random_truth(sections, scenario, 3001, joint_id=joint.id, elements=joint.elements)
    filled = range(4, 14)
    real = list(sections)
    for i in filled:
        a, b = truth.stations[i].components
        gap, (board_a, board_b) = sections[i].gap, sections[i].components
        body = fill(
            *(p.apply(m) for p, m in zip((a, b), gap.mouth, strict=True)),
            *(p.apply(side[-1]) for p, side in zip((a, b), (gap.side_a, gap.side_b), strict=True)),
        )
        loops = (*board_b.loops, *Profile.polygon(b.inverse().apply(body)).loops)
        real[i] = dataclasses.replace(sections[i], components=(board_a, Profile(loops)))
    fit = fit_joint(joint, sections, scanned(tuple(real), truth, scenario, 3001), Config(), threads=1)
    names = [station.status.name for station in fit.stations]
    assert all(names[i] != "ok" and fit.stations[i].status.reason for i in filled)
    rest = [name for i, name in enumerate(names) if i not in filled]
    assert rest.count("ok") >= len(rest) - 1
