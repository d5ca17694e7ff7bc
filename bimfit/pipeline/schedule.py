"""The joint schedule: every joint as designed and as built, for a spreadsheet."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bimfit.errors import ExportError
from bimfit.files import whole_file, write_text
from bimfit.pipeline.document import SURE, JointDocument, ResultsDocument
from bimfit.pipeline.limits import Limits, Verdict, judge

NAMES = ("schedule.csv", "schedule.xlsx")


@dataclass(frozen=True)
class Column:
    """A column: its heading with the unit, how its numbers look, and how wide it is."""

    heading: str
    style: str = ""
    width: float = 11.0


MM, LITRE, COUNT = "0.0", "0.000", "0"
COLUMNS = (
    Column("joint", width=9),
    Column("verdict", width=13),
    Column("kind", width=13),
    Column("state", width=8),
    Column("storey", width=16),
    Column("element A", width=26),
    Column("element B", width=26),
    Column("designed width (mm)", MM),
    Column("width min (mm)", MM),
    Column("width mean (mm)", MM),
    Column("width max (mm)", MM),
    Column("width sigma (mm)", "0.00"),
    Column("mean less designed (mm)", MM),
    Column("narrowest (mm)", MM),
    Column("largest step (mm)", MM),
    Column("step sigma (mm)", "0.00"),
    Column("length (mm)", COUNT),
    Column("sealant volume (litre)", LITRE),
    Column("volume sigma (litre)", LITRE),
    Column("stations", COUNT, 9),
    Column("measured", COUNT, 9),
    Column("contact", width=10),
    Column("remark", width=70),
    Column("GlobalId A", width=25),
    Column("GlobalId B", width=25),
)


def schedule_rows(results: ResultsDocument, limits: Limits | None) -> list[list[str | float | int | None]]:
    """One row a joint, as :data:`COLUMNS` has them; None where nothing is known."""
    return [_row(joint, judge(joint, limits)) for joint in results.joints]


def _row(joint: JointDocument, verdict: Verdict) -> list[str | float | int | None]:
    trusted = joint.trusted
    widths = 1e3 * np.array([station.width for station in trusted])
    sigma = 1e3 * np.array([station.sigma_width for station in trusted])
    steps = 1e3 * np.array([station.step for station in trusted])
    step_sigma = 1e3 * np.array([station.sigma_step for station in trusted])
    designed = 1e3 * np.array([station.designed_width for station in trusted])
    known = bool(np.isfinite(designed).any())
    largest = int(np.nanargmax(np.abs(steps))) if np.isfinite(steps).any() else None
    return [
        joint.id,
        verdict.outcome or None,
        joint.kind,
        joint.state or None,
        joint.storey or None,
        joint.names[0] or None,
        joint.names[1] or None,
        _known(np.nanmean(designed) if known else 1e3 * joint.width),
        _known(widths.min() if len(widths) else None),
        _known(widths.mean() if len(widths) else None),
        _known(widths.max() if len(widths) else None),
        _known(float(np.sqrt(np.nanmean(sigma**2))) if np.isfinite(sigma).any() else None),
        _known(np.nanmean(widths - designed) if known else None),
        _known(1e3 * min((station.narrowest for station in trusted), default=math.nan)),
        _known(None if largest is None else steps[largest]),
        _known(None if largest is None else step_sigma[largest]),
        _known(1e3 * joint.length),
        _known(1e3 * joint.volume),
        _known(1e3 * joint.volume_sigma),
        len(joint.stations),
        len(trusted),
        joint.contact or None,
        remark(joint, verdict) or None,
        *joint.elements,
    ]


def remark(joint: JointDocument, verdict: Verdict) -> str:
    """Why a joint fails or was not measured, and what its stations say."""
    flagged = {name: count for name, count in joint.counts.items() if name != "ok"}
    told = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in flagged.items())
    parts = [verdict.reason, f"{told} of {len(joint.stations)} stations" if told else ""]
    return "; ".join(part for part in parts if part)


def _known(value: Any) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def write_schedule(
    results: ResultsDocument, folder: Path, limits: Limits | None = None
) -> tuple[tuple[Path, ...], str]:
    """Write schedule.csv and schedule.xlsx.

    Returns
    -------
    paths : tuple of Path
    note : str
        Why there is no workbook, where there is none.

    Raises
    ------
    ExportError
        When a file cannot be written.
    """
    rows = schedule_rows(results, limits)
    table, book = (folder / name for name in NAMES)
    write_text(table, _csv(rows))
    try:
        _write_book(book, rows, results, limits)
    except ImportError:
        return (table,), "no schedule.xlsx without openpyxl: pip install 'bimfit[xlsx]'"
    return (table, book), ""


def _csv(rows: Sequence[Sequence[str | float | int | None]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.heading for column in COLUMNS])
    for row in rows:
        writer.writerow(
            [
                "" if v is None else f"{round(v, 6) + 0.0:.6g}" if isinstance(v, float) else _harmless(v)
                for v in row
            ]
        )
    return text.getvalue()


def _harmless(value: str | int) -> str | int:
    """Text that no spreadsheet takes for a formula."""
    risky = isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r")
    return f"'{value}" if risky else value


def _write_book(
    path: Path,
    rows: Sequence[Sequence[str | float | int | None]],
    results: ResultsDocument,
    limits: Limits | None,
) -> None:
    from openpyxl import Workbook
    from openpyxl.styles import Alignment, Font, PatternFill
    from openpyxl.utils import get_column_letter

    book = Workbook()
    sheet = book.active
    sheet.title = "joints"
    sheet.append([column.heading for column in COLUMNS])
    fills = {"fail": "F8D7D3", "not measured": "FBE9C6", "pass": "DDEFD9"}
    for number, row in enumerate(rows, start=2):
        for k, (column, value) in enumerate(zip(COLUMNS, row, strict=True), start=1):
            cell = sheet.cell(number, k)
            if isinstance(value, str):
                cell.value = _printable(value)
                cell.data_type = "s"  # never a formula, whatever an element is called
            else:
                cell.value = value
                cell.number_format = column.style or "General"
        colour = fills.get(str(row[1]))
        if colour:
            sheet.cell(number, 2).fill = PatternFill("solid", start_color=colour)
    for k, column in enumerate(COLUMNS, start=1):
        sheet.column_dimensions[get_column_letter(k)].width = column.width
        cell = sheet.cell(1, k)
        cell.font = Font(bold=True)
        cell.alignment = Alignment(wrap_text=True, vertical="top")
    sheet.freeze_panes = "C2"
    sheet.auto_filter.ref = f"A1:{get_column_letter(len(COLUMNS))}{len(rows) + 1}"
    sheet.page_setup.orientation = "landscape"
    sheet.page_setup.fitToWidth, sheet.page_setup.fitToHeight = 1, 0
    sheet.sheet_properties.pageSetUpPr.fitToPage = True
    sheet.print_title_rows = "1:1"
    about = book.create_sheet("about")
    for name, value in (
        ("model", results.model),
        ("scan", results.scan),
        ("bimfit", results.version),
        ("limits", str(limits) if limits is not None and limits.given else "none"),
        ("sigma", "one standard deviation; of widths that of a typical station"),
        ("verdict", f"± in the remarks is {SURE:g} standard deviations"),
        *(("note", note) for note in results.notes),
    ):
        about.append([name, None])
        about.cell(about.max_row, 2).value = _printable(value)
        about.cell(about.max_row, 2).data_type = "s"
    about.column_dimensions["B"].width = 90
    with whole_file(path) as part:
        try:
            book.save(part)
        except ValueError as error:
            raise ExportError(f"cannot be written: {error}", file=path) from error


def _printable(text: str) -> str:
    """Text without the control characters that a workbook may not hold."""
    return "".join(c if c.isprintable() or c in "\n\t" else " " for c in text)[:32000]
