"""results.json to the letter, for a model at map coordinates in millimetres: nothing lost or made up."""

from __future__ import annotations

import csv
import json

import ifcopenshell
import ifcopenshell.util.element
import ifcopenshell.util.placement
import numpy as np
import pytest
import trimesh

from bimfit.bim.joints import find_joints
from bimfit.bim.model import load_model
from bimfit.bim.validation import lost_ids, new_messages
from bimfit.cli.main import main
from bimfit.pipeline.document import read_results

EAST = np.array([458657.125, 5438232.625, 112.25])


@pytest.fixture(scope="module")
def far(samples, tmp_path_factory):
    """The packaged joint moved to map coordinates, scanned there, two sweeps lost, and fitted."""
    folder = tmp_path_factory.mktemp("far")
    file = ifcopenshell.open(samples / "square-butt-ifc2x3.ifc")
    for board in file.by_type("IfcPlate"):
        place = board.ObjectPlacement
        while place.PlacementRelTo is not None:
            place = place.PlacementRelTo
        point = place.RelativePlacement.Location
    point.Coordinates = tuple(1e3 * EAST)
    model = folder / "model.ifc"
    file.write(str(model))
    (folder / "coarse.toml").write_text("spacing = 0.1\n")
    scan = folder / "scan.csv"
    words = ["--scenario", str(folder / "coarse.toml"), "--seed", "3"]
    assert main(["simulate", str(model), *words, "-o", str(scan)]) == 0
    head, *lines = scan.read_text().splitlines()
    kept = [line if line.split(",")[0] not in ("3", "4") else f"{line.rsplit(',', 1)[0]}," for line in lines]
    scan.write_text("\n".join([head, *kept]) + "\n")
    out = folder / "out"
    words = ["--no-pictures", "--motion", "independent", "--move-elements", "--limits", "width=..60mm"]
    assert main(["fit", str(model), str(scan), *words, "-o", str(out)]) == 0
    return model, out, json.loads((out / "results.json").read_text())


def test_frames_and_motions(far):
    _, _, value = far
    (joint,) = value["joints"]
    measured = 0
    for station in joint["stations"]:
        origin, u, v, n = (np.array(station["frame"][k]) for k in ("origin", "u", "v", "n"))
        assert np.linalg.norm(origin - EAST) < 2.0
        R = np.column_stack([u, v, n])
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0)
        if station["gap"] is None:
            assert station["status"] not in ("ok", "weak") and station["reason"]
            for component in station["components"]:
                assert component["transform"] is component["pose"] is component["covariance"] is None
            continue
        measured += 1
        half = 0.5 * joint["designed"]["width"]
        corners = []
        for component, side in zip(station["components"], (-1.0, 1.0), strict=True):
            T = np.array(component["transform"]).reshape(4, 4)
            du, dv, turn = component["pose"]
            # the designed mouth corner, half the width from the frame's origin, carried to where it is
            designed = origin + side * half * u
            built = T[:3, :3] @ designed + T[:3, 3]
            c, s = np.cos(turn), np.sin(turn)
            expected = origin + (side * half * c + du) * u + (side * half * s + dv) * v
            np.testing.assert_allclose(built, expected, atol=2e-9 * np.linalg.norm(EAST) ** 0.5)
            np.testing.assert_allclose(T[:3, :3] @ n, n, atol=1e-12)
            cov = np.array(component["covariance"])
            assert np.allclose(cov, cov.T) and np.linalg.eigvalsh(cov).min() > 0.0
            corners.append(expected)
        gap = station["gap"]
        np.testing.assert_allclose(np.mean(corners, axis=0), gap["origin"], atol=1e-8)
        assert abs(gap["width"]["mouth"]) == pytest.approx(np.linalg.norm(corners[1] - corners[0]), abs=1e-8)
        assert gap["step"] == pytest.approx((corners[1] - corners[0]) @ v, abs=1e-8)
        ring = (np.array(gap["polygon"]) - origin) @ R
        x, y = ring[:, 0], ring[:, 1]
        area = 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))
        np.testing.assert_allclose(ring[:, 2], 0.0, atol=1e-8)
        assert area == pytest.approx(gap["area"], rel=1e-5)
        assert gap["sigma"]["width"] > 0.0 and gap["designed"]["width"]["mouth"] == pytest.approx(2 * half)
    assert measured >= 6


def test_what_is_not_known_is_null(far):
    _, out, value = far
    (joint,) = value["joints"]
    lost = [station for station in joint["stations"] if station["status"] == "no_data"]
    assert len(lost) == 2
    for station in lost:
        search = station["combined"]
        assert search["transform"] is search["score"] is search["bound"] is search["stop"] is None
        assert station["gap"] is None
    rows = list(csv.DictReader((out / "stations.csv").read_text().splitlines()))
    empty = [row for row in rows if row["status"] == "no_data"]
    assert len(empty) == 2
    for row in empty:
        numbers = {k: v for k, v in row.items() if k.endswith(("_m", "_rad", "_m2")) and k != "s_m"}
        assert set(numbers.values()) == {""}
    texts = json.dumps(value)
    assert "NaN" not in texts and "Infinity" not in texts


def test_meshes_say_where_they_are(far):
    _, out, value = far
    (joint,) = value["joints"]
    assert joint["mesh"] == f"gap-{joint['id']}.glb" and (out / joint["mesh"]).is_file()
    truth = trimesh.load_mesh(out / joint["meshes"]["ply"], process=False).bounds
    stl = trimesh.load_mesh(out / joint["meshes"]["stl"], process=False)
    offset = np.array(joint["mesh_offsets"]["stl"])
    assert np.linalg.norm(stl.bounds) < 10.0  # single precision has no map coordinates to hold
    np.testing.assert_allclose(stl.bounds + offset, truth, atol=1e-7)
    assert joint["mesh_offset"] == joint["mesh_offsets"]["glb"]


def test_the_model_holds_the_same_gap_and_what_moved(far):
    model, out, value = far
    (joint,) = value["joints"]
    new, old = ifcopenshell.open(out / "as-built.ifc"), ifcopenshell.open(model)
    (gap,) = new.by_type("IfcVirtualElement")
    told = ifcopenshell.util.element.get_psets(gap)["BimfitPset_AsBuiltGap"]
    widths = [s["gap"]["width"]["mouth"] for s in joint["stations"] if s["status"] in ("ok", "weak")]
    assert told["WidthMean"] == pytest.approx(1e3 * np.mean(widths))
    assert told["Volume"] == pytest.approx(joint["volume"]["mesh"])
    for guid in joint["elements"]:
        moved = ifcopenshell.util.element.get_psets(new.by_guid(guid))["BimfitPset_AsBuiltDeviation"]
        assert moved["Stations"] == len(widths)
        before, after = (
            ifcopenshell.util.placement.get_local_placement(file.by_guid(guid).ObjectPlacement)[:3, 3]
            for file in (old, new)
        )
        assert np.linalg.norm(after - before) == pytest.approx(moved["Distance"], abs=1e-4)
        assert 0.1 < moved["Distance"] < 60.0  # mm: it moved, and not by kilometres


def test_our_own_gaps_are_no_building(far):
    """The as-built model as the next run's model: the same elements, and the gaps fill and join nothing."""
    model, out, _ = far
    before, after = load_model(model), load_model(out / "as-built.ifc")
    assert [e.guid for e in after.elements] == [e.guid for e in before.elements]
    (joint,) = find_joints(after)
    assert joint.filler is None and joint.state == "open"
    assert new_messages(model, out / "as-built.ifc") == []
    assert lost_ids(model, out / "as-built.ifc") == []
    assert lost_ids(out / "as-built.ifc", model) != []


def test_the_document_reads_what_was_written(far):
    _, out, value = far
    results = read_results(out)
    assert results.limits == {"width": (-np.inf, 0.06)}
    (one,) = results.joints
    np.testing.assert_array_equal(
        one.stations[0].origin, value["joints"][0]["stations"][0]["frame"]["origin"]
    )
    assert len(one.path) >= 2 and one.storey and all(one.classes)


def test_files_that_are_read_are_never_overwritten(far, samples, capsys):
    """Pairs may come from the results of an earlier run; then the new ones go elsewhere."""
    model, out, _ = far
    before = (out / "results.json").read_bytes()
    words = ["fit", str(model), str(out.parent / "scan.csv"), "--pairs", str(out / "results.json")]
    assert main([*words, "-o", str(out)]) == 2
    assert "never overwritten" in capsys.readouterr().err
    assert (out / "results.json").read_bytes() == before
