"""Everything that a run leaves behind, in one folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from bimfit.bim.bcf import Version, check_bcf
from bimfit.files import protect_inputs
from bimfit.pipeline.as_built import try_write_model
from bimfit.pipeline.document import read_results
from bimfit.pipeline.issues import write_issues
from bimfit.pipeline.limits import Limits
from bimfit.pipeline.output import write_survey
from bimfit.pipeline.pictures import write_pictures
from bimfit.pipeline.records import SurveyResult
from bimfit.pipeline.schedule import write_schedule

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Deliverables:
    """What is wanted beside results.json, stations.csv, the gap meshes and the schedule.

    Attributes
    ----------
    pictures, as_built : bool
        Pictures of the first joints; the model with the gaps.
    move_elements : bool
        Whether components stand where they are in the as-built model.
    limits : Limits
        What joints may measure.
    bcf : Path or None
        Where issues go.
    bcf_version : {"2.1", "3.0"}
    """

    pictures: bool = True
    as_built: bool = True
    move_elements: bool = False
    limits: Limits = field(default_factory=Limits)
    bcf: Path | None = None
    bcf_version: Version = "2.1"


def check_deliverables(wanted: Deliverables, model: Path, scan: Path) -> None:
    """See that all of it could be written, before a long run.

    Raises
    ------
    BimfitError
        When it could not.
    """
    if wanted.bcf is not None:
        check_bcf(wanted.bcf, wanted.bcf_version)
        protect_inputs([wanted.bcf], [model, scan])


def deliver(
    survey: SurveyResult, folder: Path, wanted: Deliverables, progress: Progress
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write a run's results into its folder.

    Returns
    -------
    files : tuple of Path
        What was written.
    notes : tuple of str
        What could not be written, and why; the rest stands.

    Raises
    ------
    BimfitError
        When the folder or the file of issues cannot be written.
    """
    notes: list[str] = []
    progress("writing", 0.0)
    files = [*write_survey(survey, folder)]
    results = read_results(folder)
    tables, note = write_schedule(results, folder, wanted.limits)
    files += tables
    notes += [note] if note else []
    if wanted.as_built:
        progress("writing the as-built model", 0.0)
        written, notes_of_model = try_write_model(survey, folder, move_elements=wanted.move_elements)
        files += [written] if written else []
        notes += notes_of_model
    if wanted.pictures:
        progress("drawing", 0.0)
        files += write_pictures(survey, folder)
    if wanted.bcf is not None:
        issues = write_issues(
            results,
            folder,
            wanted.bcf,
            wanted.limits,
            building=survey.building,
            version=wanted.bcf_version,
            progress=progress,
        )
        files.append(wanted.bcf)
        notes.append(f"{len(issues)} issue{'s' if len(issues) != 1 else ''} in {wanted.bcf}")
    return tuple(files), tuple(notes)
