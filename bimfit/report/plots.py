"""Figures of a joint: gap poses along it, and one of its slices (the paper's figures 4 to 7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bimfit.geometry.pose import Array
from bimfit.geometry.profile import Profile
from bimfit.geometry.slice import Slice
from bimfit.report.style import (
    ESTIMATE,
    GAP,
    GREY,
    INK,
    MISSING,
    SCAN,
    SIDE_A,
    SIDE_B,
    STATUS,
    heading,
    legend,
    new_figure,
    plain_axes,
    save,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class GapSeries:
    """A gap's figures along a joint; NaN where there is none.

    Attributes
    ----------
    s : ndarray, shape (n,)
        Stations, m.
    x, z : ndarray, shape (n,)
        The gap's origin across the joint and out of its mouth, relative to the design (u and v), m.
    angle : ndarray, shape (n,)
        Rad.
    volume : ndarray, shape (n,)
        Differential volume, m^3.
    sigma_x, sigma_z, sigma_angle, sigma_volume : ndarray, shape (n,), or None
        Standard deviations in the same units.
    """

    s: Array
    x: Array
    z: Array
    angle: Array
    volume: Array
    sigma_x: Array | None = None
    sigma_z: Array | None = None
    sigma_angle: Array | None = None
    sigma_volume: Array | None = None


def plot_gap_poses(
    path: str | Path,
    estimate: GapSeries,
    *,
    status: Sequence[str] = (),
    truth: GapSeries | None = None,
    title: str = "As-built gap along the joint",
) -> Path:
    """Draw x, z, angle and differential volume along the joint (the paper's figures 6 and 7).

    Parameters
    ----------
    path : str or Path
        PNG, SVG or PDF by its suffix.
    estimate : GapSeries
        Drawn with its band of two standard deviations.
    status : sequence of str
        A status a station; stations that are not ``ok`` are marked, those without an estimate on the axis.
    truth : GapSeries, optional
    title : str

    Raises
    ------
    ExportError
        When it cannot be written.
    """
    figure = new_figure(9.0, 8.2)
    axes = figure.subplots(4, 1, sharex=True)
    rows = (
        ("x  across (mm)", "x", 1e3),
        ("z  out of mouth (mm)", "z", 1e3),
        ("angle (°)", "angle", 180.0 / np.pi),
        ("volume a station (cm³)", "volume", 1e6),
    )
    names = np.array(status if len(status) else ["ok"] * len(estimate.s))
    for ax, (label, name, scale) in zip(axes, rows, strict=True):
        sigma = getattr(estimate, f"sigma_{name}")
        _band(
            ax, estimate.s, getattr(estimate, name) * scale, None if sigma is None else sigma * scale, names
        )
        if truth is not None:
            ax.plot(
                truth.s * 1e3,
                getattr(truth, name) * scale,
                color=INK,
                lw=1.0,
                ls=(0, (4, 2)),
                label="truth",
                zorder=3,
            )
        plain_axes(ax, y=label)
        ax.margins(x=0.01)
    plain_axes(axes[-1], x="distance along the joint (mm)")
    heading(figure, title)
    handles: dict[str, object] = {}
    for ax in axes:
        for handle, text in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(text, handle)
    axes[0].legend(
        list(handles.values()),
        list(handles),
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=len(handles),
        fontsize=8,
        frameon=False,
        labelcolor=INK,
        handlelength=1.6,
        columnspacing=1.2,
    )
    return save(figure, path)


def _band(
    ax: Axes,
    s: Array,
    value: Array,
    sigma: Array | None,
    names: np.ndarray[tuple[int, ...], np.dtype[np.str_]],
) -> None:
    mm = s * 1e3
    if sigma is not None and np.isfinite(sigma).any():
        ax.fill_between(
            mm, value - 2.0 * sigma, value + 2.0 * sigma, color=ESTIMATE, alpha=0.18, lw=0, label="± 2σ"
        )
    known = np.isfinite(value)
    if known.any():
        ax.plot(mm, value, color=ESTIMATE, lw=1.2, label="estimate", zorder=4)
    for name, (colour, marker) in STATUS.items():
        pick = (names == name) & known
        if pick.any():
            small = name == "ok"
            ax.plot(
                mm[pick],
                value[pick],
                ls="none",
                marker=marker,
                ms=2.4 if small else 5.0,
                color=colour,
                mec="white" if not small else colour,
                mew=0.4,
                zorder=5,
                label=None if small else name,
            )
        lost = (names == name) & ~known
        if lost.any():
            ax.plot(
                mm[lost],
                np.full(int(lost.sum()), 0.02),
                ls="none",
                marker=marker,
                ms=4.5,
                color=colour,
                transform=ax.get_xaxis_transform(),
                clip_on=False,
                label=f"{name}, no estimate",
                zorder=5,
            )


def plot_slice(
    path: str | Path,
    slice_: Slice,
    designed: Sequence[Profile],
    *,
    fitted: Sequence[Profile] = (),
    gap: Sequence[Array] = (),
    title: str = "",
    note: str = "",
    reach: float = 0.06,
) -> Path:
    """Draw one slice: what the sensor saw, the components as designed and as fitted, and their gap.

    Parameters
    ----------
    path : str or Path
    slice_ : Slice
        Its beams that returned nothing are drawn, too, where it knows them.
    designed, fitted : sequence of Profile
        Components A and B in the section frame.
    gap : sequence of ndarray, shape (k, 2)
        Open parts of the gap.
    title, note : str
        Above the drawing, and in its corner.
    reach : float
        The lower drawing shows this much to each side of the joint, m.

    Raises
    ------
    ExportError
        When it cannot be written.
    """
    figure = new_figure(9.0, 8.2, layout="compressed")
    whole, close = figure.subplots(2, 1, height_ratios=(1.0, 1.25))
    for ax, near in ((whole, False), (close, True)):
        _draw_beams(ax, slice_, 1.5 * reach if near else np.inf)
        _draw_profiles(ax, designed, fitted)
        for part in gap:
            ax.fill(
                *(part * 1e3).T,
                color=GAP,
                alpha=0.75,
                lw=0,
                zorder=2,
                label="as-built gap" if part is gap[0] else None,
            )
        ax.plot(
            *(slice_.points * 1e3).T,
            ls="none",
            marker=".",
            ms=6.5 if near else 4.0,
            color=SCAN,
            zorder=6,
            label="scan",
        )
        plain_axes(ax, x="u across the joint (mm)" if near else "", y="v out of the mouth (mm)")
        ax.set_aspect("equal", adjustable="box")
    _frame_close(close, slice_, designed, gap, reach)
    _fit_heights(figure, (whole, close))
    heading(figure, title)
    heading(whole, "The slice")
    heading(close, "The joint")
    legend(whole, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    if note:
        close.text(
            0.012,
            0.03,
            note,
            transform=close.transAxes,
            fontsize=8.5,
            color=INK,
            va="bottom",
            linespacing=1.5,
            zorder=9,
            bbox={"boxstyle": "round,pad=0.5", "fc": "white", "ec": GREY, "lw": 0.6, "alpha": 0.92},
        )
    return save(figure, path)


def _fit_heights(figure: Figure, axes: Sequence[Axes]) -> None:
    """Give drawings of true shape the same width, and the figure the height that they need."""
    shapes = []
    for ax in axes:
        (u0, u1), (v0, v1) = ax.get_xlim(), ax.get_ylim()
        shapes.append((v1 - v0) / (u1 - u0))
    grid = axes[0].get_gridspec()
    if grid is not None:
        grid.set_height_ratios(shapes)
    figure.set_size_inches(9.0, min(6.6 * sum(shapes) + 1.6, 14.0))


def _draw_profiles(ax: Axes, designed: Sequence[Profile], fitted: Sequence[Profile]) -> None:
    for profiles, style in ((designed, "designed"), (fitted, "fitted")):
        for profile, colour, name in zip(profiles, (SIDE_A, SIDE_B), "AB", strict=False):
            for n, loop in enumerate(profile.loops):
                ring = np.concatenate([loop, loop[:1]]) * 1e3
                label = f"{name} as {'designed' if style == 'designed' else 'fitted'}" if n == 0 else None
                if style == "designed":
                    ax.plot(*ring.T, color=colour, lw=0.9, ls=(0, (4, 2.5)), alpha=0.9, zorder=3, label=label)
                else:
                    ax.fill(*ring.T, color=colour, alpha=0.13, lw=0, zorder=1)
                    ax.plot(*ring.T, color=colour, lw=1.6, zorder=4, label=label)


def _draw_beams(ax: Axes, slice_: Slice, reach: float) -> None:
    from matplotlib.collections import LineCollection

    beams = slice_.beams
    if beams is None:
        return
    hit = beams.hit
    floor = float(slice_.points[:, 1].min()) - 0.03 if len(slice_.points) else -0.05
    for pick, colour, name in ((hit, SCAN, ""), (~hit, MISSING, "beam without a return")):
        start, along = beams.origins[pick], beams.directions[pick]
        length = beams.ranges[pick].copy()
        lost = ~np.isfinite(length)
        down = np.where(along[:, 1] < -1e-6, along[:, 1], -1e-6)
        # A beam that never came back is drawn to a little below the deepest return.
        length[lost] = np.clip((floor - start[lost, 1]) / down[lost], 0.0, 1.0)
        end = start + along * length[:, None]
        near = np.abs(end[:, 0]) <= reach
        lines = np.stack([start[near], end[near]], axis=1) * 1e3
        ax.add_collection(
            LineCollection(
                list(lines),
                colors=colour,
                linewidths=0.35 if not name else 0.6,
                alpha=0.22 if not name else 0.7,
                zorder=0.5,
                label=name or None,
                linestyles="solid" if not name else (0, (3, 2)),
            )
        )
    if slice_.viewpoint is not None and not np.isfinite(reach):
        ax.plot(*(slice_.viewpoint * 1e3), marker="v", ms=8, color=INK, ls="none", label="sensor", zorder=7)


def _frame_close(
    ax: Axes, slice_: Slice, designed: Sequence[Profile], gap: Sequence[Array], reach: float
) -> None:
    inside = [
        p[np.abs(p[:, 0]) <= reach]
        for p in (*gap, slice_.points, *(loop for q in designed for loop in q.loops))
    ]
    v = np.concatenate([p[:, 1] for p in inside if len(p)] or [np.array([-reach, reach])])
    low, high = max(float(v.min()), -2.0 * reach), min(float(v.max()), reach)
    ax.set_xlim(-reach * 1e3, reach * 1e3)
    ax.set_ylim((low - 0.012) * 1e3, (high + 0.012) * 1e3)
