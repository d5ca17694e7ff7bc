"""The output folder: a run's files appear together, no input is overwritten, nothing stale is left."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import statistics
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bimfit.errors import BimfitError, ExportError
from bimfit.files import protect_inputs, write_text
from bimfit.pipeline.document import TRUSTED, closest
from bimfit.pipeline.records import JointResult, SurveyResult
from bimfit.pipeline.results import stations_to_csv, survey_to_dict, to_json

if TYPE_CHECKING:
    from bimfit.gap.mesh import GapMesh

DERIVED = ("as-built.ifc", "schedule.csv", "schedule.xlsx", "report.html")
"""What a run writes into its folder after results.json, and makes from it."""
PICTURES = ("scene", "gap-poses", "slice", "tables")
MESH_FORMATS = ("glb", "stl", "ply", "obj", "3mf")


def write_survey(
    survey: SurveyResult,
    folder: Path,
    *,
    formats: Sequence[str] = MESH_FORMATS,
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> tuple[Path, ...]:
    """Write meshes, stations.csv and results.json, all or nothing.

    Parameters
    ----------
    survey : SurveyResult
    folder : Path
        Made when it is not there; files of an earlier run that this run does not write again are removed.
    formats : sequence of str
        Mesh formats, the first of which results.json names as ``mesh``.
    limits : mapping, optional
        What joints may measure, kept in results.json.

    Returns
    -------
    tuple of Path
        What was written.

    Raises
    ------
    ExportError
        When the folder cannot be written, or a file in it is an input of the run.
    """
    with whole_folder(folder, (survey.model, survey.scan)) as stage:
        files = write_results(survey, stage, formats=formats, limits=limits)
    return tuple(folder / file.name for file in files)


def write_results(
    survey: SurveyResult,
    stage: Path,
    *,
    formats: Sequence[str] = MESH_FORMATS,
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> tuple[Path, ...]:
    """:func:`write_survey` into a folder that is there and not yet anybody's."""
    meshes = {j.joint.id: j.mesh for j in survey.joints if j.mesh is not None}
    planned = [stage / f"gap-{safe_name(i)}.{f}" for i in meshes for f in formats]
    files = {i: _write_meshes(i, mesh, stage, formats) for i, mesh in meshes.items()}
    write_text(stage / "stations.csv", stations_to_csv(survey.joints))
    write_text(stage / "results.json", to_json(survey_to_dict(survey, files, limits)))
    return (*planned, stage / "results.json", stage / "stations.csv")


@contextlib.contextmanager
def whole_folder(folder: Path, inputs: Sequence[Path]) -> Iterator[Path]:
    """Give a temporary folder whose files move into ``folder`` when the block ends well, and else are gone.

    Files of an earlier run that are not written again are then removed. A ``folder`` that had to be made is
    removed again when the block fails.

    Raises
    ------
    ExportError
        When the folder cannot be written, or a file would take the place of an input.
    """
    made = not folder.exists()
    prepare_folder(folder)
    stage = None
    try:
        try:
            stage = Path(tempfile.mkdtemp(prefix=".writing-", dir=folder))
        except OSError as error:
            raise ExportError(
                f"cannot be written to: {error.strerror}", file=folder, remedy="choose another -o"
            ) from error
        try:
            yield stage
        except BimfitError as error:
            if Path(error.file).parent == stage:  # in a message, by the name that it was going to have
                error.file = str(folder / Path(error.file).name)
            raise
        files = sorted(stage.iterdir(), key=lambda file: file.name == "results.json")
        targets = [folder / file.name for file in files]
        protect_inputs(targets, inputs)
        stale = _earlier_files(folder) - set(targets) - {path.absolute() for path in inputs}
        for file, target in zip(files, targets, strict=True):
            _take_place(file, target)
        for path in stale:
            path.unlink(missing_ok=True)
        made = False
    finally:
        if stage is not None:
            shutil.rmtree(stage, ignore_errors=True)
        if made:
            with contextlib.suppress(OSError):  # somebody else may have put something there
                folder.rmdir()


def _take_place(file: Path, target: Path) -> None:
    try:
        file.replace(target)
    except OSError as error:
        raise ExportError(f"cannot be written: {error.strerror}", file=target) from error


def prepare_folder(folder: Path) -> None:
    """Make the output folder.

    Raises
    ------
    ExportError
        When it cannot be made, or a file has its name.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExportError(
            f"cannot be made: {error.strerror}", file=folder, remedy="choose another -o"
        ) from error


def check_folder(folder: Path) -> None:
    """See that a folder can be written to, before a long run and without making anything.

    Raises
    ------
    ExportError
        When it, or what it would be made in, is a file or may not be written to.
    """
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    if not there.is_dir():
        raise ExportError("is a file, not a folder", file=there, remedy="choose another -o")
    if not os.access(there, os.W_OK):
        raise ExportError("may not be written to", file=there, remedy="choose another -o")


def safe_name(joint_id: str) -> str:
    """A joint's id as part of a file name."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in joint_id)


def _write_meshes(joint_id: str, mesh: GapMesh, folder: Path, formats: Sequence[str]) -> dict[str, Any]:
    from bimfit.gap.export import export_mesh

    names = {f: f"gap-{safe_name(joint_id)}.{f}" for f in formats}
    offsets = {f: export_mesh(mesh, folder / name).offset for f, name in names.items()}
    first = formats[0]
    return {"mesh": names[first], "meshes": names, "mesh_offset": offsets[first], "mesh_offsets": offsets}


def _earlier_files(folder: Path) -> set[Path]:
    """Files that belong to an earlier results.json in the folder, and that therefore are ours to remove."""
    try:
        earlier = json.loads((folder / "results.json").read_text(encoding="utf-8"))
        names = [name for joint in earlier["joints"] for name in (joint.get("meshes") or {}).values()]
        ids = [safe_name(str(joint["id"])) for joint in earlier["joints"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return set()
    meshes = {folder / name for name in names if Path(name).name == name and name.startswith("gap-")}
    return (
        meshes
        | {folder / name for name in DERIVED}
        | {folder / f"{k}-{i}.png" for k in PICTURES for i in ids}
    )


def describe(joint: JointResult) -> str:
    """One line on a joint, for the terminal; widths are of the stations that are ok, where there are any."""
    measured = [s for s in joint.stations if s.gap is not None]
    if not measured:
        return f"{joint.joint.id}: not estimated: {joint.reason}"
    gaps = [s.gap for s in measured if s.status.name == "ok"] or [s.gap for s in measured]
    widths = [gap.width_mouth * 1e3 for gap in gaps if gap is not None]
    sigmas = [gap.sigma.width * 1e3 for gap in gaps if gap is not None and gap.sigma is not None]
    plus_minus = f", sd {statistics.median(sigmas):.2f}" if sigmas else ""
    counts = Counter(station.status.name for station in joint.stations)
    statuses = ", ".join(f"{n} {name}" for name, n in sorted(counts.items()))
    touching = {
        "clash": "; the elements overlap (clash)",
        "possible clash": "; the elements may overlap (possible clash)",
        "touch": "; the elements touch",
    }
    trusted = [station for station in joint.stations if station.status.name in TRUSTED]
    near = touching.get(closest(station.nearness for station in trusted), "")
    volume = "" if joint.volumes is None else f", volume {joint.volumes.mesh * 1e6:.1f} cm3"
    designed = round(joint.joint.width * 1e3, 1) + 0.0  # never -0.0
    mean = f"mean {statistics.fmean(widths):.1f}{plus_minus}"
    return (
        f"{joint.joint.id}: {joint.joint.kind}, designed {designed:.1f} mm, mouth "
        f"{min(widths):.1f} to {max(widths):.1f} mm ({mean}){volume}; "
        f"{len(joint.stations)} stations: {statuses}{near}"
    )
