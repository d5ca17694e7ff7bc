"""A joint's figures along it, against what they may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bimfit.geometry.pose import Array
from bimfit.report.style import (
    ESTIMATE,
    GREY,
    INK,
    SCAN,
    STATUS,
    heading,
    legend,
    new_figure,
    plain_axes,
    save,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BAND = 2.0


@dataclass(frozen=True)
class LimitSeries:
    """One figure along a joint.

    Attributes
    ----------
    label : str
        Without its unit.
    s : ndarray, shape (n,)
        Stations, m.
    value, sigma : ndarray, shape (n,)
        m; NaN where not known.
    status : sequence of str
        A status a station.
    designed : float
        m; NaN where not known.
    low, high : float
        The limits, m; infinite where there is none.
    """

    label: str
    s: Array
    value: Array
    sigma: Array
    status: Sequence[str]
    designed: float = float("nan")
    low: float = float("-inf")
    high: float = float("inf")

    @property
    def outside(self) -> Array:
        """Whether a station is out of the limits, shape (n,)."""
        return np.asarray((self.value < self.low) | (self.value > self.high))


def plot_limits(
    path: str | Path,
    series: Sequence[LimitSeries],
    *,
    picture: Path | None = None,
    title: str = "",
    width: float = 8.0,
) -> Path:
    """Draw figures along a joint with their limits, below a picture of it.

    Parameters
    ----------
    path : str or Path
        PNG, SVG or PDF by its suffix.
    series : sequence of LimitSeries
    picture : Path, optional
        A PNG to show above.
    title : str
    width : float
        Inches.

    Raises
    ------
    ExportError
        When it cannot be written.
    """
    from matplotlib import rc_context

    rows = len(series) + (picture is not None)
    ratios = ([2.2] if picture is not None else []) + [1.0] * len(series)
    figure = new_figure(width, 1.7 * sum(ratios) + 0.4)
    axes = figure.subplots(rows, 1, squeeze=False, gridspec_kw={"height_ratios": ratios})[:, 0]
    if picture is not None:
        from matplotlib.image import imread

        axes[0].imshow(imread(picture))
        axes[0].set_axis_off()
    drawn = axes[rows - len(series) :]
    for ax, one in zip(drawn, series, strict=True):
        _draw(ax, one)
    plain_axes(drawn[-1], x="distance along the joint (mm)")
    legend(
        drawn[0],
        loc="upper left",
        ncols=8,
        bbox_to_anchor=(0.0, 1.24),
        columnspacing=1.2,
        handlelength=1.6,
        borderaxespad=0.0,
    )
    heading(figure, title)
    with rc_context({"svg.fonttype": "none"}):  # letters as text: a third of the size
        return save(figure, path)


def _draw(ax: Axes, series: LimitSeries) -> None:
    s, value = series.s * 1e3, series.value * 1e3
    band = _BAND * series.sigma * 1e3
    if np.isfinite(band).any():
        ax.fill_between(s, value - band, value + band, color=ESTIMATE, alpha=0.18, lw=0, label="± 2 sigma")
    ax.plot(s, value, color=ESTIMATE, lw=1.4, marker=".", ms=3, label="as built")
    if np.isfinite(series.designed):
        ax.axhline(series.designed * 1e3, color=GREY, lw=1.0, ls=(0, (4, 2)), label="designed")
    limits = [limit for limit in (series.low, series.high) if np.isfinite(limit)]
    for k, limit in enumerate(limits):
        ax.axhline(limit * 1e3, color=SCAN, lw=1.1, label="" if k else "limit")
    out = series.outside
    if out.any():
        ax.plot(s[out], value[out], ls="", marker="o", ms=5, mfc="none", mec=SCAN, label="out of limits")
    ends = [x for x in (*value, *(1e3 * limit for limit in limits)) if np.isfinite(x)] or [0.0, 1.0]
    margin = 0.12 * max(max(ends) - min(ends), 1.0)
    ax.set_ylim(min(ends) - margin, max(ends) + margin)
    floor = ax.get_ylim()[0]
    for name, (colour, marker) in STATUS.items():
        lost = np.array([status == name for status in series.status]) & ~np.isfinite(value)
        if name != "ok" and lost.any():
            ax.plot(
                s[lost],
                np.full(int(lost.sum()), floor),
                ls="",
                marker=marker,
                color=colour,
                ms=5,
                clip_on=False,
                label=name.replace("_", " "),
            )
    plain_axes(ax, y=f"{series.label} (mm)")
    ax.margins(x=0.01)
    ax.tick_params(labelcolor=INK)
