"""BCF files: read back by bcf-client and, apart from it, as the zip of XML files that they are."""

from __future__ import annotations

import io
import json
import re
import sys
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import bcf.v2.bcfxml
import bcf.v3.bcfxml
import numpy as np
import pytest
from matplotlib.image import imread

from bimfit.bim.bcf import Issue, Viewpoint, write_bcf
from bimfit.bim.model import load_model
from bimfit.errors import BimfitError, ConfigError, ExportError
from bimfit.pipeline.document import read_results
from bimfit.pipeline.issues import viewpoint, write_issues
from bimfit.pipeline.limits import Limits, judge

sys.path.insert(0, str(Path(__file__).parent))
from folder import ELEMENTS, joint, sample_joints, station, write_folder

LIMITS = Limits(width=(0.012, 0.030), step=(-0.003, 0.003))
FAR = (458657.25, 5438232.5, 112.0)
GUID = re.compile(r"[a-f0-9]{8}-[a-f0-9]{4}-[a-f0-9]{4}-[a-f0-9]{4}-[a-f0-9]{12}")
CHILDREN = {  # what the schemas list, in their order
    "2.1": {
        "Markup": ["Header", "Topic", "Comment", "Viewpoints"],
        "Topic": ["ReferenceLink", "Title", "Priority", "Index", "Labels", "CreationDate", "CreationAuthor",
                  "ModifiedDate", "Description"],
        "VisualizationInfo": ["Components", "OrthogonalCamera", "PerspectiveCamera"],
        "PerspectiveCamera": ["CameraViewPoint", "CameraDirection", "CameraUpVector", "FieldOfView"],
    },
    "3.0": {
        "Markup": ["Header", "Topic"],
        "Topic": ["ReferenceLinks", "Title", "Priority", "Index", "Labels", "CreationDate", "CreationAuthor",
                  "Description", "Comments", "Viewpoints"],
        "VisualizationInfo": ["Components", "PerspectiveCamera"],
        "PerspectiveCamera": ["CameraViewPoint", "CameraDirection", "CameraUpVector", "FieldOfView",
                              "AspectRatio"],
        "Extensions": ["TopicTypes", "TopicStatuses", "Priorities", "TopicLabels", "Users", "SnippetTypes",
                       "Stages"],
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def written(samples, tmp_path_factory):
    """Both versions of the issues of a folder at map coordinates, its model the packaged facade."""
    folder = tmp_path_factory.mktemp("far")
    write_folder(folder, sample_joints(FAR), samples / "facade.ifc")
    results = read_results(folder)
    out = {}
    for version in ("2.1", "3.0"):
        path = folder / f"issues-{version}.bcf"
        issues = write_issues(results, folder, path, LIMITS, version=version)
        out[version] = path, issues
    return results, out


def xml_of(path):
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        return {
            n: ET.fromstring(archive.read(n)) for n in archive.namelist() if not n.endswith(("/", ".png"))
        }


@pytest.mark.parametrize("version", ["2.1", "3.0"])
def test_a_plain_reader_finds_every_topic(version, written):
    out = written[1]
    path, issues = out[version]
    files = xml_of(path)
    assert files["bcf.version"].get("VersionId") == version
    markups = {name: root for name, root in files.items() if name.endswith("markup.bcf")}
    assert len(markups) == len(issues) == 4
    titles = [root.findtext("Topic/Title") for root in markups.values()]
    assert any("wide: width 34.0 mm, limits 12 to 30 mm" in title for title in titles)
    assert sum("could not be measured" in title for title in titles) == 2
    for name, root in markups.items():
        topic = root.find("Topic")
        assert GUID.fullmatch(topic.get("Guid")) and name == f"{topic.get('Guid')}/markup.bcf"
        assert (topic.get("TopicType"), topic.get("TopicStatus")) == ("Issue", "Open")
        assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(Z|\+00:00)", topic.findtext("CreationDate"))
        text = topic.findtext("Description")
        assert all(guid in text for guid in ELEMENTS) and " mm" in text
        view = root.find("Viewpoints") if version == "2.1" else topic.find("Viewpoints/ViewPoint")
        assert view.findtext("Snapshot") == "snapshot.png" or "not be measured" in topic.findtext("Title")
        info = files[f"{topic.get('Guid')}/{view.findtext('Viewpoint')}"]
        assert info.get("Guid") == view.get("Guid")
        assert {c.get("IfcGuid") for c in info.findall("Components/Selection/Component")} == set(ELEMENTS)
        for parent in (root, topic, info, info.find("PerspectiveCamera")):
            order = [CHILDREN[version][parent.tag].index(child.tag) for child in parent]
            assert order == sorted(order), parent.tag
    if version == "3.0":
        assert [child.tag for child in files["extensions.xml"]] == CHILDREN[version]["Extensions"]
        listed = {node.text for node in files["extensions.xml"].iter("TopicLabel")}
        assert {label.text for root in markups.values() for label in root.iter("Label")} <= listed


@pytest.mark.parametrize("version", ["2.1", "3.0"])
def test_the_view_looks_at_the_joint_from_its_mouth(version, written):
    """The camera's axis passes the worst station to a micrometre, at map coordinates, in metres."""
    results, out = written
    worst = {one.id: judge(one, LIMITS) for one in results.joints}["wide"].breaches[0].station.origin
    files = xml_of(out[version][0])
    (topic,) = [
        r for n, r in files.items() if n.endswith("markup.bcf") and "wide" in r.findtext("Topic/Title")
    ]
    guid = topic.find("Topic").get("Guid")
    (info,) = [r for n, r in files.items() if n.startswith(guid) and n.endswith(".bcfv")]
    eye, forward, up = (
        np.array([float(info.findtext(f"PerspectiveCamera/{what}/{axis}")) for axis in "XYZ"])
        for what in ("CameraViewPoint", "CameraDirection", "CameraUpVector")
    )
    np.testing.assert_allclose([np.linalg.norm(forward), np.linalg.norm(up)], 1.0, atol=1e-12)
    assert forward @ up == pytest.approx(0.0, abs=1e-12)
    away = (worst - eye) @ forward
    assert 0.5 < away < 7.0
    np.testing.assert_allclose(eye + away * forward, worst, atol=1e-6)
    assert eye[2] > worst[2]  # the mouth is up


@pytest.mark.parametrize(("version", "reader"), [("2.1", bcf.v2.bcfxml), ("3.0", bcf.v3.bcfxml)])
def test_bcf_client_reads_it_back(version, reader, written):
    path, issues = written[1][version]
    with reader.BcfXml.load(path) as book:
        found = {handler.topic.title: handler for handler in book.topics.values()}
        assert set(found) == {issue.title for issue in issues}
        for issue in issues:
            handler = found[issue.title]
            assert handler.topic.description == issue.description
            (view,) = handler.viewpoints.values()
            assert view.get_selected_guids() == list(issue.elements)
            assert view.snapshot == issue.snapshot
            place = view.visualization_info.perspective_camera.camera_view_point
            assert (place.x, place.y, place.z) == tuple(issue.viewpoint.eye)


def test_the_same_joint_keeps_its_topic(written, tmp_path):
    results, out = written
    path, _ = out["2.1"]
    write_issues(results, path.parent, tmp_path / "again.bcf", LIMITS)
    assert sorted(xml_of(path)) == sorted(xml_of(tmp_path / "again.bcf"))


def test_snapshots_show_the_elements(samples, tmp_path):
    """With the model at hand the joint is drawn in space: the picture is large and not empty."""
    model = load_model(samples / "facade.ifc")
    wide = [station(0.3 * k, 0.04, origin=(3.02, 0.0, 0.2)) for k in range(4)]
    folder = write_folder(tmp_path, [joint("wide", wide, origin=(3.02, 0.0, 0.2))], model.path)
    (issue,) = write_issues(read_results(folder), folder, tmp_path / "i.bcf", LIMITS, building=model)
    picture = imread(io.BytesIO(issue.snapshot))
    assert picture.shape[0] > 700 and picture.shape[1] > 1000
    upper = picture[: picture.shape[0] // 2, :, :3]
    assert len(np.unique((upper * 15).astype(int).reshape(-1, 3), axis=0)) > 20


def test_no_issue_is_a_valid_empty_file(tmp_path):
    folder = write_folder(tmp_path, sample_joints()[:1])
    assert write_issues(read_results(folder), folder, tmp_path / "none.bcf", LIMITS) == ()
    assert set(xml_of(tmp_path / "none.bcf")) == {"bcf.version", "project.bcfp"}


def test_what_cannot_be_written_leaves_nothing(tmp_path):
    results = read_results(write_folder(tmp_path, sample_joints()))
    with pytest.raises(ConfigError, match=r"2\.0 is not written; choose from 2\.1, 3\.0"):
        write_issues(results, tmp_path, tmp_path / "i.bcf", LIMITS, version="2.0")
    with pytest.raises(ConfigError, match="bcfzip"):
        write_issues(results, tmp_path, tmp_path / "i.txt", LIMITS)
    (tmp_path / "a folder.bcf").mkdir()
    with pytest.raises(ExportError, match="is a folder"):
        write_bcf(tmp_path / "a folder.bcf", [], model="m.ifc")
    with pytest.raises(BimfitError, match="cannot be written"):
        write_bcf(tmp_path / "results.json" / "i.bcf", [], model="m.ifc")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a folder.bcf", "results.json"]


def test_a_joint_without_stations_or_path_is_refused(tmp_path):
    folder = write_folder(tmp_path, [joint("unseen", [])])
    value = json.loads((folder / "results.json").read_text())
    del value["joints"][0]["path"]
    (folder / "results.json").write_text(json.dumps(value))
    (one,) = read_results(folder).joints
    with pytest.raises(ConfigError, match="neither stations nor a path"):
        viewpoint(one, judge(one, LIMITS))


def test_odd_characters_survive(tmp_path):
    view = Viewpoint(np.zeros(3), np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0]))
    text = 'Größe <b>&amp;</b> "x" ]]> 30 \u2264 40'
    write_bcf(tmp_path / "i.bcf", [Issue("k", text, text, ELEMENTS, view)], model=text)
    (root,) = [r for n, r in xml_of(tmp_path / "i.bcf").items() if n.endswith("markup.bcf")]
    assert (root.findtext("Topic/Title"), root.findtext("Topic/Description")) == (text, text)
