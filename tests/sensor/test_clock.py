import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bimfit.sensor.clock import HostClock, StampOrder, StampUnwrapper, host_clock


@given(st.integers(0, (1 << 24) - 1), st.lists(st.integers(0, (1 << 23) - 1), max_size=50))
def test_stamps_count_on_over_the_wrap(start, steps):
    unwrap, true = StampUnwrapper(), start
    assert unwrap(start) == start
    for step in steps:
        true += step
        assert unwrap(true % (1 << 24)) == true


def test_a_late_stamp_is_late_and_not_four_hours_ahead():
    unwrap = StampUnwrapper()
    assert [unwrap(t) for t in ((1 << 24) - 10, 5, (1 << 24) - 5, 100)] == [
        (1 << 24) - 10,
        (1 << 24) + 5,
        (1 << 24) - 5,
        (1 << 24) + 100,
    ]


@pytest.mark.parametrize("drift", [-2e-4, 0.0, 2e-4])
def test_the_host_clock_follows_drift_and_ignores_delays(drift):
    rng = np.random.default_rng(3)
    clock = HostClock()
    worst = 0.0
    for k in range(20_000):
        device = 0.1 * k
        true = 1e9 + device * (1.0 + drift)
        late = rng.exponential(0.05) if rng.random() < 0.8 else 0.0
        clock.observe(device, true + 0.101 + late)
        if k > 100:
            worst = max(worst, abs(clock.to_host(device) - true))
    assert worst < 0.012  # the window of 30 s lags by 6 ms at this drift; unmended it would be 0.4 s


def test_the_time_mode_bounds_the_offset():
    clock = HostClock()
    assert math.isnan(clock.offset)
    clock.ask(100.0, 1.00, 100.1)  # offset within 99.0 .. 99.1
    clock.ask(100.2, 1.25, 100.3)  # 98.95 .. 99.05
    assert clock.bounds == pytest.approx((99.0, 99.05))
    assert clock.offset == pytest.approx(99.025)
    clock.observe(2.0, 101.5)  # the scan's delay alone would say 99.399
    assert clock.to_host(2.0) == pytest.approx(101.05)


def test_the_host_clock_is_time_and_monotonic():
    import time

    clock = host_clock()
    assert abs(clock() - time.time()) < 0.5
    assert clock() <= clock()


@given(
    st.integers(0, (1 << 24) - 1),
    st.lists(st.tuples(st.integers(1, 20), st.integers(-3, 3)), min_size=1, max_size=40),
)
def test_stamps_of_a_healthy_stream_are_all_believed(start, steps):
    """Whole turns of 100 ms that jitter, some left out, over the wrap."""
    order, at = StampOrder(0.1), start
    assert order.believes(start)
    for turns, jitter in steps:
        at += 100 * turns + jitter
        assert order.believes(at % (1 << 24))


def test_what_comes_twice_late_or_from_nowhere_is_doubted_once():
    order = StampOrder(0.1)
    told = [1000, 1100, 1100, 1200, 1100, 1300, 9_000_000, 1400, 1500]
    assert [order.believes(stamp) for stamp in told] == [
        True, True, False, True, False, True, False, True, True,
    ]  # fmt: skip
    assert not any(order.believes(stamp) for stamp in told)  # a line that stutters sends many again
    assert order.believes(1600)


def test_a_clock_that_was_set_is_followed():
    order = StampOrder(0.1)
    told = [5_000_000, 5_000_100, 50, 150, 250, 40_000_00, 4_000_100]
    assert [order.believes(stamp) for stamp in told] == [True, True, False, True, True, False, True]
