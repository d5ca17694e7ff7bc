"""What a driver has seen go right and wrong."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Counters:
    """What has happened since the driver was made.

    Attributes
    ----------
    sweeps : int
        Delivered.
    damaged : int
        Scans that came broken, twice, or out of order, and were not delivered.
    missing : int
        Turns that should have come, by the device's own clock, and were not delivered: the damaged ones and
        those of which nothing came. Turns while the device was unplugged are not known and not counted.
    noise : int
        Pieces of the stream that were neither reply nor scan.
    unplugged, silent : int
        How often the port went away, and how often the device fell silent and was started anew.
    """

    sweeps: int = 0
    damaged: int = 0
    missing: int = 0
    noise: int = 0
    unplugged: int = 0
    silent: int = 0
