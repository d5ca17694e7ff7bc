"""The bench's own measurements, in small: what they must find, whatever the seed."""

import os

import pytest

from bimfit.pipeline import bench_sensor
from bimfit.pipeline.bench_scan import ROWS


def quiet(step, share):
    assert 0.0 <= share <= 1.01


def test_single_injuries_never_make_a_wrong_or_a_second_scan():
    found = bench_sensor.fuzz(3, quiet, streams=400)
    once = found.data["once"]
    assert once["wrong"] == once["twice"] == found.data["often"]["twice"] == 0
    assert once["delivered"] + once["lost"] == 1600 and once["delivered"] > 1000
    assert "400 streams of 4 scans injured once" in found.text


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals")
def test_half_a_minute_with_faults():
    data = bench_sensor.faults(4, quiet, minutes=0.5).data
    assert data["once"] == data["whole"] == data["delivered"] > 200
    assert data["twice"] == data["wrongly_delivered"] == 0 and data["counted"] == data["broken"] > 3


def test_the_suite_has_its_rows():
    assert {"latency", "fuzz", "faults"} <= {name for name, _ in ROWS}
