"""Which joints: the options that ``joints``, ``fit``, ``compare`` and ``simulate`` share."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bimfit.cli.options import length
from bimfit.cli.sharing import shared_options
from bimfit.errors import ConfigError

if TYPE_CHECKING:
    from bimfit.bim.selection import Selection

_RANGE = re.compile(r"(.*?)\.\.(.*)")
_UNIT = re.compile(r"[a-zA-Z]+\s*$")

_OPTIONS: dict[str, tuple[Any, Any]] = {
    "joint": (
        list[str],
        typer.Option([], "--joint", metavar="ID|GUID,GUID", help="A joint by name; may be repeated."),
    ),
    "pairs": (
        Path | None,
        typer.Option(
            None,
            "--pairs",
            metavar="FILE.json",
            help='Joints by name: [["GUID", "GUID"], ...], or what bimfit joints --json prints.',
        ),
    ),
    "ifc_class": (
        list[str],
        typer.Option(
            [],
            "--class",
            metavar="IFCCLASS",
            help="Between elements of this class (subclasses count); may be repeated.",
        ),
    ),
    "storey": (
        list[str],
        typer.Option(
            [], "--storey", metavar="NAME", help="Between elements in this storey; may be repeated."
        ),
    ),
    "width": (
        str | None,
        typer.Option(
            None,
            "--width",
            metavar="MIN..MAX",
            help="Designed gap, such as 5..30mm, 12mm.. or ..60mm; less than 0 where elements overlap.",
        ),
    ),
    "least_length": (
        str | None,
        typer.Option(None, "--length", "--min-length", metavar="MIN", help="Shortest joint, such as 500mm."),
    ),
    "select": (
        str | None,
        typer.Option(
            None,
            "--select",
            metavar="SELECTOR",
            help='Between elements that an IfcOpenShell selector finds, such as "IfcWall, Name=/W.*/".',
        ),
    ),
    "everything": (
        bool,
        typer.Option(False, "--all", help="Also cavities, parallel layers and contacts as short as deep."),
    ),
}


def choosing(command: Callable[..., int]) -> Callable[..., int]:
    """Give a command the options that choose joints, as one argument ``choice`` (a Selection)."""
    return shared_options(command, "choice", _OPTIONS, selection, "Which joints")


def selection(
    *,
    joint: list[str],
    pairs: Path | None,
    ifc_class: list[str],
    storey: list[str],
    width: str | None,
    least_length: str | None,
    select: str | None,
    everything: bool,
) -> Selection:
    """What the options ask for.

    Raises
    ------
    ConfigError
        For a value that cannot be used, naming its option.
    """
    from bimfit.bim.selection import Selection

    if select is not None and not select.strip():
        raise ConfigError("--select: is empty", remedy='write it as "IfcWall, Name=/W.*/"')
    shortest = None if least_length is None else length(least_length, "--length")
    if shortest is not None and shortest <= 0.0:
        raise ConfigError(f"--length {least_length}: a length is more than 0", remedy="write it as 500mm")
    return Selection(
        names=tuple(joint),
        pairs=pairs,
        classes=tuple(ifc_class),
        storeys=tuple(storey),
        width=None if width is None else length_range(width, "--width"),
        min_length=shortest,
        selector=select or "",
        everything=everything,
    )


def length_range(text: str, option: str) -> tuple[float, float]:
    """A range such as ``12..30mm``, ``12mm..`` or ``..0.03`` in metres; the last unit counts for both ends.

    Raises
    ------
    ConfigError
        Naming the option, when it is no range or runs backwards.
    """
    found = _RANGE.fullmatch(text.strip())
    low, high = (part.strip() for part in found.groups()) if found else ("", "")
    if not (low or high):
        raise ConfigError(f"{option} {text}: not a range", remedy="write it as 12..30mm, 12mm.. or ..30mm")
    unit = _UNIT.search(high)
    if low and unit and not _UNIT.search(low):
        low += unit.group()
    least = length(low, option) if low else -math.inf
    most = length(high, option) if high else math.inf
    if least > most:
        raise ConfigError(f"{option} {text}: runs backwards", remedy="write it as 12..30mm")
    return least, most
