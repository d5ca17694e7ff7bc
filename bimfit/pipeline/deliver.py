"""Everything that a run leaves behind, in one folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from bimfit.bim.bcf import Version, check_bcf
from bimfit.files import protect_inputs
from bimfit.pipeline.as_built import try_write_model
from bimfit.pipeline.document import ResultsDocument, read_results
from bimfit.pipeline.issues import open_building, write_issues
from bimfit.pipeline.limits import Limits, judge
from bimfit.pipeline.output import DERIVED, whole_folder, write_results
from bimfit.pipeline.pictures import write_pictures
from bimfit.pipeline.records import SurveyResult
from bimfit.pipeline.report import write_report
from bimfit.pipeline.schedule import write_schedule

if TYPE_CHECKING:
    from bimfit.simulation.truth import JointTruth

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Deliverables:
    """What is wanted beside results.json, stations.csv, the gap meshes and the schedule.

    Attributes
    ----------
    pictures, report, as_built : bool
        Pictures of the first joints; report.html; the model with the gaps.
    move_elements : bool
        Whether components stand where they are in the as-built model.
    limits : Limits
        What joints may measure.
    bcf : Path or None
        Where issues go.
    bcf_version : {"2.1", "3.0"}
    """

    pictures: bool = True
    report: bool = True
    as_built: bool = True
    move_elements: bool = False
    limits: Limits = field(default_factory=Limits)
    bcf: Path | None = None
    bcf_version: Version = "2.1"


def check_deliverables(wanted: Deliverables, folder: Path, inputs: Sequence[Path]) -> None:
    """See that all of it could be written, and in place of no input, before a long run.

    Raises
    ------
    BimfitError
        When it could not.
    """
    fixed = ("results.json", "stations.csv", *DERIVED)
    protect_inputs([folder / name for name in fixed], inputs)
    if wanted.bcf is not None:
        check_bcf(wanted.bcf, wanted.bcf_version)
        protect_inputs([wanted.bcf], inputs)


def deliver(
    survey: SurveyResult,
    folder: Path,
    wanted: Deliverables,
    progress: Progress,
    truths: Mapping[str, JointTruth] | None = None,
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write a run's results into its folder.

    Parameters
    ----------
    survey : SurveyResult
    folder : Path
    wanted : Deliverables
    progress : callable
        Told (step, share done).
    truths : mapping of str to JointTruth, optional
        By joint id, drawn beside the estimates of a simulated scan.

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
    with whole_folder(folder, (survey.model, survey.scan)) as stage:
        results, files, notes = _write(survey, stage, wanted, progress, truths)
    files = [folder / file.name for file in files]
    if wanted.limits.given:
        notes.append(_told(results, wanted.limits))
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


def _write(
    survey: SurveyResult,
    folder: Path,
    wanted: Deliverables,
    progress: Progress,
    truths: Mapping[str, JointTruth] | None,
) -> tuple[ResultsDocument, list[Path], list[str]]:
    """Write the folder's files: results as read back, files, notes."""
    progress("writing", 0.0)
    files = [*write_results(survey, folder, limits=wanted.limits.given)]
    results = read_results(folder)
    tables, note = write_schedule(results, folder, wanted.limits)
    files += tables
    notes = [note] if note else []
    if wanted.as_built:
        progress("writing the as-built model", 0.0)
        written, notes_of_model = try_write_model(survey, folder, move_elements=wanted.move_elements)
        files += [written] if written else []
        notes += notes_of_model
    if wanted.pictures:
        progress("drawing", 0.0)
        files += write_pictures(survey, folder, truths)
    if wanted.report:
        files.append(
            write_report(results, folder, wanted.limits, building=survey.building, progress=progress)
        )
    return results, files, notes


def _told(results: ResultsDocument, limits: Limits) -> str:
    """How the joints keep their limits, in a line."""
    outcomes = {joint.id: judge(joint, limits).outcome for joint in results.joints}
    parts = []
    for outcome in ("pass", "fail", "not measured"):
        names = [name for name, found in outcomes.items() if found == outcome]
        some = f"{', '.join(names[:8])}{', ...' if len(names) > 8 else ''}"
        listed = f" ({some})" if outcome == "fail" and names else ""
        parts.append(f"{len(names)} {outcome}{listed}")
    return f"limits ({limits}): {', '.join(parts)}"


def report_again(
    folder: Path, limits: Limits | None, bcf: Path | None, bcf_version: str, progress: Progress
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write report, schedule and perhaps issues of a results folder again.

    Parameters
    ----------
    folder : Path
    limits : Limits or None
        None takes those of the fit.
    bcf : Path or None
    bcf_version : str
    progress : callable

    Returns
    -------
    files, notes
        As of :func:`deliver`.

    Raises
    ------
    BimfitError
        When the folder holds no results, or something cannot be written.
    """
    version: Version = "2.1" if bcf is None else check_bcf(bcf, bcf_version)
    results = read_results(folder)
    rules = limits if limits is not None else Limits.of(results.limits)
    building = open_building(results)
    missing = "" if building is not None else f"the model {results.model} is no longer there to be drawn"
    tables, note = write_schedule(results, folder, rules)
    files = [*tables, write_report(results, folder, rules, building=building, progress=progress)]
    if bcf is not None:
        write_issues(results, folder, bcf, rules, building=building, version=version, progress=progress)
        files.append(bcf)
    return tuple(files), tuple(text for text in (note, missing) if text)
