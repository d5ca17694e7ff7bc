"""Figures of the search: look-up tables level by level (the paper's figures 2 to 4), methods side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bimfit.geometry.pose import Array
from bimfit.report.style import GREY, INK, SERIES, heading, legend, new_figure, plain_axes, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class TableLevel:
    """A look-up table at one level.

    Attributes
    ----------
    values : ndarray, shape (rows, columns)
        Row 0 is the lowest v, column 0 the lowest u.
    extent : tuple of 4 float
        u from, u to, v from, v to, m: the outer edges of the cells.
    label : str
        Such as ``level 3: 27 mm``.
    points : ndarray, shape (n, 2), or None
        The scan at the best pose of this level, m, in the table's frame.
    start : ndarray, shape (n, 2), or None
        The scan before the search.
    """

    values: Array
    extent: tuple[float, float, float, float]
    label: str = ""
    points: Array | None = None
    start: Array | None = None


def plot_tables(
    path: str | Path, levels: Sequence[TableLevel], *, title: str = "Look-up tables and search"
) -> Path:
    """Draw the tables from the coarsest to the finest, with the best pose found at each.

    Parameters
    ----------
    path : str or Path
    levels : sequence of TableLevel
        Drawn as given, over the extent of the last.

    Raises
    ------
    ExportError
        When it cannot be written.
    """
    u0, u1, v0, v1 = levels[-1].extent
    shape = min(max((v1 - v0) / max(u1 - u0, 1e-9), 0.1), 1.4)
    # Flat tables lie one under the other, square ones side by side.
    columns = min(len(levels), 1 if shape < 0.35 else 3)
    rows = -(-len(levels) // columns)
    panel = 8.0 if columns == 1 else 3.5
    size = (panel * columns + 0.6, (0.88 * panel * shape + 0.55) * rows + 0.5)
    figure = new_figure(*size, layout="compressed")
    grid = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    image = None
    top = max(float(level.values.max()) for level in levels)
    for ax, level in zip(grid, levels, strict=False):
        u0, u1, v0, v1 = (1e3 * x for x in level.extent)
        image = ax.imshow(
            level.values,
            extent=(u0, u1, v0, v1),
            origin="lower",
            cmap="Blues",
            vmin=0.0,
            vmax=1.15 * top,
            interpolation="nearest",
            aspect="equal",
        )
        _cell_lines(ax, level)
        if level.start is not None:
            ax.plot(
                *(level.start * 1e3).T, ls="none", marker=".", ms=2.0, color=GREY, label="scan, expected pose"
            )
        if level.points is not None:
            ax.plot(
                *(level.points * 1e3).T,
                ls="none",
                marker=".",
                ms=3.0,
                color="#c0392b",
                label="scan, best pose",
            )
        ax.set_xlim(*(1e3 * x for x in levels[-1].extent[:2]))
        ax.set_ylim(*(1e3 * x for x in levels[-1].extent[2:]))
        plain_axes(ax, x="u (mm)", y="v (mm)", grid=False)
        heading(ax, level.label)
    for ax in grid[len(levels) :]:
        ax.set_visible(False)
    if image is not None:
        bar = figure.colorbar(image, ax=list(grid), shrink=0.7, pad=0.01, aspect=30)
        bar.set_label("score of a return in the cell", fontsize=8.5, color=INK)
        bar.ax.tick_params(labelsize=8, colors=INK)
        bar.outline.set_visible(False)
    handles, labels = grid[len(levels) - 1].get_legend_handles_labels()
    if handles:
        figure.legend(
            handles,
            labels,
            loc="outside upper right",
            ncols=len(handles),
            markerscale=2.5,
            fontsize=8,
            frameon=False,
            labelcolor=INK,
        )
    heading(figure, title)
    return save(figure, path)


def _cell_lines(ax: Axes, level: TableLevel) -> None:
    """Dashed cell borders, as in the paper's figure 3, where cells are wide enough to be told apart."""
    rows, columns = level.values.shape
    if max(rows, columns) > 40:
        return
    u0, u1, v0, v1 = (1e3 * x for x in level.extent)
    style: dict[str, Any] = {"color": GREY, "lw": 0.5, "ls": (0, (3, 3)), "alpha": 0.7}
    for u in np.linspace(u0, u1, columns + 1):
        ax.axvline(u, **style)
    for v in np.linspace(v0, v1, rows + 1):
        ax.axhline(v, **style)


@dataclass(frozen=True)
class MethodOutcome:
    """How a method did on a set of slices.

    Attributes
    ----------
    errors : ndarray, shape (n,)
        Position errors, m; NaN where it gave no pose.
    seconds : ndarray, shape (n,)
        Time a slice.
    """

    errors: Array
    seconds: Array


def plot_comparison(
    path: str | Path,
    methods: Mapping[str, MethodOutcome],
    *,
    lost: float = 0.010,
    title: str = "Methods on the same slices",
) -> Path:
    """Draw each method's errors as a cumulated share, its time a slice, and how often it was lost.

    Parameters
    ----------
    path : str or Path
    methods : mapping of str to MethodOutcome
    lost : float
        Errors beyond this count as lost, m.

    Raises
    ------
    ExportError
        When it cannot be written.
    ValueError
        Without a method or a slice.
    """
    if not methods or any(not len(o.errors) or not len(o.seconds) for o in methods.values()):
        raise ValueError("a comparison needs at least one method and one slice")
    figure = new_figure(10.0, 0.42 * len(methods) + 3.0)
    share, times, failures = figure.subplots(1, 3, width_ratios=(1.7, 1.0, 0.8))
    names = list(methods)
    colours = {name: SERIES[k % len(SERIES)] for k, name in enumerate(names)}
    for k, (name, outcome) in enumerate(methods.items()):
        found = np.sort(outcome.errors[np.isfinite(outcome.errors)]) * 1e3
        n = max(len(outcome.errors), 1)
        share.step(
            np.maximum(found, 1e-3),
            100.0 * np.arange(1, len(found) + 1) / n,
            where="post",
            color=colours[name],
            lw=1.8,
            ls=("-", (0, (5, 1.5)))[k // len(SERIES) % 2],
            label=name,
        )
    share.axvline(lost * 1e3, color=GREY, lw=0.9, ls=(0, (3, 3)))
    share.text(lost * 1e3 * 1.06, 3, "lost", fontsize=8, color=GREY, rotation=90, va="bottom")
    share.set_xscale("log")
    share.set_ylim(0, 102)
    share.xaxis.set_major_formatter("{x:g}")
    plain_axes(share, x="position error (mm)", y="slices with at most that error (%)")
    heading(share, "Accuracy")
    legend(share, loc="lower left" if len(names) < 5 else "upper left", ncols=1)
    place = np.arange(float(len(names)))[::-1]
    paint = [colours[name] for name in names]
    spread = np.array([np.percentile(o.seconds, (5.0, 50.0, 95.0)) * 1e3 for o in methods.values()])
    _bars(times, place, spread[:, 1], spread[:, 2], paint, "{:.3g} ms")
    times.hlines(place, spread[:, 0], spread[:, 2], color=INK, lw=1.0)
    times.set_xscale("log")
    times.set_xlim(0.3 * float(spread.min()), 12.0 * float(spread.max()))
    times.xaxis.set_major_formatter("{x:g}")
    times.set_yticks(place, names)
    plain_axes(times, x="time a slice (ms)")
    heading(times, "Speed: median, 5 to 95 %")
    bad = np.array([100.0 * float(np.mean(~(o.errors <= lost))) for o in methods.values()])
    _bars(failures, place, bad, bad, paint, "{:.1f} %")
    failures.set_xlim(0.0, max(1.0, 1.45 * float(bad.max())))
    failures.set_yticks(place, [""] * len(names))
    plain_axes(failures, x="slices (%)")
    heading(failures, f"Over {lost * 1e3:g} mm or no pose")
    heading(figure, title)
    return save(figure, path)


def _bars(ax: Axes, place: Array, values: Array, ends: Array, colours: Sequence[str], text: str) -> None:
    """Bars with their value written beyond ``ends``."""
    ax.barh(place, values, height=0.62, color=list(colours), alpha=0.85)
    for y, value, end in zip(place, values, ends, strict=True):
        ax.annotate(
            text.format(value),
            (end, y),
            (4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=INK,
        )
