"""How to read a scan file: the options that every command with a scan shares."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import typer

from bimfit.cli.options import length
from bimfit.cli.sharing import shared_options
from bimfit.errors import ConfigError

if TYPE_CHECKING:
    from bimfit.scan.formats.options import ReadOptions

HEADING = "How the scan is read"
READING: dict[str, tuple[Any, Any]] = {
    "scan_unit": (
        str | None,
        typer.Option(
            None,
            "--scan-unit",
            metavar="UNIT",
            help="Unit of its lengths: m, mm, cm, ft, usft or in.",
            rich_help_panel=HEADING,
        ),
    ),
    "topic": (
        str,
        typer.Option(
            "",
            "--topic",
            metavar="NAME",
            rich_help_panel=HEADING,
            help="Which topic of a ROS bag, where it has several.",
        ),
    ),
    "frame": (
        str,
        typer.Option(
            "",
            "--frame",
            metavar="NAME",
            rich_help_panel=HEADING,
            help="In which frame of a ROS bag; default: the one above all.",
        ),
    ),
    "pixel": (
        str | None,
        typer.Option(
            None,
            "--pixel",
            rich_help_panel=HEADING,
            metavar="ACROSS,ALONG[,UP]",
            help="Of height maps and profile tables: distance between columns and between rows, and height "
            "of a count, such as 0.1mm,0.1mm,0.005mm.",
        ),
    ),
}


def reading(command: Callable[..., int]) -> Callable[..., int]:
    """Give a command the options of reading a scan, as one argument ``how`` (ReadOptions)."""
    return shared_options(command, "how", READING, read_options)


def read_options(*, scan_unit: str | None, topic: str, frame: str, pixel: str | None) -> ReadOptions:
    """What the options say of a scan file.

    Raises
    ------
    BimfitError
        For a unit or a size that is none.
    """
    from bimfit.scan.formats.options import ReadOptions, unit_named

    return ReadOptions(
        unit=None if scan_unit is None else unit_named(scan_unit),
        topic=topic,
        frame=frame,
        pixel=(None, None, None) if pixel is None else _pixel(pixel),
    )


def _pixel(text: str) -> tuple[float | None, float | None, float | None]:
    parts = text.split(",")
    if len(parts) not in (2, 3):
        raise ConfigError(f"--pixel {text}: wants two or three sizes", remedy="such as 0.1mm,0.1mm,0.005mm")
    sizes = [length(part, "--pixel") for part in parts]
    return sizes[0], sizes[1], sizes[2] if len(sizes) == 3 else None
