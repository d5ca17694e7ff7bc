"""Recorded SCIP dialogues: bytes that a device once sent, with or without their times, as sweeps."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, replace
from pathlib import Path

from bimfit.errors import ScanError, SensorError
from bimfit.sensor.clock import SCAN_PHASE, StampUnwrapper
from bimfit.sensor.models import UG01, Identity
from bimfit.sensor.replies import Damaged, Reply, ReplyParser, ScanReply, fields
from bimfit.sensor.scip import Parameters
from bimfit.sensor.sweep import Sweep

_HEADER = struct.Struct(">III")  # seconds, microseconds, number of bytes
_LONGEST = 1 << 16
_SAID = {
    "vendor": "VEND",
    "product": "PROD",
    "firmware": "FIRM",
    "protocol": "PROT",
    "serial": "SERI",
    "model": "MODL",
    "speed": "SCSP",
    "mode": "MESM",
    "baud": "SBPS",
    "status": "STAT",
}


def read_log(path: str | Path) -> list[tuple[float, bytes]]:
    """Read what was received, and when (s).

    Parameters
    ----------
    path : path
        A log of records (big-endian seconds, microseconds and length, each 32 bits, then the bytes), or the
        bare bytes, whose time is not known and NaN.

    Raises
    ------
    ScanError
        When the file cannot be read.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise ScanError(f"cannot be read: {error.strerror}", file=path) from error
    return _records(data)


def looks_like_dialogue(head: bytes) -> bool:
    """Whether a file that starts so holds answers of a SCIP 2.0 device."""
    said = b"".join(data for _, data in _records(head))
    return b"\n00P\n" in said or b"\n99b\n" in said


def _records(data: bytes) -> list[tuple[float, bytes]]:
    records: list[tuple[float, bytes]] = []
    at = 0
    while at < len(data):
        if at + _HEADER.size > len(data):
            return records or [(math.nan, data)]
        seconds, micros, length = _HEADER.unpack_from(data, at)
        at += _HEADER.size
        # A log that was cut off keeps what is whole; what does not look like a log at its start is none.
        if micros >= 1_000_000 or not 0 < length <= _LONGEST or at + length > len(data):
            return records or [(math.nan, data)]
        records.append((seconds + micros * 1e-6, data[at : at + length]))
        at += length
    return records


@dataclass(frozen=True)
class Speaker:
    """The device that a dialogue was recorded from, as far as it says.

    Attributes
    ----------
    identity : Identity or None
        None where it does not say who it is.
    parameters : Parameters or None
        None where it does not tell its geometry.
    lit : bool
        Whether its laser was on from the beginning.
    """

    identity: Identity | None = None
    parameters: Parameters | None = None
    lit: bool = False


def read_speaker(path: str | Path) -> Speaker:
    """Read who speaks in a recorded dialogue (:func:`read_log`); nothing of it has to be there.

    Raises
    ------
    ScanError
        When the file cannot be read.
    """
    said: dict[str, str] = {}
    lit: bool | None = None
    parser = ReplyParser()
    for event in (event for _, data in read_log(path) for event in parser.feed(data)):
        if isinstance(event, ScanReply):
            # GD is only answered while the laser is on; MD switches it on.
            lit = (not event.request.streams) if lit is None else lit
        elif isinstance(event, Reply) and event.status == "00" and event.name in ("VV", "PP", "II"):
            try:
                found = fields(event)
            except SensorError:
                continue
            lit = found["LASR"] == "ON" if lit is None and "LASR" in found else lit
            said = {**found, **said}
        elif isinstance(event, Reply) and lit is None and event.name == "BM":
            lit = event.status == "02"
    try:
        parameters = Parameters.from_fields(said)
    except SensorError:
        parameters = None
    known = {name: said[key] for name, key in _SAID.items() if key in said}
    identity = replace(UG01, **known) if "PROD" in said else None
    return Speaker(identity, parameters, bool(lit))


def read_dialogue(path: str | Path, parameters: Parameters | None = None) -> tuple[Sweep, ...]:
    """Read the whole scans of a recorded dialogue; every sum is checked.

    Parameters
    ----------
    path : path
        See :func:`read_log`.
    parameters : Parameters, optional
        Geometry of the device, where the dialogue has no PP reply; a URG-04LX by default.

    Raises
    ------
    ScanError
        When the file cannot be read or has no whole scan.
    """
    found, parser, unwrap = parameters or Parameters(), ReplyParser(), StampUnwrapper()
    sweeps: list[Sweep] = []
    broken = 0
    for time, data in read_log(path):
        for event in parser.feed(data):
            if isinstance(event, ScanReply):
                stamp, began = unwrap(event.stamp) / 1000.0, time - SCAN_PHASE * found.period
                sweeps.append(
                    Sweep.from_values(len(sweeps), event.values, event.request, found, stamp, began)
                )
            elif isinstance(event, Damaged):
                broken += 1
            elif event.name == "PP" and parameters is None:
                try:
                    found = Parameters.from_fields(fields(event))
                except SensorError:
                    broken += 1
    if not sweeps:
        what = f"{broken} damaged pieces and no whole scan" if broken else "no scan"
        raise ScanError(f"not a SCIP dialogue, or one without ranges: {what}", file=path)
    return tuple(sweeps)
