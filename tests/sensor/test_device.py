"""The emulated device, without a port: the recorded dialogue byte for byte, every status, the rhythm."""

import numpy as np
import pytest

from bimfit.sensor import device as device_module
from bimfit.sensor.device import Device
from bimfit.sensor.models import UG01, URG_04LX
from bimfit.sensor.replies import Reply, ReplyParser, ScanReply, fields
from bimfit.sensor.scip import Parameters

STEPS = np.arange(44, 726)


def make(**options):
    return Device(lambda start: STEPS + 1000, **options)


def told(device, request, now=0.0, until=0.5):
    device.receive(request, now)
    return b"".join(packet.data for packet in device.take(now + until))


def test_the_recorded_dialogue_byte_for_byte(dialogue):
    """Sent the recorded requests at their times, the emulated URG-04LX gives back every byte."""
    written, read = dialogue
    recording = b"".join(data for _, data in read)
    scan = ReplyParser().feed(recording)[-1]
    # The recorded sensor turned a little faster than the host's clock: 8 turns in 798 ms.
    rate, first_reply, origin = 0.8 / 0.798, 10.0, read[0][0]
    shift = first_reply + 0.1 * device_module.REPLY_PHASE
    turn = round(first_reply * 10) + 9  # the scan's: the ninth after the first reply
    device = Device(lambda _: scan.values, identity=URG_04LX, laser=True, clock=scan.stamp - turn * 100)
    out, sent = b"", []
    for time, data in written:
        now = (time - origin) * rate + shift
        packets = device.take(now)
        device.receive(data, now)
        out, sent = out + b"".join(p.data for p in packets), [*sent, *packets]
    packets = device.take(60.0)
    out, sent = out + b"".join(p.data for p in packets), [*sent, *packets]
    assert out == recording
    # Each reply starts when the recorded one did, to 5 ms.
    starts = [time for k, (time, _) in enumerate(read) if k == 0 or time - read[k - 1][0] > 0.05]
    np.testing.assert_allclose([(p.time - shift) / rate + origin for p in sent], starts, atol=0.005)


def test_the_recorded_ug01_scan_byte_for_byte(ug01_reply):
    scan = ReplyParser().feed(ug01_reply)[0]
    device = Device(lambda _: scan.values, laser=True, clock=scan.stamp)
    assert told(device, b"GD0044072501\n") == ug01_reply


def test_identity_of_the_ug01():
    lines = told(make(), b"VV\n").split(b"\n")
    assert lines[2:6] == [
        b"VEND:Hokuyo Automatic Co.,Ltd.;[",
        b"PROD:SOKUIKI Sensor URG-04LX-UG01(Simple-URG);[",
        b"FIRM:3.4.03(17/Dec./2012);T",
        b"PROT:SCIP 2.0;N",
    ]
    lines = told(make(), b"PP\n").split(b"\n")
    assert lines[3:] == [
        rb"DMIN:20;4",
        rb"DMAX:5600;_",
        b"ARES:1024;\\",
        rb"AMIN:44;7",
        rb"AMAX:725;o",
        rb"AFRT:384;6",
        rb"SCAN:600;e",
        b"",
        b"",
    ]


@pytest.mark.parametrize(
    ("before", "request_", "status"),
    [
        ("", "MD0044072501000", "00"),
        ("", "MDx044072501000", "01"),
        ("", "MD0044x72501000", "02"),
        ("", "MD00440725x1000", "03"),
        ("", "MD0044072601000", "04"),
        ("", "MD0300029901000", "05"),
        ("", "MD0044072501x00", "06"),
        ("", "MD00440725010x0", "07"),
        ("", "MD004407250100", "0C"),
        ("", "MD00440725010000", "0D"),
        ("", "GD0044072501", "10"),
        ("", "GS0044x72501", "02"),
        ("", "BM", "00"),
        ("BM", "BM", "02"),
        ("MD0044072501000", "BM", "02"),
        ("", "QT", "00"),
        ("TM0", "QT", "0E"),
        ("TM0", "VV", "0E"),
        ("TM0", "TM0", "02"),
        ("TM0", "TM2", "00"),
        ("", "TM2", "03"),
        ("", "TM1", "04"),
        ("", "TM7", "01"),
        ("", "TM", "0C"),
        ("", "RS", "00"),
        ("", "SS115200", "00"),
        ("", "SS019200", "03"),
        ("", "SS123456", "02"),
        ("", "SSabcdef", "01"),
        ("", "SS1152", "0C"),
        ("", "CR00", "03"),
        ("", "CR05", "00"),
        ("", "CR11", "02"),
        ("", "CRxx", "01"),
        ("", "HS1", "00"),
        ("", "HS0", "03"),
        ("", "HS2", "02"),
        ("", "HSx", "01"),
        ("", "SCIP2.0", "0E"),
        ("", "ZZ", "0E"),
        ("", "VV;abc DEF._+@1", "00"),
        ("", "VV;" + "x" * 17, "0G"),
        ("", "VV;a-b", "0H"),
    ],
)
def test_statuses(before, request_, status):
    device = make()
    if before:
        told(device, before.encode() + b"\n")
    now = 1.0
    reply = ReplyParser().feed(told(device, request_.encode() + b"\r", now, until=0.0999))[-1]
    if isinstance(reply, ScanReply):
        reply = ReplyParser().feed(told(device, request_.encode() + b"\n", 2.0, until=0.0999))[0]
    assert isinstance(reply, Reply) and (reply.echo, reply.status) == (request_, status)


def test_scip_1_1_until_told_otherwise():
    device = make(scip1=True)
    assert told(device, b"QT\n") == b"QT\nE\n\n"
    assert told(device, b"SCIP2.0\r\n", 1.0) == b"SCIP2.0\n0\n\n"
    assert told(device, b"QT\n", 2.0) == b"QT\n00P\n\n"
    assert told(make(), b"SCIP2.0\n") == b"SCIP2.0\n0Ee\n\n"


def test_a_counted_stream_counts_down_and_puts_the_laser_out():
    device = make()
    device.receive(b"MD0299046901103\n", 0.0)
    events = ReplyParser().feed(b"".join(p.data for p in device.take(5.0)))
    assert isinstance(events[0], Reply) and events[0].status == "00"
    assert [event.request.count for event in events[1:]] == [2, 1, 0]
    assert np.diff([event.stamp for event in events[1:]]).tolist() == [200, 200]
    assert not device.laser and device.next_time() is None


def test_an_endless_stream_ends_with_qt():
    device = make()
    device.receive(b"MS0100020002000\n", 0.0)
    events = ReplyParser().feed(b"".join(p.data for p in device.take(1.0)))
    # Answered in the first turn, which the laser did not light.
    assert len(events) == 9 and all(event.request.count == 0 for event in events[1:])
    assert events[1].values.tolist() == [1100 + 2 * k for k in range(51)]
    device.receive(b"QT\n", 1.0)
    assert b"".join(p.data for p in device.take(9.0)) == b"QT\n00P\n\n" and not device.laser


def test_a_late_scan_after_qt():
    device = make(late_scan=True)
    device.receive(b"MD0100020001000\n", 0.0)
    device.take(1.0)
    device.receive(b"QT\n", 1.0)
    kinds = [type(event) for event in ReplyParser().feed(b"".join(p.data for p in device.take(9.0)))]
    assert kinds == [Reply, ScanReply]


def test_questions_in_the_middle_of_a_stream():
    device = make()
    device.receive(b"MD0299046901000\n", 0.0)
    device.take(0.5)
    device.receive(b"II\n", 0.5)
    events = ReplyParser().feed(b"".join(p.data for p in device.take(0.85)))
    assert sorted(type(event).__name__ for event in events) == ["Reply"] + 4 * ["ScanReply"]
    reply = next(event for event in events if isinstance(event, Reply))
    assert fields(reply)["LASR"] == "ON"


def test_clusters_take_the_least_valid_value():
    values = np.full(682, 500)
    values[:9] = [0, 700, 600, 6, 7, 0, 30, 20, 19]
    device = Device(lambda _: values, laser=True)
    scan = ReplyParser().feed(told(device, b"GD0044005203\n"))[0]
    assert scan.values.tolist() == [600, 6, 20]
    below = ReplyParser().feed(told(device, b"GD0042004501\n", 5.0))[0]
    assert below.values.tolist() == [19, 19, 0, 700]


def test_reset_starts_the_clock_again():
    device = make(clock=5000)
    assert device.stamp(2.0) == 7000
    told(device, b"RS\n", 2.0)
    assert device.stamp(2.0) == 0 and Device(lambda _: STEPS, clock=(1 << 24) - 1).stamp(0.001) == 0


def test_other_geometries():
    has = Parameters("UTM", 23, 30000, 1440, 0, 1080, 540, 2400)
    device = Device(lambda _: np.arange(1081), has, UG01, laser=True)
    scan = ReplyParser().feed(told(device, b"GD0000108001\n"))[0]
    assert scan.values.tolist() == list(range(1081))


def test_a_turn_is_measured_once_whoever_asks_for_it():
    """GD in the middle of a stream shows the ranges of the scan with the same stamp."""
    rng = np.random.default_rng(4)
    device = Device(lambda start: rng.integers(20, 5600, 682), Parameters())
    device.receive(b"MD0384038401000\n", 0.0)
    found = {}
    for k in range(200):
        now = 0.01 * k
        if k == 80:
            device.receive(b"GD0384038401\n", now)
        for packet in device.take(now):
            if packet.stamp is not None:
                found.setdefault(packet.stamp, []).append(packet.data.split(b"\n")[3])
    both = [ranges for ranges in found.values() if len(ranges) == 2]
    assert len(both) == 1 and both[0][0] == both[0][1] and len(found) > 10
