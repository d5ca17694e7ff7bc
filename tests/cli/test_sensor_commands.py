"""``capture``, ``emulate`` and ``live`` as a user runs them, with real processes on pseudo-terminals."""

from __future__ import annotations

import json
import os
import select
import signal
import struct
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bimfit.cli.main import main
from bimfit.cli.options import read_pose
from bimfit.pipeline.live import LEFT_OUT
from bimfit.scan.formats import read_scan
from bimfit.sensor.emulator import Emulator
from bimfit.sensor.faults import Fault
from bimfit.sensor.noise import NO_NOISE
from bimfit.simulation.truth import read_truth

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals")

SAMPLE = "square-butt-ifc4.ifc"
WALL = np.linspace(500, 2000, 682).round().astype(int)
WALL[:7] = [0, 6, 7, 18, 19, 20, 5600]


def bimfit(*words, **options):
    return subprocess.Popen(
        [sys.executable, "-m", "bimfit", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def ended(process, seconds=30):
    """Its exit status, and what it said."""
    try:
        out, err = process.communicate(timeout=seconds)
    finally:
        process.kill()
    assert "Traceback" not in err, err
    return process.returncode, out, err


@pytest.fixture(scope="module")
def emulated(tmp_path_factory):
    """A real ``bimfit emulate`` of the packaged sample: its port, its truth, and where it starts.

    A fault's time counts from the first scan on.
    """
    faults = ["--fault", "bad_sum@0.7", "--fault", "garbage@1.2", "--fault", "dropped_byte@1.9"]
    with emulating(tmp_path_factory.mktemp("emulate"), *faults) as running:
        yield running


@pytest.fixture
def sound(tmp_path):
    """The same without faults, still where it starts."""
    with emulating(tmp_path) as running:
        yield running


@contextmanager
def emulating(folder, *more):
    process = bimfit("emulate", "--seed", 11, "--truth", folder / "truth.json", *more)
    port = process.stdout.readline().rstrip("\n")
    (truth,) = read_truth(folder / "truth.json")
    assert process.stderr.readline().startswith(f"serves joint {truth.id} of {SAMPLE}")
    start = process.stderr.readline().removeprefix("starts at --scan-pose ").rstrip("\n")
    yield port, truth, start
    process.send_signal(signal.SIGINT)
    assert ended(process) == (0, "", "")
    assert not os.path.lexists(port)


def true_gap(truth, s):
    """Mouth width, and the mouth's middle in the section frame, between the stations about s."""
    at = [station.s for station in truth.stations]
    rows = []
    for station in truth.stations:
        off = station.gap.origin - station.frame.origin
        rows.append([station.gap.width_mouth, off @ station.frame.u, off @ station.frame.v])
    return np.array([np.interp(s, at, column) for column in np.array(rows).T])


def test_live_measures_what_is_true_while_things_go_wrong(emulated, samples, capsys):
    port, truth, _ = emulated
    words = ["--port", port, "--speed", "0.05", "--sweeps", "30", "--json"]
    assert main(["live", str(samples / SAMPLE), *words]) == 0
    out, said = capsys.readouterr()
    lines = [json.loads(line) for line in out.splitlines()]
    assert len(lines) == 30 and "30 sweeps measured" in said and "turns missing" in said
    lines = [line for line in lines if line["reason"] != LEFT_OUT]  # on a machine that has too much to do
    stamps = [line["stamp"] for line in lines]
    assert min(np.diff(stamps)) == pytest.approx(0.1) and sum(np.diff(stamps) > 0.15) >= 2
    # Sweeps that are lost do not shift those behind them: the stamps say where the sensor was.
    np.testing.assert_allclose(
        [line["s"] for line in lines], 0.05 * (np.array(stamps) - stamps[0]), atol=1e-3
    )
    good = [line for line in lines if line["status"] == "ok"]
    assert len(good) >= 0.85 * len(lines) > 8
    errors = np.array([[line["width"], line["u"], line["v"]] - true_gap(truth, line["s"]) for line in good])
    assert np.all(np.abs(errors).mean(axis=0) < [0.0012, 0.0008, 0.0015]), np.abs(errors).mean(axis=0)
    sigmas = np.array([[line["sigma"][name] for name in ("width", "u", "v")] for line in good])
    assert np.mean(np.abs(errors) < 3.0 * sigmas) > 0.9


def test_what_was_captured_replays_alike(sound, samples, tmp_path, capsys):
    port, truth, start = sound
    scan = tmp_path / "scan.npz"
    assert main(["capture", "--port", port, "--sweeps", "12", "--field", "30deg", "-o", str(scan)]) == 0
    assert capsys.readouterr().out == f"12 sweeps, {12 * 171} beams: {scan}\n"
    words = ["live", str(samples / SAMPLE), "--replay", str(scan)]
    assert main(words) == 2
    assert "does not say how it moves; --speed" in capsys.readouterr().err
    # A trajectory by the host's clock, of a robot that holds the sensor 0.1 m under its own origin.
    first = next(read_scan(scan).split())
    begun = first.extra["time"][first.extra["step"] == 384][0]
    pose, arm = read_pose(start), np.eye(4)
    arm[0, 3] = 0.1  # ahead of the body's x axis
    body = pose @ np.linalg.inv(arm)
    quaternion = Rotation.from_matrix(body[:3, :3]).as_quat()
    way = tmp_path / "way.tum"
    rows = [(begun + t, *(body[:3, 3] + 0.05 * t * body[:3, 2]), *quaternion) for t in (-1.0, 0.5, 3.0)]
    np.savetxt(way, rows, fmt="%.9f", header="time x y z qx qy qz qw")
    assert main([*words, "--trajectory", str(way), "--scan-pose", "0.1,0,0,0,0,0"]) == 0
    out, said = capsys.readouterr()
    rows = [line.split() for line in out.splitlines()[1:]]
    good = [row for row in rows if row[7] == "ok"]
    assert len(rows) == 12 and len(good) >= 9 and f"{len(good)} of 12 sweeps measured" in said
    np.testing.assert_allclose([float(row[1]) for row in rows], 5.0 * np.arange(12), atol=1.0)
    errors = [float(row[2]) - 1e3 * true_gap(truth, 1e-3 * float(row[1]))[0] for row in good]
    assert np.abs(errors).mean() < 1.5


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_a_recording_holds_what_the_device_sent(suffix, tmp_path, capsys):
    path = tmp_path / f"scan{suffix}"
    with Emulator([WALL, WALL[::-1]], speed=5.0, noise=NO_NOISE) as device:
        assert main(["capture", "--port", device.port, "--sweeps", "5", "-o", str(path)]) == 0
        assert not device.laser
    scan = read_scan(path)
    assert len(scan.sweeps) == 5 and not scan.origins.any()
    for k, sweep in enumerate(scan.split()):
        sent = WALL if sweep.extra["code"][5] == WALL[5] else WALL[::-1]
        assert sweep.extra["code"].tolist() == sent.tolist(), k
        measured = (sent >= 20) & (sent <= 5600)
        np.testing.assert_array_equal(sweep.ranges, np.where(measured, sent / 1000, np.nan))
        assert sweep.extra["step"].tolist() == list(range(44, 726))
        bearings = np.arctan2(sweep.directions[:, 1], sweep.directions[:, 0])
        np.testing.assert_allclose(bearings, (np.arange(44, 726) - 384) * 2 * np.pi / 1024, atol=1e-9)
        delays = sweep.extra["time"] - sweep.extra["time"][0]
        np.testing.assert_allclose(delays, (np.arange(44, 726) - 44) / 10240, atol=1e-6)
    # Served again, it is the same scan to the bit, whatever the name of the file.
    again = tmp_path / "again.npz"
    served = bimfit("emulate", path, "--pace", "5")
    try:
        port = served.stdout.readline().rstrip("\n")
        assert main(["capture", "--port", port, "--sweeps", "7", "-o", str(again)]) == 0
    finally:
        served.send_signal(signal.SIGTERM)
        assert ended(served)[0] == 0
    codes = [tuple(sweep.extra["code"].tolist()) for sweep in read_scan(again).split()]
    assert set(codes) == {tuple(WALL.tolist()), tuple(WALL[::-1].tolist())}
    capsys.readouterr()


def test_a_recording_of_a_moving_sensor_in_the_model(tmp_path):
    """Beams start where the sensor was at their own time: it looks ahead at the given pose, then goes on."""
    path, pose = tmp_path / "scan.npz", "458657,5438232,3,0,1.5707963267948966,0"
    with Emulator([WALL], speed=5.0, noise=NO_NOISE) as device:
        words = ["capture", "--port", device.port, "--sweeps", "4", "--speed", "50mm/s", "--scan-pose", pose]
        assert main([*words, "-o", str(path)]) == 0
    scan = read_scan(path)
    time = scan.extra["time"]
    ahead = scan.extra["step"] == 384
    # Turned a quarter about y: the sensor's z axis is the world's x axis, and what lay ahead is below.
    way = 0.05 * (time - time[ahead][0])
    np.testing.assert_allclose(scan.origins[:, 0], 458657 + way, atol=2e-8)
    assert set(scan.origins[:, 1]) == {5438232.0} and set(scan.origins[:, 2]) == {3.0}
    np.testing.assert_allclose(scan.directions[ahead], [[0.0, 0.0, -1.0]] * 4, atol=1e-12)
    assert scan.origins[ahead][0, 0] == 458657.0 and np.all(np.diff(scan.origins[ahead][:, 0]) > 0.001)


def test_the_recorded_dialogue_over_a_real_port(shared):
    """Sent what the recorded client wrote, when it did, the device says what it said, but for its clock."""
    written, read = (recorded(shared / "scip" / f"example_urg_04lx.log{letter}") for letter in "wr")
    served = bimfit("emulate", shared / "scip" / "example_urg_04lx.logr")
    try:
        port = os.open(served.stdout.readline().rstrip("\n"), os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        begin, heard = time.monotonic(), b""
        for at, data in [*written, (written[-1][0] + 2.0, b"")]:
            while (left := begin + at - written[0][0] - time.monotonic()) > 0:
                if select.select([port], [], [], left)[0]:
                    heard += os.read(port, 4096)
                if b"\nGD" in heard and heard.endswith(b"\n\n"):
                    break
            os.write(port, data)
        os.close(port)
    finally:
        served.send_signal(signal.SIGINT)
        assert ended(served)[0] == 0

    def told(data):
        lines = data.split(b"\n")
        clock = [
            k for k, line in enumerate(lines) if line.startswith(b"TIME:") or lines[k - 2].startswith(b"GD")
        ]
        return [b"clock" if k in clock else line for k, line in enumerate(lines)], len(clock)

    assert told(heard) == told(b"".join(data for _, data in read))
    assert told(heard)[1] == 3


def test_the_start_is_told_to_the_micrometre_at_map_coordinates(capsys):
    from bimfit.cli.emulate import _announce
    from bimfit.pipeline.emulate import Emulation

    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([1.2, -0.3, 2.1]).as_matrix()
    T[:3, 3] = [458657.123456, 5438232.654321, -0.0]
    _announce("port", Emulation([], "nothing", T))
    out, said = capsys.readouterr()
    told = said.splitlines()[-1].removeprefix("starts at --scan-pose ")
    assert out == "port\n" and told.startswith("458657.123456,5438232.654321,0,")
    np.testing.assert_allclose(read_pose(told), T, rtol=0.0, atol=2e-8)


def recorded(path):
    data, records, at = path.read_bytes(), [], 0
    while at < len(data):
        seconds, micros, length = struct.unpack(">III", data[at : at + 12])
        records.append((seconds + micros * 1e-6, data[at + 12 : at + 12 + length]))
        at += 12 + length
    return records


def first_sweeps(device, count=3):
    deadline = time.monotonic() + 20
    while len(device.log) < count:
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 0), (signal.SIGTERM, 0), (signal.SIGHUP, 0), (signal.SIGKILL, -9)]
)
def test_signals_put_the_laser_out_and_keep_what_is_whole(number, status, tmp_path):
    if signal.getsignal(number) is signal.SIG_IGN:
        pytest.skip("the tests were started to ignore this signal (nohup), and so are their processes")
    path = tmp_path / "scan.csv"
    with Emulator([WALL], noise=NO_NOISE) as device:
        process = bimfit("capture", "--port", device.port, "-o", path)
        first_sweeps(device)
        assert device.laser
        process.send_signal(number)
        found, out, _ = ended(process)
        deadline = time.monotonic() + 5.0  # a killed process leaves it to another one
        while device.laser and time.monotonic() < deadline:
            time.sleep(0.02)
        assert not device.laser and found == status
    (left,) = tmp_path.iterdir()
    scan = read_scan(left)
    assert len(scan.sweeps) >= 2
    if number == signal.SIGKILL:  # what it had is there, under a name that says so
        assert left.name == "scan.part.csv" and "not finished" in scan.notes[0]
    else:
        assert left == path and len(scan) == 682 * len(scan.sweeps) and f"{len(scan.sweeps)} sweeps" in out


def test_a_device_that_goes_for_good_leaves_what_came_before(tmp_path, capsys):
    path = tmp_path / "scan.npz"
    with Emulator([WALL], speed=5.0, faults=[Fault(2.0, "hardware")]) as device:
        assert main(["capture", "--port", device.port, "-o", str(path)]) == 2
        assert not device.laser
    said = capsys.readouterr()
    assert "hardware trouble 72; the sweeps that came before are kept" in said.err
    assert len(read_scan(path).sweeps) >= 5


def test_nothing_comes_of_nothing(tmp_path, capsys):
    path = tmp_path / "scan.npz"
    with Emulator([WALL], faults=[Fault(0.0, "hardware")]) as device:
        assert main(["capture", "--port", device.port, "-o", str(path)]) == 2
    assert "hardware trouble" in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["capture", "-o", "scan.foo"], "scan.foo: a line scan cannot be written as .foo; use .csv, .npz"),
        (["capture", "-o", "scan.csv", "--port", "nothing"], "nothing: no such port; "),
        (["capture", "-o", "scan.csv", "--port", "/dev/null"], "/dev/null: this is not a serial port; "),
        (["capture", "-o", "scan.csv", "--seconds", "0"], "--seconds 0: must be more than 0"),
        (["capture", "-o", "scan.csv", "--field", "190mm"], "--field 190mm: not a number with a unit"),
        (["emulate", "--device", "sick"], "--device sick: unknown; choose from ug01"),
        (["emulate", "--left", "broken"], "--left broken: unknown; choose from resting"),
        (["emulate", "--fault", "fire@3"], "--fault fire@3: not a fault; KIND@S[:S] of bad_sum"),
        (["emulate", "--fault-every", "-1"], "must be more than 0"),
        (["emulate", "--pace", "0"], "must be positive"),
        (["emulate", "nothing.csv"], "nothing.csv: cannot be read"),
        (["emulate", "scan.csv", "--truth", "t.json"], "--truth is for models"),
        (["live", "nothing.ifc", "--speed", "0.05"], "nothing.ifc: cannot be read"),
        (["live", "MODEL"], "does not say how it moves"),
        (["live", "MODEL", "--speed", "5mm", "--height", "0"], "--height must be more than 0"),
        (["live", "MODEL", "--replay", "x.csv", "--port", "y"], "exclude one another"),
        (["live", "MODEL", "--replay", "nothing.csv"], "nothing.csv: cannot be read"),
        (["live", "MODEL", "--speed", "0.05", "--joint", "none"], "no joint has the id none"),
    ],
)
def test_bad_usage_is_one_clear_line(words, message, samples, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([str(samples / SAMPLE) if word == "MODEL" else word for word in words]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("bimfit: ") and message in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())
