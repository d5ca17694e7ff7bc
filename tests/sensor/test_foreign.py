"""Other people's clients against the emulator. They know the specification, and nothing of bimfit.

The first is written here from the specification, on bare file descriptors. The second follows the steps of
the C library that most drivers are built on: QT answered within 140 ms, then PP with ten lines, then MD.
"""

import os
import select
import time

import numpy as np
import pytest

from bimfit.sensor.emulator import Emulator
from bimfit.sensor.noise import NO_NOISE

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals")


class Client:
    """Reads line by line with a deadline, as a program in C would."""

    def __init__(self, port):
        self.descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)
        self.rest = b""

    def close(self):
        os.close(self.descriptor)

    def write(self, text):
        assert os.write(self.descriptor, text) == len(text)

    def line(self, seconds):
        deadline = time.monotonic() + seconds
        while b"\n" not in self.rest:
            ready, _, _ = select.select([self.descriptor], [], [], max(deadline - time.monotonic(), 0))
            if not ready:
                return None
            self.rest += os.read(self.descriptor, 100)
        text, _, self.rest = self.rest.partition(b"\n")
        return text

    def block(self, seconds):
        lines = []
        while (text := self.line(seconds)) != b"":
            assert text is not None, f"nothing came after {lines}"
            lines.append(text)
        return lines


@pytest.fixture
def client():
    with Emulator(lambda bearings: 2.0 + bearings / 4.0, noise=NO_NOISE) as device:
        made = Client(device.port)
        yield made
        made.close()


def right(text):
    return (sum(text[:-1]) & 0x3F) + 0x30 == text[-1]


def numbers(text, width):
    return [
        sum((byte - 0x30) << 6 * (width - 1 - k) for k, byte in enumerate(text[i : i + width]))
        for i in range(0, len(text), width)
    ]


def expected(first, last):
    return (
        np.rint(1000 * (2.0 + (np.arange(first, last + 1) - 384) * 2 * np.pi / 1024 / 4)).astype(int).tolist()
    )


def ranges(lines, first, last, width=3):
    assert all(right(text) for text in lines)
    assert all(len(text) == 65 for text in lines[1:-1])
    assert numbers(b"".join(text[:-1] for text in lines[1:]), width) == expected(first, last)
    return numbers(lines[0][:-1], 4)[0]


def test_a_client_straight_from_the_specification(client):
    client.write(b"SCIP2.0\n")
    assert client.block(0.2) == [b"SCIP2.0", b"0Ee"]
    client.write(b"VV;who is it?\r")
    assert client.block(0.2) == [b"VV;who is it?", b"0Hh"]
    client.write(b"VV\r\n")
    answer = client.block(0.2)
    assert answer[:2] == [b"VV", b"00P"] and len(answer) == 7
    assert all(text[-2:-1] == b";" and right(text[:-2] + text[-1:]) for text in answer[2:])
    client.write(b"GD0299046901\n")
    assert client.block(0.2) == [b"GD0299046901", b"10Q"]
    client.write(b"BM\n")
    assert client.block(0.2) == [b"BM", b"00P"]
    client.write(b"GD0299046901\n")
    echo, status, *rest = client.block(0.3)
    assert (echo, status) == (b"GD0299046901", b"00P") and len(rest[-1]) == 2
    ranges(rest, 299, 469)
    client.write(b"GS0044072501\n")
    ranges(client.block(0.3)[2:], 44, 725, 2)
    client.write(b"MD0299046901003\n")
    assert client.block(0.2) == [b"MD0299046901003", b"00P"]
    stamps = []
    for left in (b"02", b"01", b"00"):
        echo, status, *rest = client.block(0.3)
        assert (echo, status) == (b"MD02990469010" + left, b"99b")
        stamps.append(ranges(rest, 299, 469))
    assert np.diff(stamps).tolist() == [100, 100]
    client.write(b"BM\n")
    assert client.block(0.2) == [b"BM", b"00P"]  # the laser was off again


def test_the_steps_of_the_usual_c_library(client):
    client.write(b"QT\n")
    assert client.block(0.14) == [b"QT", b"00P"]
    client.write(b"SS115200\n")
    assert client.block(0.14)[1] in (b"00P", b"03S", b"04T")
    client.write(b"PP\n")
    answer = client.block(0.14)
    found = dict(text[:-2].split(b":") for text in answer[2:])
    assert len(answer) == 10 and {b"DMIN", b"DMAX", b"ARES", b"AMIN", b"AMAX", b"AFRT", b"SCAN"} < set(found)
    client.write(b"II\n")
    assert len(client.block(0.14)) == 9
    client.write(b"TM0\nTM1\nTM2\n")
    assert client.block(0.14) == [b"TM0", b"00P"]
    echo, status, stamp = client.block(0.2)
    assert (echo, status) == (b"TM1", b"00P") and len(stamp) == 5 and right(stamp)
    assert client.block(0.2) == [b"TM2", b"00P"]
    client.write(b"MD0044072501000\n")
    assert client.block(0.2) == [b"MD0044072501000", b"00P"]
    arrivals = []
    for _ in range(6):
        echo, status, *rest = client.block(0.3)
        assert (echo, status) == (b"MD0044072501000", b"99b")
        arrivals.append((ranges(rest, 44, 725), time.monotonic()))
    assert np.diff([stamp for stamp, _ in arrivals]).tolist() == [100] * 5
    client.write(b"QT\n")
    while (answer := client.block(0.3))[0] != b"QT":
        assert answer[0] == b"MD0044072501000"
    assert answer == [b"QT", b"00P"]
    assert client.line(0.25) is None
