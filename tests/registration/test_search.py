"""The planar search against brute force."""

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest

from bimfit.config import SearchConfig
from bimfit.geometry.pose import Pose2D
from bimfit.registration.matchers import MATCHERS
from bimfit.registration.table import Target

SMALL = dict(window=(0.02, 0.015, math.radians(6)), tolerance=(0.002, 0.002, math.radians(0.6)))


def _load(name):
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


scenes = _load("scenes")


@pytest.mark.parametrize("s", [2, 3, 4, 5])
@pytest.mark.parametrize("bound", ["majorant", "overlap"])
def test_the_search_finds_what_brute_force_finds(s, bound):
    target = Target.of(scenes.boards_edges(), 0.006)
    config = SearchConfig(**SMALL, tests_per_level=s, bound=bound)
    for slice_, *_ in scenes.make_slices(4, seed=s):
        found = MATCHERS["grcsm"](target, slice_, Pose2D(), config)
        best = MATCHERS["brute"](target, slice_, Pose2D(), config)
        assert found.score == best.score
        assert np.array_equal(found.parameters, best.parameters)
        assert found.stop == "proven" and found.gap == 0.0
