"""A report as one HTML file that needs nothing else: no network, no other file."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bimfit.files import write_text

_TEMPLATES = Path(__file__).with_name("templates")
_PICTURE_WIDTH, _PICTURE_QUALITY = 1000, 82


@dataclass(frozen=True)
class Tile:
    """A number at the top of the page, and what it counts."""

    label: str
    value: str


@dataclass(frozen=True)
class Heading:
    """A column of the schedule."""

    name: str
    unit: str = ""
    number: bool = True


@dataclass(frozen=True)
class Cell:
    """A cell of the schedule."""

    text: str
    number: bool = True


@dataclass(frozen=True)
class Piece:
    """A station on the strip of statuses, in thousandths of the joint's length."""

    x: str
    width: str
    colour: str


@dataclass(frozen=True)
class Stretch:
    """Neighbouring stations of one status that is not ok, for one reason; mm along the joint."""

    start: str
    end: str
    count: int
    status: str
    reason: str


@dataclass(frozen=True)
class Picture:
    """A picture as a data URI."""

    data: str
    caption: str


@dataclass(frozen=True)
class JointPage:
    """What the report says of a joint, ready to be set: all texts are escaped by the template.

    Attributes
    ----------
    id, anchor, verdict, heading : str
    cells : sequence of Cell
        Its row in the schedule, after id and verdict.
    lines : sequence of str
        Sentences.
    figures : sequence of (str, str)
    strip : sequence of Piece
    key : sequence of (str, str, int)
        Status, colour and how many stations.
    stretches : sequence of Stretch
    plot : str
        Data URI of the figures along the joint; empty for none.
    model : str
        The gap and its elements for the viewer, see :mod:`bimfit.report.viewer`; empty for none.
    pictures : sequence of Picture
    """

    id: str
    anchor: str
    verdict: str
    heading: str
    cells: Sequence[Cell]
    lines: Sequence[str]
    figures: Sequence[tuple[str, str]]
    strip: Sequence[Piece]
    key: Sequence[tuple[str, str, int]]
    stretches: Sequence[Stretch]
    plot: str = ""
    model: str = ""
    pictures: Sequence[Picture] = ()


@dataclass(frozen=True)
class Page:
    """The whole report.

    Attributes
    ----------
    title, limits : str
    about : sequence of (str, str)
    tiles : sequence of Tile
    notes : sequence of str
    columns : sequence of Heading
    joints : sequence of JointPage
    script : str
        Of the viewer; empty where no joint has a model.
    """

    title: str
    about: Sequence[tuple[str, str]]
    tiles: Sequence[Tile]
    limits: str
    notes: Sequence[str]
    columns: Sequence[Heading]
    joints: Sequence[JointPage]
    script: str = ""


def write_html(page: Page, path: Path) -> Path:
    """Write a report, whole or not at all.

    Raises
    ------
    ExportError
        When it cannot be written.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    settings = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    settings.filters["code"] = Markup  # the page's own script, which no input reaches
    write_text(path, settings.get_template("report.html.j2").render(page=page))
    return path


def embedded(data: bytes, kind: str) -> str:
    """Bytes as a data URI of a media type."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def embedded_picture(path: Path) -> str:
    """A picture file as a data URI, made smaller where it is larger than a page shows."""
    from PIL import Image

    with Image.open(path) as picture:
        small = picture.convert("RGB")
        if small.width > _PICTURE_WIDTH:
            height = round(small.height * _PICTURE_WIDTH / small.width)
            small = small.resize((_PICTURE_WIDTH, height), Image.Resampling.LANCZOS)
        stream = io.BytesIO()
        small.save(stream, "JPEG", quality=_PICTURE_QUALITY, optimize=True)
    return embedded(stream.getvalue(), "image/jpeg")
