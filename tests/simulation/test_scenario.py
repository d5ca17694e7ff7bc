import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bimfit.errors import ConfigError
from bimfit.simulation.scenario import Scenario, load_scenario, own_ranges


def test_the_defaults_are_the_reference_scenario():
    scenario = Scenario()
    assert len(scenario.bearings) == 171
    assert np.allclose(np.degrees(scenario.bearings[[0, 85, 170]]), [-29.92, 0.0, 29.92])
    stations = scenario.stations(0.82)
    assert len(stations) == 83
    assert stations[0] == 0.0
    assert stations[-1] == pytest.approx(0.82, abs=1e-12)
    own = own_ranges(scenario, 0.025, 0.025)
    assert (own.closing, own.opening, own.shift_v) == (0.006, 0.006, 0.006)
    assert own.angle == pytest.approx(math.radians(3.0))


@given(st.floats(0.001, 50.0))
def test_stations_lie_on_the_joint_and_are_spaced_as_asked(length):
    s = Scenario().stations(length)
    assert s[0] >= 0.0
    assert s[-1] <= length
    assert s[0] == pytest.approx(length - s[-1], abs=1e-6)
    assert np.allclose(np.diff(s), 0.010, atol=1e-6)
    assert s[0] < 0.010


def test_a_3_mm_gap_is_scaled_to_0_72_mm():
    own = own_ranges(Scenario(), 0.003, 0.0)
    assert own.closing == pytest.approx(0.00072)
    assert own.opening == 0.002


@given(st.floats(0.0, 0.1), st.floats(1e-4, 1.0))
def test_own_motion_can_never_close_a_gap(narrowest, lever):
    own = own_ranges(Scenario(), narrowest, lever)
    # chord of the rotation plus the shift, of both sides together
    worst = math.hypot(own.closing, own.shift_v) + 2.0 * lever * math.sin(own.angle / 2.0)
    assert 2.0 * worst <= 0.9 * narrowest + 1e-12
    assert min(own.closing, own.opening, own.shift_v, own.angle) >= 0.0


def test_toml_overrides_by_name(tmp_path):
    file = tmp_path / "s.toml"
    file.write_text('motion = "linear"\nsigma = 0.001\ncommon_shift = [0.01, 0.0]\ntransitions = 5\n')
    scenario = load_scenario(file)
    expected = dataclasses.replace(
        Scenario(), motion="linear", sigma=0.001, common_shift=(0.01, 0.0), transitions=5
    )
    assert scenario == expected


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('motion = "wild"', "motion is one of"),
        ("sigm = 1.0", "did you mean sigma"),
        ("sigma = -1.0", "sigma must be"),
        ('sigma = "3mm"', "sigma must be"),
        ("common_shift = 0.02", "common_shift takes two numbers"),
        ("dropouts = 1.0", "dropouts must lie in"),
        ("spacing = 0", "spacing must be a positive number"),
        ("transitions = 1.5", "transitions must be a whole number"),
        ("max_range = 0.01", "min_range must be less"),
        ("sigma = ", "not TOML"),
    ],
)
def test_bad_settings_are_named_with_their_file(tmp_path, text, complaint):
    file = tmp_path / "s.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_scenario(file)
    assert complaint in str(error.value)
    assert str(file) in str(error.value)


def test_a_scenario_that_is_not_there(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        load_scenario(tmp_path / "none.toml")
