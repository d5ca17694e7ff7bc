"""``--limits``: what a joint may measure."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from bimfit.cli.choosing import length_range
from bimfit.cli.options import length
from bimfit.errors import ConfigError

if TYPE_CHECKING:
    from bimfit.pipeline.limits import Limits

HELP = "What a joint may measure, such as width=12..30mm,step=3mm; also root, narrowest and deviation."
_EITHER_WAY = ("step", "deviation")


def read_limits(text: str) -> Limits:
    """Limits such as ``width=12..30mm,step=3mm``: a range, or for step and deviation how far either way.

    Raises
    ------
    ConfigError
        Naming what cannot be read.
    """
    from bimfit.pipeline.limits import Limits

    known = [field.name for field in dataclasses.fields(Limits)]
    found: dict[str, tuple[float, float]] = {}
    for part in text.split(","):
        name, equals, value = (word.strip() for word in part.partition("="))
        if name not in known or not equals or not value:
            raise ConfigError(
                f"--limits {text}: {part.strip() or 'nothing'} is not a limit",
                remedy=f"write width=12..30mm,step=3mm; there are {', '.join(known)}",
            )
        if name in found:
            raise ConfigError(f"--limits {text}: {name} is there twice")
        found[name] = _range(name, value)
    return Limits(**found)


def _range(name: str, value: str) -> tuple[float, float]:
    option = f"--limits {name}"
    if name in _EITHER_WAY and ".." not in value:
        either = length(value, option)
        if either < 0.0:
            raise ConfigError(f"{option}={value}: is less than 0", remedy="write 3mm or -1..3mm")
        return -either, either
    return length_range(value, option)
