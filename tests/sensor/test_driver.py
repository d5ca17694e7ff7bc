"""The driver against the emulator: every state it may find a device in, and everything that goes wrong."""

import math
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from bimfit.errors import ConfigError, SensorError
from bimfit.sensor import serial_port
from bimfit.sensor.emulator import Emulator
from bimfit.sensor.faults import KINDS, Fault
from bimfit.sensor.hokuyo import Hokuyo
from bimfit.sensor.models import URG_04LX
from bimfit.sensor.noise import NO_NOISE

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals")

FAST = math.inf
RANGES = np.linspace(0.5, 2.0, 682).round(3)


def scene(bearings):
    return RANGES


def emulated(**options):
    return Emulator(scene, **{"speed": FAST, "noise": NO_NOISE, **options})


def use(port, **options):
    return Hokuyo(port, **{"timeout": 5.0, "synchronise": False, **options})


def shell(port, data):
    """Write to a port and leave, as a program that crashes."""
    descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)
    os.write(descriptor, data)
    time.sleep(0.05)
    os.close(descriptor)


def test_sweeps_are_what_the_scene_shows():
    with emulated() as device, use(device.port) as rangefinder:
        assert rangefinder.version["FIRM"] == "3.4.03(17/Dec./2012)"
        sweeps = list(rangefinder.scans(299, 469, count=5))
        assert not device.laser
    assert [sweep.index for sweep in sweeps] == list(range(5))
    for sweep in sweeps:
        np.testing.assert_array_equal(sweep.ranges, RANGES[299 - 44 : 470 - 44])
        assert sweep.bearings[85] == 0.0 and sweep.bearings[0] == pytest.approx(-math.tau * 85 / 1024)
    np.testing.assert_allclose(np.diff([sweep.stamp_device for sweep in sweeps]), 0.1, atol=1e-9)
    assert rangefinder.counters.sweeps == 5 and rangefinder.counters.missing == 0
    assert rangefinder.counters.damaged == rangefinder.counters.noise == 0


def test_single_scans_clusters_short_values_and_skipped_turns():
    with emulated() as device, use(device.port) as rangefinder:
        one = rangefinder.scan()
        np.testing.assert_array_equal(one.ranges, RANGES)
        assert device.laser
        rangefinder.laser_off()
        assert not device.laser
        grouped = list(rangefinder.scans(44, 725, cluster=3, skip=2, count=3, short=True))
        np.testing.assert_array_equal(grouped[0].ranges, RANGES[::3])
        np.testing.assert_array_equal(grouped[0].steps[:2], [45.0, 48.0])
        np.testing.assert_allclose(np.diff([sweep.stamp_device for sweep in grouped]), 0.3, atol=1e-9)
        assert rangefinder.counters.missing == 0
        rangefinder.set_motor_speed(0)
        rangefinder.set_motor_speed(5)
        rangefinder.set_high_sensitivity(True)
        rangefinder.set_baud(115200)
        rangefinder.reset()
        with pytest.raises(SensorError, match="CR55: invalid value"):
            rangefinder.set_motor_speed(55)
        with pytest.raises(SensorError, match="beyond the device's last"):
            next(rangefinder.scans(0, 726))


@pytest.mark.parametrize(
    "left",
    [
        b"MD0044072501000\n",  # streaming
        b"MS0044072501000\nMD004407",  # streaming, and in the middle of a request
        b"TM0\n",  # in the time mode
        b"BM\nVV",
        b"\xff\x00garbage",
        b"",
    ],
)
@pytest.mark.parametrize("late_scan", [False, True])
def test_start_on_a_device_left_anyhow(left, late_scan):
    with emulated(speed=30.0, late_scan=late_scan) as device:
        shell(device.port, left)
        with use(device.port) as rangefinder:
            assert not device.laser
            assert len(list(rangefinder.scans(count=2))) == 2
        assert not device.laser


def test_start_in_scip_1_1():
    with emulated(scip1=True, identity=URG_04LX) as device, use(device.port) as rangefinder:
        assert rangefinder.version["SERI"] == "H0706400"
        assert len(list(rangefinder.scans(count=2))) == 2


def test_start_on_a_slow_device():
    with emulated(speed=1.0, wait=1.2) as device, use(device.port) as rangefinder:
        assert rangefinder.parameters.ares == 1024


def test_questions_do_not_disturb_a_stream():
    with emulated(speed=20.0) as device, use(device.port) as rangefinder:
        stamps = []
        for sweep in rangefinder.scans(count=20):
            stamps.append(round(sweep.stamp_device * 1000))
            if sweep.index % 3 == 0:
                assert rangefinder.state()["LASR"] == "ON"
                assert rangefinder.query("VV", string="hello 1").echo == "VV;hello 1"
        assert np.diff(stamps).tolist() == [100] * 19
        assert rangefinder.counters.missing == rangefinder.counters.damaged == 0
        assert rangefinder.device_seconds() * 1000 >= stamps[-1]


def test_questions_from_another_thread():
    with emulated(speed=20.0) as device, use(device.port) as rangefinder:
        answers, stop = [], threading.Event()

        def ask():
            while not stop.is_set():
                answers.append(rangefinder.state()["STAT"])

        thread = threading.Thread(target=ask)
        stamps = []
        for sweep in rangefinder.scans(count=40):
            if sweep.index == 0:
                thread.start()
            stamps.append(round(sweep.stamp_device * 1000))
        stop.set()
        thread.join()
        assert np.diff(stamps).tolist() == [100] * 39 and len(answers) > 3


def test_stamps_are_on_the_hosts_clock():
    """Paced like the device, with a clock about to wrap; the emulator knows when each turn really began."""
    start = (1 << 24) - 1500
    with emulated(speed=1.0, clock=start) as device, use(device.port, synchronise=True) as rangefinder:
        sweeps = list(rangefinder.scans(count=12))
        began = time.time() - device.seconds
    device_seconds = np.array([sweep.stamp_device for sweep in sweeps])
    np.testing.assert_allclose(np.diff(device_seconds), 0.1, atol=1e-9)
    assert device_seconds[0] * 1000 < 1 << 24 < device_seconds[-1] * 1000
    errors = [sweep.stamp_host - (began + sweep.stamp_device - start / 1000.0) for sweep in sweeps]
    assert np.max(np.abs(errors)) < 0.05


DAMAGE = [kind for kind in KINDS if kind not in ("checking", "hardware")]


def test_ten_minutes_with_a_fault_every_few_seconds():
    """Every intact sweep comes once, every damaged one is counted."""
    rng = np.random.default_rng(5)
    faults, at = [], 3.0
    while at < 600.0:
        faults.append(Fault(at, DAMAGE[int(rng.integers(len(DAMAGE)))], float(rng.uniform(0.1, 0.9))))
        at += float(rng.uniform(2.0, 6.0))
    got = []
    with emulated(faults=faults, seed=5) as device, use(device.port) as rangefinder:
        boot = 0
        for sweep in rangefinder.scans(299, 469):
            boot = rangefinder.counters.unplugged
            got.append((boot, round(sweep.stamp_device * 1000)))
            np.testing.assert_array_equal(sweep.codes, np.rint(RANGES[255:426] * 1000))
            if device.seconds > 600.0:
                break
        counters = rangefinder.counters
        log = list(device.log)
    assert len(got) > 5000
    last = max(k for k, sent in enumerate(log) if (sent.boot, sent.stamp) == got[-1])
    sent = log[: last + 1]
    assert got == [(scan.boot, scan.stamp) for scan in sent if not scan.fault]
    lost = [scan for scan in sent if scan.fault]
    unplugged = sum(scan.fault == "unplug" for scan in lost)
    assert counters.unplugged == unplugged > 5
    # What is lost shows in the device's stamps, but for the scan during which the cable was pulled.
    assert counters.missing == len(lost) - unplugged
    # A scan cut off within its echo leaves too little to be told from noise; what came in behind the last
    # sweep taken is counted already.
    broken = sum(scan.fault not in ("silence", "truncated") for scan in lost)
    behind = sum(scan.fault not in ("", "silence") for scan in log[last + 1 :])
    truncated = sum(scan.fault == "truncated" for scan in lost)
    assert broken <= counters.damaged <= broken + truncated + behind
    assert counters.noise >= sum(fault.kind == "garbage" for fault in faults) - 1
    assert counters.silent == 0


def test_a_device_that_checks_itself_goes_on():
    with emulated(faults=[Fault(1.0, "checking")]) as device, use(device.port) as rangefinder:
        stamps = [round(sweep.stamp_device * 1000) for sweep in rangefinder.scans(count=30)]
        assert stamps[-1] - stamps[0] == 3000 and rangefinder.counters.missing == 1
        assert rangefinder.counters.damaged == 0


def test_broken_hardware_is_told():
    with emulated(faults=[Fault(1.0, "hardware")]) as device, use(device.port) as rangefinder:
        with pytest.raises(SensorError, match="hardware trouble 72"):
            list(rangefinder.scans(count=30))
        assert not device.laser


def test_the_laser_switched_off_by_hand_ends_the_stream():
    with emulated(speed=20.0) as device, use(device.port) as rangefinder:
        taken = 0
        for sweep in rangefinder.scans():
            taken += 1
            with pytest.raises(SensorError, match="a stream is running"):
                rangefinder.scan()
            with pytest.raises(SensorError, match="a stream is running"):
                next(rangefinder.scans())
            with pytest.raises(SensorError, match=r"use scan\(\)"):
                rangefinder.query("GD", "0044072501")
            if sweep.index == 3:
                rangefinder.laser_off()
        assert taken == 4 and not device.laser
        assert len(list(rangefinder.scans(count=2))) == 2


def test_silence_starts_the_device_anew():
    with (
        emulated(speed=20.0, faults=[Fault(1.5, "silence", 30.0)]) as device,
        use(device.port) as rangefinder,
    ):
        sweeps = list(rangefinder.scans(count=30))
        assert len({sweep.stamp_device for sweep in sweeps}) == 30
        assert rangefinder.counters.silent == 1 and rangefinder.counters.unplugged == 0


def test_silence_for_good():
    faults, told = [Fault(1.5, "silence", 1e6)], pytest.raises(SensorError, match="fell silent")
    with emulated(speed=20.0, faults=faults) as device, use(device.port, timeout=0.3) as rangefinder, told:
        list(rangefinder.scans(count=100))


def test_unplugged_for_good():
    with emulated(speed=20.0, faults=[Fault(3.0, "unplug", 1e6)]) as device:
        with (
            use(device.port, reconnect=0.3) as rangefinder,
            pytest.raises(SensorError, match="not back within"),
        ):
            list(rangefinder.scans(count=100))
        assert rangefinder.counters.unplugged == 1 and rangefinder.counters.damaged == 1


def test_unplugged_while_asked():
    with emulated(speed=FAST, faults=[Fault(0.0, "unplug", 1e6)]) as device, use(device.port) as rangefinder:
        with pytest.raises(SensorError, match="was unplugged"):
            rangefinder.scan()
        with pytest.raises(SensorError, match="was unplugged"):
            rangefinder.state()


@pytest.mark.parametrize("way", ["break", "error", "close", "generator"])
def test_the_laser_is_off_on_every_way_out(way):
    with emulated(speed=20.0) as device:
        rangefinder = use(device.port)
        rangefinder.open()
        if way == "break":
            for _ in rangefinder.scans():
                assert device.laser
                break
            assert not device.laser
        elif way == "error":
            with pytest.raises(ZeroDivisionError), rangefinder:
                for _ in rangefinder.scans():
                    raise ZeroDivisionError
        elif way == "close":
            rangefinder.laser_on()
            assert device.laser
        else:
            stream = rangefinder.scans()
            next(stream)
            assert device.laser
            stream.close()
            assert not device.laser
        rangefinder.close()
        rangefinder.close()
        assert not device.laser
        with pytest.raises(SensorError, match="not open"):
            rangefinder.state()


PROGRAM = """
import sys, time
from bimfit.sensor.hokuyo import Hokuyo
from bimfit.sensor.models import URG_04LX
def run(device):
    for sweep in device.scans():
        print("sweep", flush=True)
if sys.argv[2] == "exit":
    device = Hokuyo(sys.argv[1], synchronise=False)
    device.open()
    device.laser_on()
    print("sweep", flush=True)
    sys.exit(3)
with Hokuyo(sys.argv[1], synchronise=False) as device:
    run(device)
"""


@pytest.mark.parametrize(
    ("how", "status"), [(signal.SIGINT, -signal.SIGINT), (signal.SIGTERM, 128 + signal.SIGTERM), ("exit", 3)]
)
def test_the_laser_is_off_after_a_signal_or_exit(how, status):
    if how != "exit" and signal.getsignal(how) is signal.SIG_IGN:
        pytest.skip("the tests were started to ignore this signal, as in the background of a shell")
    with emulated(speed=5.0) as device:
        program = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, device.port, str(how)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        try:
            assert program.stdout.readline() == b"sweep\n"
            if how != "exit":
                assert device.laser
                program.send_signal(how)
            assert program.wait(20) == status
        finally:
            program.kill()
            program.stdout.close()
            program.wait()
        assert not device.laser


def test_no_such_port(tmp_path):
    with pytest.raises(SensorError, match=r"ttyNONE: no such port; (ports there|there is no)"):
        use(str(tmp_path / "ttyNONE")).open()


def test_no_rangefinder_plugged_in(monkeypatch):
    from serial.tools import list_ports

    class Port:
        def __init__(self, device, vid):
            self.device, self.vid = device, vid

    monkeypatch.setattr(list_ports, "comports", lambda: [Port("/dev/ttyUSB0", 0x0403)])
    with pytest.raises(SensorError, match=r"no Hokuyo.*name the port; ports there: /dev/ttyUSB0"):
        Hokuyo().open()
    monkeypatch.setattr(list_ports, "comports", lambda: [Port("b", 0x15D1), Port("a", 0x15D1)])
    with pytest.raises(SensorError, match="several rangefinders: a, b"):
        Hokuyo().open()
    monkeypatch.setattr(list_ports, "comports", lambda: [Port("c", 0x15D1), Port("x", None)])
    assert serial_port.find_port() == "c"


def test_no_permission(monkeypatch):
    import errno

    import serial

    def refuse(*args, **kwargs):
        raise serial.SerialException(errno.EACCES, "could not open port: Permission denied")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(SensorError, match=r"no permission.*usermod -aG \w+ \$USER, and log in again"):
        use("/dev/null").open()


def test_the_port_is_busy():
    busy = pytest.raises(SensorError, match="another program uses the port; close it")
    with emulated() as device, use(device.port), busy:
        use(device.port).open()


def test_not_a_serial_port(tmp_path):
    (tmp_path / "file").write_text("x")
    for path in (tmp_path / "file", "/dev/null"):
        with pytest.raises(SensorError, match="not a serial port"):
            use(str(path)).open()


@pytest.mark.parametrize("words", [b"", b"$GPGGA,123519,4807.038,N*47\r\n", None])
def test_the_wrong_device(words):
    import pty
    import tty

    master, slave = pty.openpty()
    tty.setraw(slave)
    stop = threading.Event()

    def talk():
        os.set_blocking(master, False)
        while not stop.is_set():
            try:
                heard = os.read(master, 100)
            except BlockingIOError:
                heard = b""
            os.write(master, heard if words is None else words)  # None: an echo
            time.sleep(0.02)

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        message = "nothing answers.*power" if words == b"" else "no SCIP 2.0 rangefinder.*another port"
        with pytest.raises(SensorError, match=message):
            use(os.ttyname(slave), timeout=0.3).open()
    finally:
        stop.set()
        thread.join()
        os.close(master)
        os.close(slave)


def test_a_scene_that_fails_is_named():
    def broken(bearings):
        raise RuntimeError("no such wall")

    named = pytest.raises(SensorError, match="no such wall")
    with named, Emulator(broken, speed=FAST) as device, use(device.port, timeout=0.5, reconnect=0) as found:
        list(found.scans(count=1))


def test_wrong_settings_of_the_emulator(tmp_path):
    with pytest.raises(ConfigError, match="speed"):
        emulated(speed=0.0)
    with pytest.raises(ConfigError, match="unknown fault"):
        Fault(1.0, "fire")
    (tmp_path / "taken").touch()
    with pytest.raises(SensorError, match="cannot be made"):
        emulated(link=tmp_path / "taken").start()
    with emulated(link=tmp_path / "ttyX") as device:
        assert device.port == str(tmp_path / "ttyX")
    assert not (tmp_path / "ttyX").exists()


def test_windows_has_no_emulator(monkeypatch):
    device = emulated()
    monkeypatch.setattr(os, "name", "nt")
    with pytest.raises(SensorError, match="Windows"):
        device.start()


ELSEWHERE = """
import signal, sys
for name in ("fcntl", "termios", "pty", "tty", "grp", "pwd"):
    sys.modules[name] = None  # as on Windows
del signal.SIGHUP
import bimfit.cli.main, bimfit.pipeline.capture, bimfit.pipeline.emulate, bimfit.pipeline.live
import bimfit.sensor.emulator, bimfit.sensor.hokuyo
print("imported")
"""


def test_all_of_it_is_imported_where_there_are_no_pseudo_terminals():
    done = subprocess.run(
        [sys.executable, "-c", ELSEWHERE], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.stdout == "imported\n", done.stderr
