"""How bimfit's pictures look: one palette, one set of axes, one way of writing a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from bimfit.errors import ExportError
from bimfit.files import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Ink, from the strongest to the faintest.
INK, GREY, FAINT = "#1f2933", "#7b8794", "#d9dee4"
#: Components A and B, the estimate, the gap, the scan, what never returned.
SIDE_A, SIDE_B, ESTIMATE, GAP, SCAN, MISSING = (
    "#3f6fa3",
    "#b8743a",
    "#1f5fa8",
    "#f2b134",
    "#c0392b",
    "#c9a9a4",
)
#: One colour a status; shapes differ, too, for those who do not tell colours apart.
STATUS = {
    "ok": ("#1f5fa8", "o"),
    "ambiguous": ("#8e44ad", "D"),
    "weak": ("#d98e04", "s"),
    "rejected": ("#c0392b", "X"),
    "no_data": ("#9aa5b1", "|"),
}
SERIES = ("#1f5fa8", "#d9822b", "#2e8b57", "#8e44ad", "#c0392b", "#5f6b7a", "#b59a00", "#17879c")


def new_figure(
    width: float, height: float, *, layout: Literal["constrained", "compressed"] = "constrained"
) -> Figure:
    """A figure in inches, drawn by Agg whatever backend the caller has."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=150, layout=layout, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def plain_axes(axes: Axes, *, x: str = "", y: str = "", grid: bool = True) -> None:
    """Take away what says nothing: two spines, the ticks' marks, dark grid lines."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GREY)
    axes.tick_params(colors=INK, labelsize=8.5, length=3, color=GREY)
    if grid:
        axes.grid(True, color=FAINT, linewidth=0.6)
        axes.set_axisbelow(True)
    if x:
        axes.set_xlabel(x, fontsize=9, color=INK)
    if y:
        axes.set_ylabel(y, fontsize=9, color=INK)


def heading(owner: Any, text: str, *, size: float = 11.0) -> None:
    """A title on the left of a figure or of axes."""
    if not text:
        return
    if hasattr(owner, "suptitle"):
        owner.suptitle(text, x=0.01, ha="left", fontsize=size + 1.5, color=INK, fontweight="bold")
    else:
        owner.set_title(text, loc="left", fontsize=size - 1.5, color=INK)


def legend(axes: Axes, **options: Any) -> None:
    """A legend, where there is anything to explain."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(**{"fontsize": 8, "frameon": False, "labelcolor": INK, **options})


def save(figure: Figure, path: str | Path, *, formats: Sequence[str] = ("png", "svg", "pdf")) -> Path:
    """Write a figure whole or not at all; the suffix names the format.

    Raises
    ------
    ExportError
        For another suffix or a place that cannot be written.
    """
    target = Path(path)
    kind = target.suffix.lower().lstrip(".")
    if kind not in formats:
        raise ExportError(
            f"no picture format is called {target.suffix!r}", file=target, remedy=f"use {', '.join(formats)}"
        )
    # No date and no version: the same figure gives the same bytes.
    metadata = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[kind]
    with whole_file(target) as part:
        figure.savefig(part, format=kind, metadata=metadata, bbox_inches="tight", pad_inches=0.12)
    return target
