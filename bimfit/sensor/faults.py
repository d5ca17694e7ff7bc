"""What goes wrong on the line, on demand. For the emulator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from bimfit.errors import ConfigError
from bimfit.sensor.scip import with_sum

Kind = Literal[
    "bad_sum",
    "flipped_byte",
    "dropped_byte",
    "doubled_byte",
    "truncated",
    "garbage",
    "silence",
    "unplug",
    "checking",
    "hardware",
]
KINDS: tuple[Kind, ...] = get_args(Kind)
PASSING: tuple[Kind, ...] = tuple(kind for kind in KINDS if kind != "hardware")
"""What a device recovers from by itself."""


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong.

    Attributes
    ----------
    at : float
        When, s of emulated time since the first scan was sent; the next one after that is hit.
    kind : str
        ``bad_sum``, ``flipped_byte``, ``dropped_byte``, ``doubled_byte``, ``truncated`` damage that scan;
        ``garbage`` puts noise ahead of it and leaves it whole; ``silence`` swallows everything for
        ``length``; ``unplug`` cuts the line in the middle of the scan and plugs the device in again after
        ``length``, switched off and on; ``checking`` and ``hardware`` send the status of a device that checks
        itself, or has found itself broken, in the scan's place.
    length : float
        How long silence and unplugging last, s of emulated time.
    """

    at: float
    kind: Kind
    length: float = 0.5

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigError(f"unknown fault {self.kind!r}", remedy="use one of " + ", ".join(KINDS))
        if not (self.at >= 0.0 and self.length >= 0.0):
            raise ConfigError("a fault's time and length are at least 0")


def now_and_then(every: float, seed: int) -> Iterator[Fault]:
    """Passing faults of all kinds without end, ``every`` seconds on average."""
    if not 0.0 < every < np.inf:
        raise ConfigError(f"faults every {every:g} s: must be more than 0")
    return _without_end(every, seed)


def _without_end(every: float, seed: int) -> Iterator[Fault]:
    rng = np.random.default_rng(seed)
    at = 0.0
    while True:
        at += float(rng.uniform(0.5, 1.5)) * every
        yield Fault(at, PASSING[int(rng.integers(len(PASSING)))], float(rng.uniform(0.1, 0.9)))


def damage(scan: bytes, kind: Kind, rng: np.random.Generator) -> bytes:
    """A scan's bytes as they arrive after the fault; silence and unplugging are not of the bytes."""
    k = int(rng.integers(len(scan)))
    if kind == "bad_sum":
        status = scan.index(b"\n") + 1
        ends = [i - 1 for i in range(status, len(scan) - 1) if scan[i] == 0x0A]
        k = ends[int(rng.integers(len(ends)))]
        wrong = 0x30 + (scan[k] - 0x30 + int(rng.integers(1, 64))) % 64
        return scan[:k] + bytes((wrong,)) + scan[k + 1 :]
    if kind == "flipped_byte":
        return scan[:k] + bytes((scan[k] ^ int(rng.integers(1, 256)),)) + scan[k + 1 :]
    if kind == "dropped_byte":
        return scan[:k] + scan[k + 1 :]
    if kind == "doubled_byte":
        # Not the first byte, nor the line ends at the end: those harm nothing.
        k = int(rng.integers(1, len(scan) - 2))
        return scan[: k + 1] + scan[k:]
    if kind == "truncated":
        return scan[:k]
    if kind in ("checking", "hardware"):
        return scan.partition(b"\n")[0] + b"\n" + with_sum(b"21" if kind == "checking" else b"72") + b"\n\n"
    if kind == "garbage":
        return rng.bytes(int(rng.integers(1, 200))) + scan
    return scan
