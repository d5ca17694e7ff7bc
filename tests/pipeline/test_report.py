"""The HTML report: complete, self-contained, and honest about what is not known."""

from __future__ import annotations

import base64
import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from matplotlib.image import imread, imsave

from bimfit.cli.main import main
from bimfit.errors import ExportError
from bimfit.pipeline.document import read_results
from bimfit.pipeline.limits import Limits
from bimfit.pipeline.report import write_report

sys.path.insert(0, str(Path(__file__).parent))
from folder import document, joint, sample_joints, station, write_folder

LIMITS = Limits(width=(0.012, 0.030), step=(-0.003, 0.003))
VOID = {"meta", "img", "br", "link", "rect", "path", "input"}


class Reader(HTMLParser):
    """Tags, attributes and words of a page; tags must nest."""

    def __init__(self, text):
        super().__init__()
        self.open, self.links, self.anchors, self.words, self.tags = [], [], set(), [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.tags.append(tag)
        self.links += [values[name] for name in ("src", "href", "data", "action") if name in values]
        if "id" in values:
            self.anchors.add(values["id"])
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self):
        return re.sub(r"\s+", " ", " ".join(self.words))


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = write_folder(tmp_path_factory.mktemp("report"), sample_joints())
    return Reader(write_report(read_results(folder), folder, LIMITS).read_text(encoding="utf-8"))


def test_it_needs_nothing_from_outside(page):
    for link in page.links:
        assert link.startswith(("#", "data:")), link[:80]
    assert {link[1:] for link in page.links if link.startswith("#")} <= page.anchors
    assert "link" not in page.tags and "iframe" not in page.tags


def test_it_says_what_the_results_say(page):
    text = page.text
    for words in (
        "As-built joints of model.ifc", "1 joint passes", "2 joints fail", "2 joints not measured",
        "width at the mouth 12 to 30 mm, step between the faces ±3 mm", "a note",
        "Out of limits: width at the mouth 34.0 ± 0.4 mm at 1000 mm along the joint",
        "Not measured: no returns near the joint", "Not measured: the scan shows no station of it",
        "gap volume 0.500 ± 0.010 litre", "Größe 2", "=HYPERLINK(1)", "0 of 11",
    ):  # fmt: skip
        assert words in text, words
    assert "nan" not in re.findall(r"[a-z]+", text.lower())
    assert re.search(r"0 1000 11 no data no returns near the joint", text)


def test_what_elements_are_called_stays_text(tmp_path):
    evil = '<script>alert("x")</script>'
    joints = [joint(evil, [station(0.1, 0.02)], names=(evil, "&amp;"), reason=evil)]
    folder = write_folder(tmp_path, joints, model=evil)
    text = write_report(read_results(folder), folder, LIMITS).read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert evil in Reader(text).text and "&amp;amp;" in text


def test_pictures_are_embedded_and_made_smaller(tmp_path):
    folder = write_folder(tmp_path, sample_joints()[:1])
    imsave(folder / "scene-good.png", [[(0.1 * (k % 10), 0.5, 0.5) for k in range(1600)] for _ in range(200)])
    page = Reader(write_report(read_results(folder), folder, None).read_text(encoding="utf-8"))
    (picture,) = [link for link in page.links if link.startswith("data:image/jpeg")]
    (tmp_path / "back.jpg").write_bytes(base64.b64decode(picture.split(",")[1]))
    assert imread(tmp_path / "back.jpg").shape[1] == 1000
    assert "No limits were given" in page.text


def test_many_joints_stay_readable(tmp_path, monkeypatch):
    monkeypatch.setattr("bimfit.pipeline.report.MOST_PLOTS", 2)
    joints = [joint(f"j{k:04d}", [station(0.1, 0.02), station(0.9, 0.02)]) for k in range(120)]
    joints[-1] = joint("last", [station(0.1, 0.02), station(0.9, 0.031)])
    folder = write_folder(tmp_path, joints)
    path = write_report(read_results(folder), folder, LIMITS)
    page = Reader(path.read_text(encoding="utf-8"))
    plotted = page.text.split(" last ")[-1]
    assert "Out of limits" in plotted
    assert sum(link.startswith("data:image/svg") for link in page.links) == 2
    assert "118 joints are listed without diagrams" in page.text
    assert path.stat().st_size < 0.6e6


def test_the_command_keeps_the_limits_of_the_fit(tmp_path, capsys, monkeypatch):
    folder = write_folder(tmp_path, sample_joints())
    value = {**document(sample_joints()), "limits": {"width": [None, 0.030]}}
    (folder / "results.json").write_text(json.dumps(value), encoding="utf-8")
    monkeypatch.setattr("bimfit.pipeline.report.MOST_PLOTS", 1)  # quicker
    assert main(["report", str(folder)]) == 0
    captured = capsys.readouterr()
    assert str(folder / "report.html") in captured.out
    assert "no longer there" in captured.err
    text = Reader((folder / "report.html").read_text(encoding="utf-8")).text
    assert "Limits: width at the mouth at most 30 mm" in text
    assert main(["report", str(folder), "--limits", "width=..50mm", "--bcf", str(tmp_path / "i.bcf")]) == 0
    assert "at most 50 mm" in Reader((folder / "report.html").read_text(encoding="utf-8")).text
    assert (tmp_path / "i.bcf").stat().st_size > 500
    capsys.readouterr()
    value["limits"] = {"breadth": [0, 1]}
    (folder / "results.json").write_text(json.dumps(value), encoding="utf-8")
    for words in (
        ["report", str(folder)],
        ["report", str(tmp_path / "nowhere")],
        ["report", str(folder), "--limits", "breadth=1..2mm"],
        ["report", str(folder), "--bcf", str(tmp_path / "i.bcf"), "--bcf-version", "1.0"],
    ):
        assert main(words) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_damaged_files_of_the_folder(tmp_path, capsys):
    """A picture that cannot be read is left out; a mesh that cannot is one clear line."""
    joints = sample_joints()[:1]
    joints[0]["meshes"] = {"ply": "gap-good.ply"}
    folder = write_folder(tmp_path, joints)
    (folder / "scene-good.png").write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    assert main(["report", str(folder)]) == 0
    assert "data:image/jpeg" not in (folder / "report.html").read_text(encoding="utf-8")
    capsys.readouterr()
    (folder / "gap-good.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9")
    assert main(["report", str(folder)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "gap-good.ply" in line and "internal error" not in line


def test_no_input_is_overwritten(tmp_path):
    folder = write_folder(tmp_path, sample_joints(), model=tmp_path / "report.html")
    (folder / "report.html").write_text("a model by an odd name")
    with pytest.raises(ExportError, match="never overwritten"):
        write_report(read_results(folder), folder)
    assert (folder / "report.html").read_text() == "a model by an odd name"
