"""One case of the accuracy suite by itself."""

from __future__ import annotations

import pytest

from bimfit.errors import ConfigError
from bimfit.pipeline.bench_accuracy import bench_accuracy, cases, chosen_cases


def test_a_case_is_run_alone_and_with_all_of_the_joints():
    (case,) = chosen_cases(30, "v-groove")
    assert (case.name, case.joints) == ("v-groove", 30)
    assert chosen_cases(30, None) == cases(30)


def test_a_case_that_does_not_exist_is_refused_with_the_names_of_those_that_do():
    with pytest.raises(ConfigError, match="no case of that name: vgroove") as caught:
        bench_accuracy(1, 5, lambda *_: None, "vgroove")
    assert "v-groove" in (caught.value.remedy or "")
