"""The parser, on bytes: recorded replies, layouts at the edge, and fuzzed streams."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bimfit.errors import SensorError
from bimfit.sensor.replies import Damaged, Reply, ReplyParser, ScanReply, device_time, fields
from bimfit.sensor.scip import ScanRequest


def six_bit(value, width):
    """The specification's encoding, written apart from the code under test."""
    digits = []
    for _ in range(width):
        value, low = divmod(value, 64)
        digits.append(low + 48)
    return bytes(reversed(digits))


def line(text):
    return text + bytes([sum(text) % 64 + 48]) + b"\n"


def scan_bytes(echo, stamp, values, width=3, status=b"99"):
    text = b"".join(six_bit(int(value), width) for value in values)
    out = echo + b"\n" + line(status) + line(six_bit(stamp, 4))
    while text:
        out, text = out + line(text[:64]), text[64:]
    return out + b"\n"


def test_the_recorded_ug01_reply(ug01_reply):
    lines = ug01_reply.split(b"\n")
    assert len(lines[3:-2]) == 32 and all(
        line(text[:-1]) == text + b"\n" for text in lines[1:-2]
    )  # 33 sums, 34 lines
    (scan,) = ReplyParser(ScanRequest("GD", 44, 725)).feed(ug01_reply)
    assert isinstance(scan, ScanReply)
    assert scan.values.size == 682
    assert scan.stamp == (0x5A - 48) * 64**3 + (0x52 - 48) * 64**2 + (0x33 - 48) * 64 + 0x68 - 48  # ZR3h
    assert scan.values[:4].tolist() == [6, 6, 6, 4190]
    assert scan.values.max() == 5461 and np.count_nonzero(scan.values < 20) == 85
    assert scan_bytes(b"GD0044072501", scan.stamp, scan.values, status=b"00") == ug01_reply


def test_one_wrong_character_anywhere_spoils_the_recorded_reply(ug01_reply):
    good = ReplyParser().feed(ug01_reply)[0].values
    for k in range(0, len(ug01_reply) - 1, 3):
        events = ReplyParser(ScanRequest("GD", 44, 725)).feed(
            ug01_reply[:k] + bytes([ug01_reply[k] ^ 1]) + ug01_reply[k + 1 :]
        )
        assert not any(isinstance(event, ScanReply) for event in events), k
    assert good.size == 682


def test_the_recorded_dialogue(dialogue):
    _, read = dialogue
    parser = ReplyParser()
    events = [event for _, data in read for event in parser.feed(data)]
    assert [(event.name, event.status) for event in events[:-1]] == [
        ("VV", "00"),
        ("VV", "00"),
        ("PP", "00"),
        ("II", "00"),
        ("BM", "02"),
        ("CR", "03"),
        ("VV", "00"),
        ("PP", "00"),
        ("II", "00"),
    ]
    assert isinstance(events[-1], ScanReply) and events[-1].values.size == 682
    assert fields(events[0])["FIRM"] == "3.1.04(02/Aug./2007)"
    assert fields(events[2])["AFRT"] == "384"
    # TIME is hexadecimal: the two answers lie 5 turns of 100 ms apart, and the scan's stamp lies just behind.
    first, second = device_time(fields(events[3])), device_time(fields(events[8]))
    assert second - first == 500 and 0 < events[-1].stamp - second < 100


def test_the_last_line_may_hold_a_single_character():
    request = ScanRequest("MD", 299, 469, 1, 0, 5)
    values = np.arange(171) * 31 + 20
    data = scan_bytes(b"MD0299046901004", 77, values)
    assert len(data.split(b"\n")[-3]) == 2  # one character and its sum
    (scan,) = ReplyParser(request).feed(data)
    assert scan.values.tolist() == values.tolist() and scan.request.count == 4 and scan.stamp == 77


@given(
    st.sampled_from(["MD", "MS", "GD", "GS"]),
    st.integers(1, 200),
    st.integers(1, 5),
    st.integers(0, (1 << 24) - 1),
    st.randoms(use_true_random=False),
)
def test_scans_of_any_layout(name, size, cluster, stamp, random):
    request = ScanRequest(name, 10, 10 + size - 1, cluster)
    values = [random.randrange(min(64**request.width, 1 << 16)) for _ in range(request.size)]
    status = b"99" if request.streams else b"00"
    data = scan_bytes(request.encode(), stamp, values, request.width, status)
    (scan,) = ReplyParser(request).feed(data)
    assert (scan.request, scan.stamp, scan.values.tolist()) == (request, stamp, values)


@settings(max_examples=30)
@given(st.lists(st.integers(1, 400), min_size=1, max_size=30))
def test_pieces_make_no_difference(lengths):
    request = ScanRequest("MD", 0, 99)
    data = b"".join(
        [
            b"VV\n00P\n\n",
            scan_bytes(request.encode(), 1, range(100)),
            b"\x00noise" + scan_bytes(request.encode(), 2, range(100)),
            scan_bytes(request.encode(), 3, range(100))[:-60],
            scan_bytes(request.encode(), 4, range(100)),
        ]
    )

    def told(events):
        return [(type(e).__name__, getattr(e, "stamp", getattr(e, "data", b"") or e)) for e in events]

    whole, parser, pieces, at = told(ReplyParser(request).feed(data)), ReplyParser(request), [], 0
    for length in [*lengths, len(data)]:
        pieces += parser.feed(data[at : at + length])
        at += length
    assert told(pieces) == whole
    assert [kind for kind, _ in whole] == [
        "Reply",
        "ScanReply",
        "Damaged",
        "ScanReply",
        "Damaged",
        "ScanReply",
    ]


def test_only_what_was_asked_for_is_believed():
    request = ScanRequest("MD", 10, 20, 2, 0, 3)
    values = range(request.size)
    for echo in (
        b"MD0011002002002",
        b"MD0010002102002",
        b"MD0010002002102",
        b"MD0010002002003",
        b"MD0010002002002;x",
    ):
        (event,) = ReplyParser(request).feed(scan_bytes(echo, 1, values))
        assert isinstance(event, Damaged) and event.scan, echo
    (event,) = ReplyParser(request).feed(scan_bytes(b"MD0010002002002", 1, values))
    assert isinstance(event, ScanReply)


def test_a_range_that_no_device_measures_is_damage():
    request = ScanRequest("MD", 0, 3)
    for farthest, believed in ((65535, True), (65536, False)):
        (event,) = ReplyParser(request).feed(scan_bytes(request.encode(), 1, [100, farthest, 0, 7]))
        assert isinstance(event, ScanReply) is believed


def test_a_lost_line_end_costs_one_reply_and_not_two():
    request = ScanRequest("MD", 0, 39)
    first, second = (scan_bytes(request.encode(), stamp, range(20, 60)) for stamp in (1, 2))
    for cut in range(1, len(first)):
        events = ReplyParser(request).feed(first[:cut] + second)
        assert [event.stamp for event in events if isinstance(event, ScanReply)] == [2], cut
        assert sum(isinstance(event, Damaged) for event in events) == 1
    reply = ReplyParser(request).feed(b"QT\n00P\n" + second)
    assert [type(event) for event in reply] == [Damaged, ScanReply]


def test_old_devices_and_odd_replies():
    events = ReplyParser().feed(
        b"SCIP2.0\n0\n\nQT\nE\n\nGD0044072501\n10Q\n\nTM1\n00P\n0000@\n\n\n\nMD0299046901000\n00P\n\n"
    )
    assert [(event.name, event.status) for event in events] == [
        ("SCIP2.0", "0"),
        ("QT", "E"),
        ("GD", "10"),
        ("TM", "00"),
        ("MD", "00"),
    ]


def test_noise_without_end_neither_grows_nor_hides_a_scan():
    parser = ReplyParser()
    rng = np.random.default_rng(0)
    for _ in range(300):
        parser.feed(rng.bytes(1000).replace(b"\n", b"x"))
        assert len(parser._partial) < 2000
    request = ScanRequest("MD", 0, 39)
    events = parser.feed(scan_bytes(request.encode(), 9, range(40)))
    assert [event.stamp for event in events if isinstance(event, ScanReply)] == [9]
    for _ in range(300):
        parser.feed(b"abc\n" * 100)
        assert len(parser._lines) < 5000
    assert [type(event) for event in parser.flush()] == [Damaged] and parser.flush() == []


def test_fields_need_their_sums():
    good = Reply("PP", "00", (b"DMIN:20;4", b"SCAN:600;e"))
    assert fields(good) == {"DMIN": "20", "SCAN": "600"}
    for wrong in (b"DMIN:21;4", b"DMIN:20;", b"DMIN20;4", b"DMIN:20", b"DM\xc9N:20;4"):
        with pytest.raises(SensorError, match="damaged"):
            fields(Reply("PP", "00", (wrong,)))
    assert device_time({"TIME": "6A5404"}) == 0x6A5404
    assert device_time({"TIME": "later"}) is None and device_time({}) is None


def _mutate(data, rng, swap):
    k, kind = int(rng.integers(len(data))), int(rng.integers(7 if swap else 5))
    if kind == 0:
        return data[:k] + bytes([data[k] ^ int(rng.integers(1, 256))]) + data[k + 1 :]
    if kind == 1:
        return data[:k] + data[k + 1 :]
    if kind == 2:
        return data[:k] + bytes([int(rng.integers(256))]) + data[k:]
    if kind == 3:
        return data[:k] + data[k + int(rng.integers(1, 40)) :]
    if kind == 4:
        return data[:k] + rng.bytes(int(rng.integers(1, 300))) + data[k:]
    if kind == 5:
        j = min(k, len(data) - 2)
        return data[:j] + data[j + 1 : j + 2] + data[j : j + 1] + data[j + 2 :]
    j = int(rng.integers(len(data)))
    return data[:k] + data[j : j + 40] + data[k:]


def test_ten_thousand_damaged_streams_yield_no_wrong_range():
    """Anything accepted stood on the line with every sum right; after one injury it is also true."""
    rng = np.random.default_rng(2026)
    requests = [ScanRequest("MD", 299, 331), ScanRequest("MS", 100, 143, 2, 1), ScanRequest("GD", 0, 20)]
    intact = rejected = 0
    for round_ in range(10_000):
        request = requests[round_ % 3]
        status = b"99" if request.streams else b"00"
        truth = {}
        stream = b"VV\n00P\nPROT:SCIP 2.0;N\n\n"
        for _ in range(3):
            stamp = int(rng.integers(1 << 24))
            truth[stamp] = rng.integers(0, 4096, request.size).tolist()
            stream += scan_bytes(request.encode(), stamp, truth[stamp], request.width, status)
        injuries = 1 if round_ % 2 else int(rng.integers(2, 7))
        for _ in range(injuries):
            stream = _mutate(stream, rng, swap=injuries > 1)
        parser = ReplyParser(request)
        cut = int(rng.integers(len(stream) + 1))
        events = parser.feed(stream[:cut]) + parser.feed(stream[cut:]) + parser.flush()
        scans = [event for event in events if isinstance(event, ScanReply)]
        for scan in scans:
            on_line = scan_bytes(scan.request.encode(), scan.stamp, scan.values, request.width, status)
            assert on_line[:-1] in stream.replace(b"\r\n", b"\n")  # CR LF ends a line as LF does
            if injuries == 1:
                assert truth[scan.stamp] == scan.values.tolist()
        if injuries == 1:
            assert len(scans) >= 1, stream  # one injury of at most 40 lost bytes spoils two scans at most
        intact += len(scans)
        rejected += sum(isinstance(event, Damaged) for event in events)
    assert intact > 10_000 and rejected > 5_000


@given(st.binary(max_size=2000))
def test_arbitrary_bytes_do_no_harm(data):
    parser = ReplyParser()
    assert not any(isinstance(event, ScanReply) for event in [*parser.feed(data), *parser.flush()])


def test_lines_that_end_in_cr_lf_say_the_same():
    """As behind converters that mend line ends; CR is no character of SCIP."""
    from bimfit.sensor import scip

    request = scip.ScanRequest("MD", 44, 200)
    values = np.arange(157) * 7 + 20
    head = [request.encode(), scip.with_sum(b"99"), scip.with_sum(scip.encode(77, 4))]
    plain = b"\n".join(head) + b"\n" + scip.data_lines(scip.encode_values(values, 3)) + b"\n"
    for data in (plain, plain.replace(b"\n", b"\r\n")):
        (event,) = ReplyParser(request).feed(data)
        assert isinstance(event, ScanReply) and event.stamp == 77
        assert event.values.tolist() == values.tolist()
