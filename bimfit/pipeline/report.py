"""The HTML report of a results folder."""

from __future__ import annotations

import contextlib
import itertools
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bimfit.files import protect_inputs
from bimfit.pipeline.document import SURE, JointDocument, ResultsDocument, StationDocument
from bimfit.pipeline.gap_files import load_gap
from bimfit.pipeline.issues import joint_elements, limit_series
from bimfit.pipeline.limits import Limits, Verdict, judge
from bimfit.pipeline.output import PICTURES, safe_name
from bimfit.report.html import (
    Cell,
    Heading,
    JointPage,
    Page,
    Picture,
    Piece,
    Stretch,
    Tile,
    embedded,
    embedded_picture,
    write_html,
)
from bimfit.report.limit_plots import plot_limits
from bimfit.report.style import STATUS
from bimfit.report.viewer import viewer_model, viewer_script

if TYPE_CHECKING:
    from bimfit.bim.model import Model

NAME = "report.html"
MOST_PLOTS, MOST_PICTURES = 40, 12
"""How many joints get a diagram and pictures, so that a report on a thousand joints still opens."""
_CAPTIONS = {
    "scene": "The joint as fitted, with the scan and the gap",
    "slice": "A slice: scan, design and fit",
    "gap-poses": "Origin and angle of the gap and its volume along the joint",
}
_COLUMNS = (
    Heading("joint", number=False),
    Heading("verdict", number=False),
    Heading("kind", number=False),
    Heading("storey", number=False),
    Heading("elements", number=False),
    Heading("designed", "mm"),
    Heading("min", "mm"),
    Heading("mean", "mm"),
    Heading("max", "mm"),
    Heading("±", "mm"),
    Heading("step", "mm"),
    Heading("length", "mm"),
    Heading("volume", "litre"),
    Heading("±", "litre"),
    Heading("measured"),
)
_NONE = "–"
Progress = Callable[[str, float], None]


def write_report(
    results: ResultsDocument,
    folder: Path,
    limits: Limits | None = None,
    *,
    building: Model | None = None,
    progress: Progress = lambda step, share: None,
) -> Path:
    """Write report.html into a results folder.

    Parameters
    ----------
    results : ResultsDocument
    folder : Path
        Where they are; its pictures and gap meshes are embedded.
    limits : Limits, optional
    building : Model, optional
        Draws the designed elements around the gaps.
    progress : callable
        Told (step, share done).

    Raises
    ------
    ExportError
        When it cannot be written.
    """
    path = folder / NAME
    protect_inputs([path], [Path(results.model), Path(results.scan)])
    verdicts = [judge(joint, limits) for joint in results.joints]
    # those that break their limits are drawn first, where not all can be
    order = {"fail": 0, "not measured": 1}
    ranked = sorted(range(len(verdicts)), key=lambda k: (order.get(verdicts[k].outcome, 2), k))
    rank = {k: place for place, k in enumerate(ranked)}
    joints = []
    for k, (joint, verdict) in enumerate(zip(results.joints, verdicts, strict=True)):
        progress("writing the report", k / len(verdicts))
        plot = _plot(joint, limits) if rank[k] < MOST_PLOTS else ""
        pictures = _pictures(joint, folder) if rank[k] < MOST_PICTURES else ()
        model = _model(joint, folder, building) if rank[k] < MOST_PICTURES else ""
        joints.append(_joint_page(k, joint, verdict, limits, plot, pictures, model))
    return write_html(_page(results, verdicts, limits, joints), path)


def _page(
    results: ResultsDocument, verdicts: list[Verdict], limits: Limits | None, joints: list[JointPage]
) -> Page:
    outcomes = [verdict.outcome for verdict in verdicts]
    tiles = [_counted(len(joints), "joint", "joints")]
    if limits is not None and limits.given:
        tiles.append(_counted(outcomes.count("pass"), "joint passes", "joints pass"))
        tiles.append(_counted(outcomes.count("fail"), "joint fails", "joints fail"))
    tiles.append(_counted(outcomes.count("not measured"), "joint not measured", "joints not measured"))
    volumes = [joint.volume for joint in results.joints if math.isfinite(joint.volume)]
    if volumes:
        tiles.append(Tile("litre of sealant in all", f"{1e3 * sum(volumes):.3f}"))
    more = len(joints) - MOST_PLOTS
    notes = [f"{more} joints are listed without diagrams"] if more > 0 else []
    return Page(
        title=f"As-built joints of {Path(results.model).name}",
        about=(("model", results.model), ("scan", results.scan), ("made by", f"bimfit {results.version}")),
        tiles=tiles,
        limits=str(limits) if limits is not None else "",
        notes=(*results.notes, *notes),
        columns=_COLUMNS,
        joints=joints,
        script=viewer_script() if any(joint.model for joint in joints) else "",
    )


def _joint_page(
    number: int,
    joint: JointDocument,
    verdict: Verdict,
    limits: Limits | None,
    plot: str,
    pictures: tuple[Picture, ...],
    model: str,
) -> JointPage:
    lines = [f"Out of limits: {breach.words(limits)}." for breach in verdict.breaches if limits is not None]
    if not lines and verdict.reason:
        told = {"not measured": "Not measured", "pass": "Close to its limits"}
        lines.append(f"{told.get(verdict.outcome, 'Note')}: {verdict.reason}.")
    names = " / ".join(name or guid for name, guid in zip(joint.names, joint.elements, strict=True))
    return JointPage(
        id=joint.id,
        anchor=f"joint-{number + 1}",
        verdict=verdict.outcome,
        heading=f"{joint.kind}, {names}",
        cells=_cells(joint, names),
        lines=lines,
        figures=_figures(joint),
        strip=_strip(joint),
        key=[(name.replace("_", " "), STATUS[name][0], count) for name, count in joint.counts.items()],
        stretches=_stretches(joint),
        plot=plot,
        pictures=pictures,
        model=model,
    )


def _counted(count: int, one: str, many: str) -> Tile:
    return Tile(one if count == 1 else many, str(count))


def _widths(joint: JointDocument) -> tuple[float, float, float, float]:
    """Least, mean and greatest width at the mouth and twice its typical deviation, mm; NaN where unknown."""
    widths = np.array([station.width for station in joint.trusted]) * 1e3
    sigma = np.array([station.sigma_width for station in joint.trusted]) * 1e3
    if not len(widths):
        return (math.nan,) * 4
    spread = SURE * float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else math.nan
    return float(widths.min()), float(widths.mean()), float(widths.max()), spread


def _step(joint: JointDocument) -> float:
    """The largest step, mm."""
    steps = np.array([station.step for station in joint.trusted]) * 1e3
    return float(steps[np.nanargmax(np.abs(steps))]) if np.isfinite(steps).any() else math.nan


def _text(value: float, digits: int = 1) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}" if math.isfinite(value) else _NONE


def _cells(joint: JointDocument, names: str) -> list[Cell]:
    low, mean, high, spread = _widths(joint)
    numbers = [
        *(_text(x) for x in (1e3 * joint.width, low, mean, high, spread, _step(joint))),
        _text(1e3 * joint.length, 0),
        _text(1e3 * joint.volume, 3),
        _text(SURE * 1e3 * joint.volume_sigma, 3),
        f"{len(joint.trusted)} of {len(joint.stations)}",
    ]
    state = "" if joint.state in ("", "open") else f" ({joint.state})"
    words = (f"{joint.kind}{state}", joint.storey, names)
    return [*(Cell(word, number=False) for word in words), *(Cell(number) for number in numbers)]


def _figures(joint: JointDocument) -> list[tuple[str, str]]:
    low, mean, high, spread = _widths(joint)
    volume = _text(1e3 * joint.volume, 3)
    if math.isfinite(joint.volume_sigma):
        volume += f" ± {SURE * 1e3 * joint.volume_sigma:.3f}"
    narrowest = min((station.narrowest for station in joint.trusted), default=math.nan)
    touching = {
        "clash": "the elements overlap (clash)",
        "possible clash": "may overlap (possible clash)",
        "touch": "the elements touch",
        "clear": "clear",
    }
    rows = [
        ("designed width", f"{_text(1e3 * joint.width)} mm"),
        ("mean width at the mouth", f"{_text(mean)} mm"),
        ("… known at a station to", f"± {_text(spread)} mm"),
        ("width from … to", f"{_text(low)} … {_text(high)} mm"),
        ("narrowest", f"{_text(1e3 * narrowest)} mm"),
        ("largest step", f"{_text(_step(joint))} mm"),
        ("contact as built", touching.get(joint.contact, _NONE)),
        ("length", f"{1e3 * joint.length:.0f} mm"),
        ("gap volume", f"{volume} litre"),
        ("motion along the joint", joint.motion or _NONE),
        ("stations measured", f"{len(joint.trusted)} of {len(joint.stations)}"),
        ("A", joint.elements[0]),
        ("B", joint.elements[1]),
    ]
    return [(name, value) for name, value in rows if joint.trusted or _NONE not in value]


def _strip(joint: JointDocument) -> list[Piece]:
    """Every station's stretch of the joint in the colour of its status."""
    if not joint.stations or not joint.length > 0.0:
        return []
    s = np.array([station.s for station in joint.stations])
    edges = np.concatenate([[0.0], 0.5 * (s[1:] + s[:-1]), [max(joint.length, float(s[-1]))]])
    at = 1000.0 * edges / edges[-1]
    return [
        Piece(f"{at[k]:.1f}", f"{max(at[k + 1] - at[k], 0.0):.1f}", STATUS[station.status][0])
        for k, station in enumerate(joint.stations)
    ]


def _stretches(joint: JointDocument) -> list[Stretch]:
    def same(station: StationDocument) -> tuple[str, str]:
        return station.status, station.reason

    out = []
    for (status, reason), group in itertools.groupby(joint.stations, key=same):
        found = list(group)
        if status != "ok":
            ends = (f"{1e3 * found[0].s:.0f}", f"{1e3 * found[-1].s:.0f}")
            out.append(Stretch(*ends, len(found), status.replace("_", " "), reason))
    return out


def _plot(joint: JointDocument, limits: Limits | None) -> str:
    series = limit_series(joint, limits or Limits())
    if not series:
        return ""
    with tempfile.TemporaryDirectory(prefix="bimfit-") as place:
        return embedded(plot_limits(Path(place) / "plot.svg", series).read_bytes(), "image/svg+xml")


def _model(joint: JointDocument, folder: Path, building: Model | None) -> str:
    gap = load_gap(joint, folder)
    return "" if gap is None else viewer_model(*gap, joint_elements(joint, building))


def _pictures(joint: JointDocument, folder: Path) -> tuple[Picture, ...]:
    made = []
    for kind in PICTURES:
        file = folder / f"{kind}-{safe_name(joint.id)}.png"
        if kind in _CAPTIONS and file.is_file():
            with contextlib.suppress(OSError):  # a damaged picture is left out
                made.append(Picture(embedded_picture(file), _CAPTIONS[kind]))
    return tuple(made)
