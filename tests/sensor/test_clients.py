"""The manners of other people's SCIP clients, each in a few lines of its own; none knows bimfit."""

import os
import select
import sys
import termios
import time

import numpy as np
import pytest
import serial

from bimfit.sensor.emulator import Emulator
from bimfit.sensor.models import MODELS
from bimfit.sensor.noise import NO_NOISE

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals")

STEPS = np.arange(44, 726)
TRUE = (1000 + 3 * (STEPS % 700)).tolist()


@pytest.fixture
def device():
    with Emulator([np.array(TRUE)], speed=10.0, noise=NO_NOISE) as made:
        yield made


def decoded(text, width):
    """Six bits a character, as the bit strings that one client makes of them."""
    bits = "".join(f"{byte - 0x30:06b}" for byte in text)
    return [int(bits[k : k + 6 * width], 2) for k in range(0, len(bits), 6 * width)]


def body(lines):
    """Data lines without their sums, joined."""
    return b"".join(line[:-1] for line in lines)


class Raw:
    """A file descriptor, read a byte at a time."""

    def __init__(self, port, flags=os.O_RDWR | os.O_NOCTTY):
        self.fd = os.open(port, flags)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        os.close(self.fd)

    def send(self, *pieces):
        for piece in pieces:
            os.write(self.fd, piece)
            if len(pieces) > 1:
                time.sleep(0.002)

    def reply(self, patience=2.0):
        """Up to the empty line."""
        text = b""
        while not text.endswith(b"\n\n"):
            ready, _, _ = select.select([self.fd], [], [], patience)
            assert ready, f"nothing came after {text!r}"
            text += os.read(self.fd, 1)
        return text


def test_reads_of_known_length(device):
    """Asks for as many bytes as the answer must have, as clients without a parser do."""
    with serial.Serial(device.port, 19200, timeout=2.0) as port:

        def short(command):
            port.write(command)
            assert port.read(len(command)) == command
            answer = port.read(5)
            assert answer.endswith(b"\n\n")
            return answer[:3]

        assert short(b"SCIP2.0\n") == b"0Ee" and short(b"RS\n") == b"00P" and short(b"BM\n") == b"00P"
        assert short(b"CR00\n") == b"03S" and short(b"HS0\n") == b"03S" and short(b"SS115200\n") == b"00P"
        port.write(b"MD0044072501001\n")
        head = port.read(47)
        assert head[:21] == b"MD0044072501001\n00P\n\n" and head[21:41] == b"MD0044072501000\n99b\n"
        text = port.read(2046 + 32 * 2 + 1)  # characters in 32 lines, each with sum and line end
        assert text.endswith(b"\n\n")
        assert decoded(body(text.split(b"\n")[:-2]), 3) == TRUE
        command = b"GD0299046901\n"
        assert short(b"BM\n") == b"00P"
        port.write(command)
        assert port.read(len(command)) == command and port.read(4) == b"00P\n" and len(port.read(6)) == 6
        text = port.read(513 + 9 * 2 + 1)
        assert decoded(body(text.split(b"\n")[:-2]), 3) == TRUE[255:426]


def test_lines_until_nothing_comes(device):
    """Empties the input, asks, and takes every line until a read times out."""
    with serial.Serial(device.port, 115200, timeout=0.3) as port:

        def ask(command):
            port.reset_input_buffer()
            port.write(command)
            return port.readlines()

        ask(b"SCIP2.0\n")
        answer = ask(b"PP\n")
        assert answer[:2] == [b"PP\n", b"00P\n"] and len(answer) == 11
        known = dict(item.split(b";")[0].split(b":") for item in answer[2:10])
        assert known[b"AMIN"] == b"44" and known[b"AMAX"] == b"725"
        assert len(ask(b"VV\n")) == 8 and len(ask(b"II\n")) == 10
        assert ask(b"BM\n") == [b"BM\n", b"00P\n", b"\n"]
        answer = ask(b"GS0044072503\n")
        assert answer[:2] == [b"GS0044072503\n", b"00P\n"]
        joined = b"".join(line[:-2] for line in answer[3:] if len(line) > 2)
        assert decoded(joined, 2) == [min(TRUE[k : k + 3]) for k in range(0, 682, 3)]
        assert ask(b"QT\n") == [b"QT\n", b"00P\n", b"\n"]


def test_reset_first_then_ask_the_clock_then_stream(device):
    """The ROS manner: TM2 whatever it says, RS, PP, VV, the clock in the time mode, then skipping turns."""
    with Raw(device.port) as port:
        termios.tcflush(port.fd, termios.TCIFLUSH)
        port.send(b"TM2\n")
        assert port.reply() == b"TM2\n03S\n\n"
        port.send(b"RS\n")
        assert port.reply() == b"RS\n00P\n\n"
        port.send(b"TM0\n")
        assert port.reply() == b"TM0\n00P\n\n"
        stamps = []
        for _ in range(3):
            port.send(b"TM1\n")
            echo, status, stamp, *_ = port.reply().split(b"\n")
            assert (echo, status, len(stamp)) == (b"TM1", b"00P", 5)
            stamps.append(decoded(stamp[:-1], 4)[0])
        assert 0 < stamps[0] < stamps[1] < stamps[2] < 5000  # RS had set the clock to 0
        port.send(b"TM2\n")
        assert port.reply() == b"TM2\n00P\n\n"
        port.send(b"MD0044072502205\n")
        assert port.reply() == b"MD0044072502205\n00P\n\n"
        seen = []
        for left in (4, 3, 2, 1, 0):
            echo, status, stamp, *rest = port.reply().split(b"\n")
            assert (echo, status) == (b"MD00440725022%02d" % left, b"99b")
            seen.append(decoded(stamp[:-1], 4)[0])
            assert decoded(body(rest[:-2]), 3) == TRUE[::2]
        assert np.diff(seen).tolist() == [300] * 4  # two turns left out between


@pytest.mark.parametrize("end", [b"\n", b"\r", b"\r\n"])
def test_line_ends_pieces_and_many_requests_at_once(device, end):
    with Raw(device.port) as port:
        port.send(*(bytes((byte,)) for byte in b"VV" + end))
        assert port.reply().startswith(b"VV\n00P\nVEND:")
        port.send(b"BM" + end + b"PP" + end + b"II" + end + b"QT" + end)
        assert [port.reply()[:6] for _ in range(4)] == [b"BM\n00P", b"PP\n00P", b"II\n00P", b"QT\n00P"]
        port.send(end + end + b"QT" + end)
        assert port.reply() == b"QT\n00P\n\n"


@pytest.mark.parametrize("string", [b";", b";1", b";a b.c_d+e@f 1234", b""])
def test_strings_come_back_in_every_echo(device, string):
    with Raw(device.port) as port:
        for name in (b"BM", b"SS115200", b"QT"):
            port.send(name + string + b"\n")
            assert port.reply().split(b"\n")[:2] in ([name + string, b"00P"], [name + string, b"03S"])
        port.send(b"MS0299046901002" + string + b"\n")
        assert port.reply() == b"MS0299046901002" + string + b"\n00P\n\n"
        for left in (b"01", b"00"):
            echo, status, _, *rest = port.reply().split(b"\n")
            assert (echo, status) == (b"MS02990469010" + left + string, b"99b")
            assert decoded(body(rest[:-2]), 2) == TRUE[255:426]


def test_questions_and_other_requests_in_the_middle_of_a_stream(device):
    with Raw(device.port) as port:
        port.send(b"MD0299046901000\n")
        assert port.reply() == b"MD0299046901000\n00P\n\n"
        port.send(b"II\n")
        kinds = [port.reply()[:2] for _ in range(6)]
        assert kinds.count(b"II") == 1 and kinds.count(b"MD") == 5
        port.send(b"BM\n")
        answers = [port.reply() for _ in range(4)]
        assert b"BM\n02R\n\n" in answers
        port.send(b"MS0044072599000\n")  # another stream takes its place
        while not (answer := port.reply()).startswith(b"MS"):
            assert answer.startswith(b"MD0299046901000\n99b\n")
        assert answer == b"MS0044072599000\n00P\n\n"
        echo, _, _, *rest = port.reply().split(b"\n")
        assert echo == b"MS0044072599000"
        least = [min(TRUE[k : k + 99]) for k in range(0, 682, 99)]
        assert decoded(body(rest[:-2]), 2) == least
        port.send(b"RS\n")
        while (answer := port.reply()) != b"RS\n00P\n\n":
            assert answer.startswith(b"MS")
        assert not device.laser


def test_what_it_does_not_know_is_answered(device):
    with Raw(device.port) as port:
        for request in (
            b"%ST",
            b"ME0044072501000",
            b"RB",
            b"AR00",
            b"V",
            b"G00076801",
            b"hello",
            b"\xff\x00",
        ):
            port.send(request + b"\n")
            assert port.reply() == request + b"\n0Ee\n\n"
        port.send(b"x" * 5000 + b"\n")
        assert port.reply().endswith(b"\n0Ee\n\n")
        port.send(b"QT\n")
        assert port.reply() == b"QT\n00P\n\n"


def test_clients_one_after_the_other(device):
    """One leaves in the middle of a stream without reading, one in the middle of a request."""
    with Raw(device.port) as port:
        port.send(b"MD0044072501000\n")
        time.sleep(0.3)
    with Raw(device.port) as port:
        port.send(b"\nMD0044")
    for _ in range(2):
        with serial.Serial(device.port, 19200, timeout=2.0, exclusive=True) as port:
            port.reset_input_buffer()
            port.write(b"\nQT\n")
            heard = b""
            while not heard.endswith(b"QT\n00P\n\n"):
                more = port.read(1)
                assert more, heard[-100:]
                heard += more
            port.write(b"VV\n")
            assert port.read(7) == b"VV\n00P\n"
    assert not device.laser


def test_a_client_that_had_the_port_for_itself_and_left(device):
    import fcntl

    with Raw(device.port) as port:
        fcntl.ioctl(port.fd, termios.TIOCEXCL)
        port.send(b"QT\n")
        port.reply()
    time.sleep(0.1)
    with Raw(device.port) as port:
        if sys.platform == "linux":  # root is let in anyway: ask (TIOCGEXCL)
            assert not fcntl.ioctl(port.fd, 0x80045440, b"\0" * 4)[0]
        port.send(b"QT\n")
        assert port.reply() == b"QT\n00P\n\n"


def test_an_old_device_is_told_to_speak_scip_2():
    """QT answered by E, then SCIP2.0 answered by 0, then all as usual."""
    old = MODELS["urg-04lx"]
    with (
        Emulator([np.array(TRUE)], speed=10.0, identity=old.identity, scip1=old.scip1) as device,
        Raw(device.port) as port,
    ):
        port.send(b"QT\n")
        assert port.reply() == b"QT\nE\n\n"
        port.send(b"SCIP2.0\n")
        assert port.reply() == b"SCIP2.0\n0\n\n"
        port.send(b"QT\n")
        assert port.reply() == b"QT\n00P\n\n"


@pytest.mark.parametrize("name", sorted(MODELS))
def test_every_model_streams_its_whole_field(name):
    model = MODELS[name]
    has = model.parameters
    values = np.arange(has.amax - has.amin + 1) + 20
    with (
        Emulator([values], parameters=has, identity=model.identity, scip1=model.scip1) as device,
        Raw(device.port) as port,
    ):
        port.send(b"SCIP2.0\n")
        port.reply()
        port.send(b"PP\n")
        answer = dict(line[:-2].split(b":") for line in port.reply().split(b"\n")[2:-2])
        first, last = int(answer[b"AMIN"]), int(answer[b"AMAX"])
        port.send(b"MD%04d%04d01003\n" % (first, last))
        port.reply()
        stamps = []
        for _ in range(3):
            _, _, stamp, *rest = port.reply().split(b"\n")
            stamps.append(decoded(stamp[:-1], 4)[0])
            assert decoded(body(rest[:-2]), 3) == values.tolist()
        assert np.diff(stamps) == pytest.approx(60_000 / int(answer[b"SCAN"]), abs=1.0)
