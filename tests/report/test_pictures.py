"""Every picture is made, whole, of the size asked for, and shows what it was given."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from bimfit.errors import BimfitError, ExportError
from bimfit.geometry.mesh import TriangleMesh
from bimfit.report.plots import GapSeries, plot_gap_poses, plot_slice
from bimfit.report.scene import JointScene, View, render_joint, show
from bimfit.report.tables import MethodOutcome, TableLevel, plot_comparison, plot_tables

_spec = importlib.util.spec_from_file_location("report_joint", Path(__file__).with_name("joint.py"))
joint = importlib.util.module_from_spec(_spec)
sys.modules["report_joint"] = joint
_spec.loader.exec_module(joint)


@pytest.fixture(scope="module")
def stations():
    return joint.make_joint(30)


def pixels(path):
    return (matplotlib.image.imread(path)[..., :3] * 255).astype(int)


def share_of(path, colour, within=30):
    """Share of a picture's pixels that are about of a colour."""
    rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])
    return float((np.abs(pixels(path) - rgb).max(axis=2) < within).mean())


def series(stations, noise=0.0):
    rng = np.random.default_rng(0)
    n = len(stations)
    rows = [[*x.gap.mean(axis=0), 0.01 * k, 6e-6] for k, x in enumerate(stations)]
    x, z, angle, volume = np.array(rows).T + rng.normal(0, noise, (4, n)) * np.array([[1], [1], [10], [1e-3]])
    sd = np.full(n, 5e-4)
    return GapSeries(np.arange(n) * 0.01, x, z, angle, volume, sd, sd, 20 * sd, sd * 1e-3)


def test_gap_poses(tmp_path, stations):
    status = ["ok"] * 30
    status[3], status[9], status[20] = "weak", "rejected", "no_data"
    estimate = series(stations, 5e-4)
    for name in ("x", "z", "angle", "volume"):
        getattr(estimate, name)[[9, 20]] = np.nan
    full = plot_gap_poses(tmp_path / "a.png", estimate, status=status, truth=series(stations), title="J1")
    plain = plot_gap_poses(tmp_path / "b.png", estimate)
    rows, columns = pixels(full).shape[:2]
    assert 1200 < columns < 1500
    assert 1000 < rows < 1400
    assert share_of(full, "#1f5fa8") > 0.002  # the estimate
    weak, rejected = "#d98e04", "#c0392b"
    assert share_of(full, weak) > 20 * max(share_of(plain, weak), 1e-6)
    assert share_of(full, rejected) > 20 * max(share_of(plain, rejected), 1e-6)
    again = plot_gap_poses(tmp_path / "c.png", estimate)
    assert again.read_bytes() == plain.read_bytes()
    svg = plot_gap_poses(tmp_path / "d.svg", estimate).read_text()
    assert svg.startswith("<?xml")


def test_gap_poses_without_sigma_or_with_nothing_known(tmp_path, stations):
    known = dataclasses.replace(
        series(stations), sigma_x=None, sigma_z=None, sigma_angle=None, sigma_volume=None
    )
    assert share_of(plot_gap_poses(tmp_path / "a.png", known), "#1f5fa8") > 0.001
    nan = np.full(30, np.nan)
    nothing = GapSeries(known.s, nan, nan, nan, nan)
    out = plot_gap_poses(tmp_path / "b.png", nothing, status=["no_data"] * 30)
    assert share_of(out, "#1f5fa8") == 0.0


def test_slice(tmp_path, stations):
    x = stations[7]
    full = plot_slice(
        tmp_path / "a.png", x.slice, joint.BOARDS, fitted=x.fitted, gap=[x.gap], title="t", note="n"
    )
    no_gap = plot_slice(tmp_path / "b.png", x.slice, joint.BOARDS)
    assert min(pixels(full).shape[:2]) > 900
    assert share_of(full, "#f5c464") > 0.01  # the gap, three quarters opaque
    assert share_of(no_gap, "#f5c464") < 0.001
    assert share_of(full, "#c0392b") > 0.002  # the scan
    hits = dataclasses.replace(x.slice, beams=None, viewpoint=None)
    assert share_of(plot_slice(tmp_path / "c.png", hits, joint.BOARDS), "#c0392b") > 0.002
    empty = dataclasses.replace(hits, points=np.zeros((0, 2)))
    assert share_of(plot_slice(tmp_path / "d.png", empty, joint.BOARDS), "#c0392b") < 0.0005


def test_tables(tmp_path, stations):
    fine = np.zeros((81, 81))
    fine[40:43], fine[:, 10:13] = 1.0, 0.6
    levels = []
    for k, cells in enumerate((81, 27, 9)):
        n = 81 // cells
        values = fine.reshape(cells, n, cells, n).max(axis=(1, 3))
        levels.append(TableLevel(values, (-0.1, 0.1, -0.1, 0.1), f"level {k + 1}", stations[0].slice.points))
    out = plot_tables(tmp_path / "a.png", levels[::-1])
    assert share_of(out, "#08519c", 40) > 0.03
    assert share_of(out, "#c0392b") > 0.001
    assert pixels(plot_tables(tmp_path / "b.png", levels[:1])).std() > 10


def test_comparison(tmp_path):
    rng = np.random.default_rng(1)
    good = MethodOutcome(np.abs(rng.normal(0, 5e-4, 200)), rng.lognormal(-7, 0.2, 200))
    bad = MethodOutcome(np.where(rng.random(200) < 0.3, np.nan, 0.004), rng.lognormal(-5, 0.2, 200))
    out = plot_comparison(tmp_path / "a.png", {"grcsm": good, "icp": bad})
    assert share_of(out, "#1f5fa8", 45) > 0.005
    assert share_of(out, "#d9822b", 45) > 0.02  # lost bars as well
    with pytest.raises(ValueError, match="at least one"):
        plot_comparison(tmp_path / "b.png", {})
    lost = MethodOutcome(np.full(5, np.nan), np.full(5, 0.01))
    assert plot_comparison(tmp_path / "c.png", {"none": lost}).exists()


def test_the_callers_matplotlib_is_left_alone(tmp_path, stations):
    import matplotlib

    before = dict(matplotlib.rcParams)
    plot_gap_poses(tmp_path / "a.png", series(stations))
    assert dict(matplotlib.rcParams) == before
    assert "matplotlib.pyplot" not in sys.modules or not sys.modules["matplotlib.pyplot"].get_fignums()


def test_unknown_formats_and_places(tmp_path, stations):
    with pytest.raises(ExportError, match="png, svg, pdf"):
        plot_gap_poses(tmp_path / "a.bmp", series(stations))
    with pytest.raises(ExportError, match="png"):
        render_joint(tmp_path / "a.jpg", JointScene())
    with pytest.raises(ExportError, match="nothing to draw"):
        render_joint(tmp_path / "a.png", JointScene())
    (tmp_path / "b.png").mkdir()
    with pytest.raises(ExportError, match="folder"):
        plot_gap_poses(tmp_path / "b.png", series(stations))
    assert [p.name for p in tmp_path.iterdir()] == ["b.png"]


def scene(stations, **more):
    rings = [[x.frame.to_world(x.fitted[k].loops[0]) for x in stations] for k in (0, 1)]
    points = np.concatenate([x.frame.to_world(x.slice.points) for x in stations])
    return JointScene(
        as_built=rings, points=points, up=stations[0].frame.v, along=stations[0].frame.n, **more
    )


def gap_mesh(stations):
    rings = np.array([x.frame.to_world(x.gap) for x in stations])
    n, m = rings.shape[:2]
    faces = []
    for i in range(n - 1):
        for j in range(m):
            p, q = i * m + j, i * m + (j + 1) % m
            faces += [(p, q, q + m), (p, q + m, p + m)]
    width = np.linalg.norm(rings[:, [0, 1, 1, 0]] - rings[:, [3, 2, 2, 3]], axis=2)
    return TriangleMesh.of(rings, faces), width.ravel()


def test_scene_without_a_display(tmp_path, stations, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    view = View(size=(600, 400))
    out = render_joint(tmp_path / "a.png", scene(stations, title="J1"), view)
    assert pixels(out).shape == (400, 600, 3)
    assert share_of(out, "#c0392b", 60) > 0.005  # the scan, at map coordinates where float32 has 0.5 m
    mesh, width = gap_mesh(stations)
    gap = render_joint(
        tmp_path / "b.png", scene(stations, gap=mesh, gap_width=width), View(opacity=0.3, size=(600, 400))
    )
    assert np.abs(pixels(gap) - pixels(out)).max(axis=2).mean() > 3
    alone = JointScene(gap=mesh, gap_width=width)
    near = render_joint(tmp_path / "c.png", alone, View(focus="gap", size=(600, 400)))
    coloured = np.ptp(pixels(near), axis=2) > 60
    assert 0.02 < coloured.mean() < 0.5
    # It fills the picture: nothing of it is cut off, and it reaches from side to side.
    columns = np.flatnonzero(coloured.any(axis=0))
    assert columns[0] > 3
    assert columns[-1] < 596
    assert columns[-1] - columns[0] > 300


def test_no_window_without_a_display(stations, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(BimfitError, match="no display"):
        show(scene(stations))


def test_rendering_says_nothing_on_stderr(tmp_path):
    code = (
        "import numpy as np; from bimfit.report.scene import *; "
        "points = np.random.default_rng(0).random((50, 3)); "
        f"render_joint({str(tmp_path / 'a.png')!r}, JointScene(points=points), View(size=(200, 150)))"
    )
    env = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    run = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr, run.stdout) == (0, "", "")
    assert pixels(tmp_path / "a.png").std() > 1
