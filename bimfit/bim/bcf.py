"""Issues for other tools: BCF 2.1 and 3.0."""

from __future__ import annotations

import contextlib
import datetime
import io
import math
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bimfit.errors import ConfigError, ExportError
from bimfit.files import whole_file
from bimfit.geometry.pose import Array

Version = Literal["2.1", "3.0"]
VERSIONS: tuple[Version, ...] = ("2.1", "3.0")
AUTHOR = "bimfit"
_NAMESPACE = uuid.uuid5(uuid.NAMESPACE_URL, "https://example.org/bimfit/bcf")
_ISSUE, _OPEN, _PRIORITIES = "Issue", "Open", ("Normal", "High")
_FIELD_OF_VIEW, _ASPECT = 60.0, 1.6
_SNAPSHOT = "snapshot.png"


@dataclass(frozen=True)
class Viewpoint:
    """Where a viewer stands, in the model's coordinates, m.

    Attributes
    ----------
    eye, forward, up : ndarray, shape (3,)
        Position and unit directions; ``up`` is at right angles to ``forward``.
    """

    eye: Array
    forward: Array
    up: Array


@dataclass(frozen=True)
class Issue:
    """One topic.

    Attributes
    ----------
    key : str
        What it is about; the same key in the same project is the same topic from run to run.
    title, description : str
    elements : tuple of str
        GlobalIds of what is selected in the view.
    viewpoint : Viewpoint
    snapshot : bytes or None
        A PNG.
    labels : tuple of str
    urgent : bool
    """

    key: str
    title: str
    description: str
    elements: tuple[str, ...]
    viewpoint: Viewpoint
    snapshot: bytes | None = None
    labels: tuple[str, ...] = ()
    urgent: bool = False


def check_bcf(path: Path, version: str) -> Version:
    """See that issues could be written, before a long run.

    Raises
    ------
    ConfigError
        For a version or a file name that is none, or without bcf-client.
    """
    for known in VERSIONS:
        if version == known:
            if path.suffix.lower() not in (".bcf", ".bcfzip"):
                raise ConfigError("no BCF file is called so", file=path, remedy="name it .bcf or .bcfzip")
            _client()
            return known
    raise ConfigError(f"BCF {version} is not written", remedy=f"choose from {', '.join(VERSIONS)}")


def write_bcf(
    path: Path,
    issues: Sequence[Issue],
    *,
    model: str,
    project: str = "",
    version: Version = "2.1",
) -> Path:
    """Write issues as a BCF file, whole or not at all.

    Parameters
    ----------
    path : Path
    issues : sequence of Issue
        May be empty: then all is well, and the file says so by holding no topic.
    model : str
        Name of the IFC file that the GlobalIds are of.
    project : str
        GlobalId of its IfcProject; empty where it is not known.
    version : {"2.1", "3.0"}

    Raises
    ------
    ConfigError
        Without bcf-client.
    ExportError
        When it cannot be written.
    """
    check_bcf(path, version)
    _, handlers = _client()
    handler = handlers[version]
    book = handler.bcfxml.BcfXml.create_new(model)
    seed = f"{project or model}"
    book.project_info.project.project_id = str(uuid.uuid5(_NAMESPACE, seed))
    if version == "3.0":
        book.extensions = _extensions(handler.model, issues)
    now = _now()
    for issue in issues:
        _add(book, handler, issue, seed, model, project, now, version)
    said = io.StringIO()
    with whole_file(path) as part, contextlib.redirect_stdout(said):
        book.save(part)
    if said.getvalue().strip():  # bcf-client warns by printing
        raise ExportError(f"was not written whole: {said.getvalue()}", file=path)
    return path


def _client() -> tuple[Any, dict[str, Any]]:
    try:
        import bcf
        import bcf.v2.bcfxml
        import bcf.v2.model
        import bcf.v2.visinfo
        import bcf.v3.bcfxml
        import bcf.v3.model
        import bcf.v3.visinfo
    except ImportError as error:
        raise ConfigError("BCF needs bcf-client", remedy="pip install 'bimfit[bcf]'") from error
    return bcf, {"2.1": bcf.v2, "3.0": bcf.v3}


def _now() -> Any:
    from xsdata.models.datatype import XmlDateTime

    return XmlDateTime.from_datetime(datetime.datetime.now(datetime.UTC).replace(microsecond=0))


def _add(
    book: Any, handler: Any, issue: Issue, seed: str, model: str, project: str, now: Any, version: Version
) -> None:
    markup = handler.model
    made = book.add_topic(issue.title, issue.description, AUTHOR, _ISSUE, _OPEN)
    del book.topics[made.guid]
    guid = str(uuid.uuid5(_NAMESPACE, f"{seed}/{issue.key}"))
    topic = made.topic
    topic.guid, topic.creation_date, topic.priority = guid, now, _PRIORITIES[issue.urgent]
    made._topic_dir = Path(guid)  # no setter: the folder is named after a random id otherwise
    book.topics[guid] = made
    names = {"ifc_project": project or None, "filename": model, "date": None, "is_external": True}
    if version == "2.1":
        topic.labels = list(issue.labels)
        made.header = markup.Header(file=[markup.HeaderFile(**names)])
    else:
        topic.labels = markup.TopicLabels(label=list(issue.labels)) if issue.labels else None
        made.markup.header = markup.Header(files=markup.HeaderFiles(file=[markup.File(**names)]))
    view = handler.visinfo.VisualizationInfoHandler(
        _visualization(markup, issue, str(uuid.uuid5(_NAMESPACE, f"{seed}/{issue.key}/view")), version)
    )
    view.snapshot = issue.snapshot
    # the name must be said as well, or the picture is dropped
    made.add_visinfo_handler(view, _SNAPSHOT if issue.snapshot is not None else None)


def _visualization(markup: Any, issue: Issue, guid: str, version: Version) -> Any:
    view = issue.viewpoint

    def triple(kind: Any, values: Array) -> Any:
        return kind(**dict(zip("xyz", (float(x) for x in values), strict=True)))

    camera = {
        "camera_view_point": triple(markup.Point, view.eye),
        "camera_direction": triple(markup.Direction, view.forward),
        "camera_up_vector": triple(markup.Direction, view.up),
        "field_of_view": _FIELD_OF_VIEW,
    }
    if version == "3.0":
        camera["aspect_ratio"] = _ASPECT
    chosen = [markup.Component(ifc_guid=element) for element in issue.elements]
    return markup.VisualizationInfo(
        guid=guid,
        components=markup.Components(
            selection=markup.ComponentSelection(component=chosen),
            visibility=markup.ComponentVisibility(default_visibility=True),
        ),
        perspective_camera=markup.PerspectiveCamera(**camera),
    )


def _extensions(markup: Any, issues: Sequence[Issue]) -> Any:
    """What 3.0 wants listed: every type, status, priority, label and user that topics name."""
    labels = sorted({label for issue in issues for label in issue.labels})
    return markup.Extensions(
        topic_types=markup.ExtensionsTopicTypes(topic_type=[_ISSUE]),
        topic_statuses=markup.ExtensionsTopicStatuses(topic_status=[_OPEN, "Closed"]),
        priorities=markup.ExtensionsPriorities(priority=list(_PRIORITIES)),
        topic_labels=markup.ExtensionsTopicLabels(topic_label=labels),
        users=markup.ExtensionsUsers(user=[AUTHOR]),
        snippet_types=markup.ExtensionsSnippetTypes(),
        stages=markup.ExtensionsStages(),
    )


def distance_to_see(length: float) -> float:
    """How far off a viewer sees a length whole across the picture, m."""
    return 0.5 * length / math.tan(math.radians(0.5 * _FIELD_OF_VIEW))
