import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bimfit.errors import SensorError
from bimfit.sensor import scip
from bimfit.sensor.scip import Parameters, ScanRequest

requests = st.builds(
    lambda name, start, length, cluster, interval, count, string: ScanRequest(
        name,
        start,
        min(start + length, 9999),
        cluster,
        interval if name[0] == "M" else 0,
        count if name[0] == "M" else 0,
        string,
    ),
    st.sampled_from(["MD", "MS", "GD", "GS"]),
    st.integers(0, 9999),
    st.integers(0, 1500),
    st.integers(0, 99),
    st.integers(0, 9),
    st.integers(0, 99),
    st.text("abcXYZ019 ._+@", max_size=16),
)


def test_examples_of_the_specification():
    assert bytes((scip.checksum(b"Hokuyo"),)) == b"o"
    assert scip.encode(1234, 2) == b"CB"
    assert scip.encode(5432, 3) == b"1Dh"
    assert scip.encode(16000000, 4) == b"m2@0"


@given(st.integers(1, 4).flatmap(lambda w: st.tuples(st.just(w), st.integers(0, (1 << 6 * w) - 1))))
def test_a_number_survives_encoding(case):
    width, value = case
    text = scip.encode(value, width)
    assert len(text) == width and scip.decode(text) == value
    assert all(0x30 <= character <= 0x6F for character in text)


@given(st.integers(1, 4), st.lists(st.integers(0, 63), max_size=200))
def test_many_numbers_are_read_like_one_at_a_time(width, values):
    scaled = np.array(values, dtype=np.int64) * ((1 << 6 * (width - 1)) + 1) % (1 << 6 * width)
    text = scip.encode_values(scaled, width)
    assert text == b"".join(scip.encode(int(value), width) for value in scaled)
    assert scip.decode_values(text, width).tolist() == scaled.tolist()


@pytest.mark.parametrize("text", [b"0/0", b"0p0", b"0\xff0", b"00"])
def test_what_is_no_number_is_refused(text):
    with pytest.raises(ValueError, match="six-bit"):
        scip.decode_values(text, 3)


@pytest.mark.parametrize(("value", "width"), [(-1, 3), (64, 1), (1 << 18, 3)])
def test_what_does_not_fit_is_refused(value, width):
    with pytest.raises(ValueError, match="fit"):
        scip.encode(value, width)
    with pytest.raises(ValueError, match="fit"):
        scip.encode_values(np.array([value]), width)


@given(requests)
def test_a_request_survives_its_text(request):
    assert ScanRequest.parse(request.encode()) == request


def test_requests_look_as_printed():
    assert ScanRequest("MD", 44, 725, 1, 0, 0).encode() == b"MD0044072501000"
    assert ScanRequest("GS", 299, 469, 3, string="a b").encode() == b"GS0299046903;a b"
    assert scip.command("SS", "115200", "x@1") == b"SS115200;x@1\n"
    for bad in ("MD004407250100", "GD00440725010", "MD0725004401000", "MX0044072501000", "GD0044072501 "):
        assert ScanRequest.parse(bad.encode()) is None


@given(requests)
def test_values_are_as_many_as_groups_of_steps(request):
    groups = [
        range(first, min(first + request.step, request.end + 1))
        for first in range(request.start, request.end + 1, request.step)
    ]
    assert request.size == len(groups)
    np.testing.assert_allclose(request.middles, [(group[0] + group[-1]) / 2 for group in groups])


@pytest.mark.parametrize("string", ["x" * 17, "a;b", "a\n", "é"])
def test_strings_that_cannot_be_sent(string):
    with pytest.raises(SensorError, match="cannot be sent"):
        scip.command("VV", string=string)
    with pytest.raises(SensorError, match="cannot be sent"):
        ScanRequest("GD", 1, 2, string=string)


@pytest.mark.parametrize(
    "wrong",
    [("XX", 1, 2), ("MD", 5, 4), ("MD", -1, 4), ("MD", 1, 10000), ("MD", 1, 2, 100), ("MD", 1, 2, 1, 10)],
)
def test_impossible_requests(wrong):
    with pytest.raises(SensorError):
        ScanRequest(*wrong)


@pytest.mark.parametrize(
    ("name", "status", "words"),
    [
        ("MD", "00", "accepted"),
        ("MD", "04", "out of range"),
        ("MS", "05", "before the start"),
        ("MD", "06", "interval"),
        ("MD", "07", "number of scans"),
        ("MD", "33", "checking itself"),
        ("MD", "72", "hardware"),
        ("GS", "60", "hardware"),
        ("GD", "10", "laser is off"),
        ("GD", "98", "resumed"),
        ("BM", "01", "does not work"),
        ("BM", "02", "on already"),
        ("QT", "00", "off"),
        ("TM1", "04", "outside"),
        ("TM0", "02", "on already"),
        ("TM2", "03", "off already"),
        ("SS", "04", "not supported"),
        ("CR", "03", "already"),
        ("HS", "02", "invalid"),
        ("VV", "0A", "internal"),
        ("VV", "0B", "full"),
        ("MD", "0C", "too few"),
        ("VV", "0D", "undefined"),
        ("SCIP2.0", "0E", "undefined"),
        ("VV", "0F", "too few"),
        ("VV", "0G", "16"),
        ("VV", "0H", "not allowed"),
        ("GD", "33", "unknown"),
        ("VV", "zz", "unknown"),
    ],
)
def test_every_status_has_words(name, status, words):
    assert words in scip.meaning(name, status)


def test_statuses_after_which_all_is_well():
    well = [
        ("BM", "02"),
        ("CR", "03"),
        ("SS", "03"),
        ("SS", "04"),
        ("TM2", "03"),
        ("SCIP2.0", "0E"),
        ("MD", "99"),
    ]
    assert all(scip.accepted(*case) for case in well)
    ill = [("BM", "01"), ("CR", "02"), ("GD", "10"), ("VV", "0E"), ("TM1", "04"), ("GD", "99"), ("QT", "0E")]
    assert not any(scip.accepted(*case) for case in ill)


def test_every_error_code_has_a_reason():
    assert all(scip.reason(code) for code in range(20))
    assert "22 m" in scip.reason(0) and "reflector" in scip.reason(18)
    with pytest.raises(ValueError, match="no error code"):
        scip.reason(20)


def test_steps_of_bearings():
    has = Parameters()
    assert has.steps(-math.pi / 6, math.pi / 6) == (299, 469)
    assert has.steps(-9.0, 9.0) == (44, 725)
    first, last = has.bearings(np.array([299.0, 469.0]))
    assert -math.pi / 6 <= first < -math.pi / 6 + math.tau / 1024 and last == -first
    with pytest.raises(SensorError, match="no beams"):
        has.steps(3.0, 3.1)


def test_a_device_that_describes_itself_badly():
    good = {"MODL": "x", "DMIN": "20", "DMAX": "5600", "ARES": "1024", "AMIN": "44"} | {
        "AMAX": "725",
        "AFRT": "384",
        "SCAN": "600",
    }
    assert Parameters.from_fields(good) == Parameters("x")
    for key, value in [("AMAX", "1e3"), ("AMAX", "3"), ("SCAN", "0"), ("DMIN", "-1"), ("AMAX", "1024")]:
        with pytest.raises(SensorError, match="describes itself"):
            Parameters.from_fields({**good, key: value})
    with pytest.raises(SensorError, match="DMAX"):
        Parameters.from_fields({key: value for key, value in good.items() if key != "DMAX"})
