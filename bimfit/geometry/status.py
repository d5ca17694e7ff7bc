"""What became of a station: a value with a reason, never an exception and never an identity pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

StatusName = Literal["ok", "ambiguous", "weak", "rejected", "no_data"]


@dataclass(frozen=True)
class Status:
    """The verdict on one station.

    Attributes
    ----------
    name : {"ok", "ambiguous", "weak", "rejected", "no_data"}
    reason : str
        In plain words; empty only for ``ok``.
    """

    name: StatusName = "ok"
    reason: str = ""

    def __post_init__(self) -> None:
        if self.name != "ok" and not self.reason:
            raise ValueError(f"status {self.name} needs a reason")

    @property
    def measured(self) -> bool:
        """Whether there is a number to report at all."""
        return self.name in ("ok", "ambiguous", "weak")


OK = Status()
