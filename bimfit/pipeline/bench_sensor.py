"""The live sensor's figures: how late a line is, what damaged bytes do, ten minutes with faults."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bimfit.errors import SensorError
from bimfit.pipeline.emulate import model_emulation
from bimfit.pipeline.live import LEFT_OUT
from bimfit.pipeline.samples import sample_model
from bimfit.sensor import scip
from bimfit.sensor.clock import StampOrder
from bimfit.sensor.emulator import Emulator, Sent
from bimfit.sensor.faults import KINDS, Fault
from bimfit.sensor.hokuyo import Hokuyo
from bimfit.sensor.replies import ReplyParser, ScanReply
from bimfit.sensor.scip import IntArray, Parameters, ScanRequest
from bimfit.simulation.scenario import Scenario

Progress = Callable[[str, float], None]
STREAMS, SCANS = 10_000, 4
MINUTES = 10.0
REFERENCE = "square-butt-ifc4.ifc"
SPEED = 0.05


@dataclasses.dataclass(frozen=True)
class Figures:
    """What one measurement says: a line to print, and its numbers."""

    text: str
    data: dict[str, Any]


# -- how late a line is ----------------------------------------------------------------------------


def latency(seed: int, progress: Progress) -> Figures:
    """From the last byte that leaves an emulated device, 10 scans a second, to the line of ``bimfit live``.

    Measured from outside: the command runs as a process of its own on the reference joint from end to end.

    Raises
    ------
    SensorError
        When the command ends without a line.
    """
    model = sample_model(REFERENCE)
    scene = model_emulation(model, Scenario(), seed, speed=SPEED).scene
    arrivals: dict[int, float] = {}
    left_out = 0
    with Emulator(scene, seed=seed) as device:
        words = ["live", str(model), "--port", device.port, "--speed", str(SPEED), "--json"]
        command = [sys.executable, "-m", "bimfit", *words]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as live:
            assert live.stdout is not None and live.stderr is not None
            for line in live.stdout:
                arrived, value = time.monotonic(), json.loads(line)
                arrivals[round(value["stamp"] * 1000.0)] = arrived
                left_out += value["reason"] == LEFT_OUT
                progress("live", len(arrivals) / 165.0)
            said = live.stderr.read()
        left = {stamp: when for _, stamp, when in device.departures}
    if not arrivals:
        raise SensorError(f"live gave no line: {said.strip()}")
    late = np.array([when - left[stamp] for stamp, when in arrivals.items()])
    turns = round((max(arrivals) - min(arrivals)) / 100) + 1
    half, p95, most = (float(np.percentile(late, q)) for q in (50.0, 95.0, 100.0))
    text = (
        f"live, {len(late)} lines at 10 Hz: last byte to line {half * 1e3:.1f} ms median,"
        f" {p95 * 1e3:.1f} ms at 95 %, {most * 1e3:.1f} ms at most (asked: 100);"
        f" {turns - len(late)} turns without a line, {left_out} left out"
    )
    data = {"lines": len(late), "turns_without_line": turns - len(late), "left_out": left_out}
    return Figures(text, data | {"median_s": half, "p95_s": p95, "max_s": most})


# -- damaged bytes ---------------------------------------------------------------------------------


def fuzz(seed: int, progress: Progress, streams: int = STREAMS) -> Figures:
    """Streams of scans through the parser and the check of their stamps, injured once and several times.

    A scan counts as wrong when it is taken for one that was not sent: another range, or another stamp. A
    line's sum has six bits: two injuries in one line may agree with it by chance, which nothing else in the
    protocol shows; hence the second figure.
    """
    rng = np.random.default_rng(seed)
    once, often = (dict.fromkeys(("delivered", "lost", "twice", "wrong"), 0) for _ in range(2))
    slowest = 0.0
    for k in range(2 * streams):
        if k % 500 == 0:
            progress("damaged streams", 0.5 * k / streams)
        request, truth, data = _stream(rng)
        for _ in range(1 if k < streams else int(rng.integers(2, 7))):
            data = _injured(data, rng)
        begin = time.perf_counter()
        scans = _believed(request, data, int(rng.integers(1, 600)))
        slowest = max(slowest, time.perf_counter() - begin)
        found = once if k < streams else often
        right = [scan.stamp for scan in scans if truth.get(scan.stamp) == scan.values.tolist()]
        found["wrong"] += len(scans) - len(right)
        found["delivered"] += len(set(right))
        found["twice"] += len(right) - len(set(right))
        found["lost"] += len(truth) - len(set(right))
    said = [
        f"{streams} streams of {SCANS} scans injured {how}: {one['delivered']} scans delivered,"
        f" {one['lost']} lost, {one['twice']} twice, {one['wrong']} wrong{why}"
        for how, one, why in (
            ("once", once, ""),
            ("two to six times", often, " (their sums agree by chance)" if often["wrong"] else ""),
        )
    ]
    text = "\n".join([*said, f"no crash; {slowest * 1e3:.0f} ms for the slowest stream"])
    return Figures(text, {"streams": streams, "once": once, "often": often, "slowest_s": slowest})


def _stream(rng: np.random.Generator) -> tuple[ScanRequest, dict[int, list[int]], bytes]:
    """A request, the scans in answer to it by their stamps, and their bytes."""
    first = int(rng.integers(44, 300))
    last = first + int(rng.integers(30, 400))
    request = ScanRequest("MD" if rng.random() < 0.6 else "MS", first, last, int(rng.integers(1, 4)))
    stamp, data = int(rng.integers(1 << 24)), b""
    truth: dict[int, list[int]] = {}
    for _ in range(SCANS):
        walk = rng.uniform(300.0, 3000.0) + np.cumsum(rng.normal(0.0, 8.0, request.size))
        values: IntArray = np.rint(np.clip(walk, 20.0, 4095.0)).astype(np.int64)
        lost = rng.random(request.size) < 0.03
        values[lost] = rng.integers(0, 20, int(lost.sum()))
        truth[stamp] = values.tolist()
        head = [request.encode(), scip.with_sum(b"99"), scip.with_sum(scip.encode(stamp, 4))]
        data += b"\n".join(head) + b"\n" + scip.data_lines(scip.encode_values(values, request.width)) + b"\n"
        stamp = (stamp + 100 + int(rng.integers(-1, 2))) % (1 << 24)
    return request, truth, data


def _injured(data: bytes, rng: np.random.Generator) -> bytes:
    """One injury: a bit or a byte changed, lost or put in, or many of them lost, put in or sent twice."""
    if not data:
        return data
    k, kind, length = int(rng.integers(len(data))), int(rng.integers(8)), int(rng.integers(2, 300))
    if kind == 0:
        return data[:k] + bytes((data[k] ^ 1 << int(rng.integers(8)),)) + data[k + 1 :]
    if kind == 1:
        return data[:k] + bytes((data[k] ^ int(rng.integers(1, 256)),)) + data[k + 1 :]
    if kind == 2:
        return data[:k] + data[k + 1 :]
    if kind == 3:
        return data[:k] + rng.bytes(1) + data[k:]
    if kind == 4:
        return data[:k] + data[min(k + length, len(data) - 1) :]
    if kind == 5:
        return data[:k] + rng.bytes(length) + data[k:]
    if kind == 6:
        return data[:k] + data[max(k - length, 0) :]
    return data[: max(k, 1)]


def _believed(request: ScanRequest, data: bytes, piece: int) -> list[ScanReply]:
    """What a driver takes of the bytes, read in pieces of so many."""
    parser, order = ReplyParser(request), StampOrder(Parameters().period)
    events = [event for k in range(0, len(data), piece) for event in parser.feed(data[k : k + piece])]
    events += parser.flush()
    return [event for event in events if isinstance(event, ScanReply) and order.believes(event.stamp)]


# -- ten minutes with faults -----------------------------------------------------------------------


def faults(seed: int, progress: Progress, minutes: float = MINUTES) -> Figures:
    """A driver on an emulated device whose clock runs as fast as it is read, with a fault every few seconds.

    The cable is pulled again and again, too. Every scan that left whole has to come once.
    """
    got: list[tuple[int, int]] = []
    listed = _listed(seed, 60.0 * minutes)
    with Emulator(
        lambda bearings: 1.0 + 0.1 * np.abs(bearings), speed=math.inf, faults=listed, seed=seed
    ) as device:
        begin = time.perf_counter()
        with Hokuyo(device.port, synchronise=False) as rangefinder:
            for sweep in rangefinder.scans(299, 469):
                got.append((rangefinder.counters.unplugged, round(sweep.stamp_device * 1000.0)))
                if device.seconds > 60.0 * minutes:
                    break
                if sweep.index % 100 == 0:
                    progress("faults", device.seconds / (60.0 * minutes))
            counters = rangefinder.counters
        sent, took = list(device.log), time.perf_counter() - begin
    sent = sent[: 1 + max(k for k, scan in enumerate(sent) if _name(scan) == got[-1])]
    whole, broken = ([_name(scan) for scan in sent if bool(scan.fault) is lost] for lost in (False, True))
    pulled = sum(scan.fault == "unplug" for scan in sent)
    data = {
        "sent": len(sent),
        "whole": len(whole),
        "delivered": len(got),
        "once": len(set(got) & set(whole)),
        "wrongly_delivered": len(set(got) - set(whole)),
        "twice": len(got) - len(set(got)),
        "broken": len(broken),
        "counted": counters.missing + pulled,
        "counters": dataclasses.asdict(counters),
        "seconds": took,
    }
    text = (
        f"{minutes:g} emulated minutes with {len(listed)} faults: of {data['whole']} whole sweeps"
        f" {data['once']} delivered, {data['twice']} twice, and {data['wrongly_delivered']} broken ones;"
        f" of {data['broken']} broken or swallowed {data['counted']} counted ({counters.damaged} seen"
        f" damaged, {counters.unplugged} times unplugged); {took:.1f} s"
    )
    return Figures(text, data)


def _listed(seed: int, seconds: float) -> list[Fault]:
    rng = np.random.default_rng(seed)
    kinds = [kind for kind in KINDS if kind != "hardware"]
    found, at = [], 3.0
    while at < seconds:
        found.append(Fault(at, kinds[int(rng.integers(len(kinds)))], float(rng.uniform(0.1, 0.9))))
        at += float(rng.uniform(2.0, 6.0))
    return found


def _name(scan: Sent) -> tuple[int, int]:
    return scan.boot, scan.stamp
