"""Choosing joints: what is chosen is what a filter over all of them gives, and ids never change."""

from __future__ import annotations

import json
import math

import ifcopenshell
import pytest

from bimfit.bim.joints import find_joints
from bimfit.bim.model import load_model
from bimfit.bim.selection import Selection, choose_joints, read_pairs
from bimfit.config import JointConfig
from bimfit.errors import BimfitError, ConfigError, JointError


@pytest.fixture(scope="module")
def facade(samples):
    return load_model(samples / "facade.ifc")


@pytest.fixture(scope="module")
def joints(facade):
    return find_joints(facade)


def ids(found):
    return [joint.id for joint in found]


@pytest.mark.parametrize(
    ("choice", "rule"),
    [
        (Selection(), lambda j, e: True),
        (Selection(storeys=("Storey 2",)), lambda j, e: all(x.storey == "Storey 2" for x in e)),
        (Selection(storeys=("storey 2 ", "Storey 3")), lambda j, e: all(x.storey != "Storey 1" for x in e)),
        (Selection(classes=("IfcBuildingElement",)), lambda j, e: True),
        (Selection(min_length=2.99), lambda j, e: j.length >= 2.99),
        (Selection(min_length=2.98), lambda j, e: True),  # designed 2.98 m, whatever its last digits
        (Selection(width=(-math.inf, 0.02)), lambda j, e: True),
        (Selection(width=(0.0199, 0.0201), min_length=2.99), lambda j, e: j.length >= 2.99),
        (
            Selection(selector="IfcWall, Name=/Panel [12].*/"),
            lambda j, e: all(not x.name.startswith("Panel 3") for x in e),
        ),
        (
            Selection(selector="IfcWall, Name=/Panel [12].*/", storeys=("Storey 1",), min_length=2.0),
            lambda j, e: all(x.name.startswith("Panel 1") for x in e),
        ),
    ],
)
def test_a_choice_is_a_filter(facade, joints, choice, rule):
    wanted = [joint for joint in joints if rule(joint, [facade.element(guid) for guid in joint.elements])]
    assert ids(choose_joints(facade, choice)) == ids(wanted)
    assert wanted


def test_wider_gaps_and_shorter_joints_than_usual_are_looked_for(facade, joints):
    assert ids(choose_joints(facade, Selection(width=(0.0, 0.2), min_length=0.01))) == ids(joints)
    narrow = JointConfig(max_gap=0.010)
    assert ids(choose_joints(facade, Selection(width=(-math.inf, 0.03)), narrow)) == ids(joints)
    with pytest.raises(JointError, match="within 10 mm"):
        choose_joints(facade, Selection(), narrow)


def test_names_keep_their_order_and_are_narrowed_by_the_rest(facade, joints):
    last, first = joints[-1], joints[0]
    pair = ",".join(last.elements)
    assert ids(choose_joints(facade, Selection(names=(pair, first.id)))) == [last.id, first.id]
    chosen = choose_joints(facade, Selection(names=tuple(ids(joints)), storeys=("Storey 3",)))
    assert ids(chosen) == ids(choose_joints(facade, Selection(storeys=("Storey 3",))))
    with pytest.raises(JointError, match=f"{last.id} does not fit --length: it is 20.0 mm wide"):
        choose_joints(facade, Selection(names=(last.id,), min_length=5.0))


def test_pairs_take_what_bimfit_joints_prints(facade, joints, tmp_path):
    file = tmp_path / "pairs.json"
    a, b, c = joints[:3]
    file.write_text(json.dumps([a.to_dict(), list(b.elements), c.id]))
    assert ids(choose_joints(facade, Selection(pairs=file))) == ids((a, b, c))
    file.write_text(
        json.dumps({"joints": [{"elements": list(c.elements), "id": "gone"}]}), encoding="utf-8-sig"
    )
    assert ids(choose_joints(facade, Selection(pairs=file))) == [c.id]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1", "is not JSON"),
        ("{}", "no array"),
        ("[]", "names no pair"),
        ('[["a"]]', "item 1: is not a pair"),
        ('["x", {"elements": "a,b"}]', "item 2: is not a pair"),
        ("[[1, 2]]", "item 1"),
    ],
)
def test_a_file_that_names_no_pairs_is_refused(text, message, tmp_path):
    file = tmp_path / "pairs.json"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_pairs(file)
    assert str(file) in str(caught.value)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_pairs(tmp_path / "missing.json")


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        (Selection(classes=("IfcWal",)), "no IFC class IfcWal; did you mean IfcWall"),
        (Selection(classes=("IfcSlab",)), "no element is of class IfcSlab; the model has IfcWall"),
        (Selection(storeys=("Roof",)), "'Roof'; the model has Storey 1, Storey 2, Storey 3"),
        (Selection(selector="IfcWall,,"), "column 9"),
        (Selection(selector="("), "ends too early"),
        (Selection(selector="IfcDoor"), "nothing is found by the selector 'IfcDoor'"),
        (Selection(selector="IfcProject"), "none of its elements with geometry"),
        (Selection(width=(0.03, 0.06)), "none of 17 joints fits --width: they are 20.0 to 20.0 mm wide"),
        (Selection(names=("nosuch",)), "no joint has the id nosuch"),
    ],
)
def test_what_is_not_there_is_named(facade, choice, message):
    with pytest.raises(BimfitError) as caught:
        choose_joints(facade, choice)
    assert message in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_a_selected_whole_stands_for_its_parts(samples, tmp_path):
    file = ifcopenshell.open(samples / "square-butt-ifc4.ifc")
    a, b = file.by_type("IfcPlate")
    slab = file.create_entity("IfcSlab", GlobalId=ifcopenshell.guid.new(), Name="floor")
    file.create_entity(
        "IfcRelAggregates", GlobalId=ifcopenshell.guid.new(), RelatingObject=slab, RelatedObjects=[a, b]
    )
    file.write(str(tmp_path / "parts.ifc"))
    model = load_model(tmp_path / "parts.ifc")
    (joint,) = choose_joints(model, Selection(selector="IfcSlab, Name=floor"))
    assert set(joint.elements) == {a.GlobalId, b.GlobalId}


def test_an_overlap_is_named_a_clash(samples, tmp_path):
    file = ifcopenshell.open(samples / "square-butt-ifc4.ifc")
    board = file.by_type("IfcPlate")[0]
    point = board.ObjectPlacement.RelativePlacement.Location
    for shift in (0.030, -0.030):
        moved = ifcopenshell.open(samples / "square-butt-ifc4.ifc")
        same = moved.by_guid(board.GlobalId).ObjectPlacement.RelativePlacement.Location
        same.Coordinates = (point.Coordinates[0] + shift, *point.Coordinates[1:])
        moved.write(str(tmp_path / "clash.ifc"))
        found = choose_joints(load_model(tmp_path / "clash.ifc"), Selection(width=(-0.06, 0.06)))
        if found[0].width < 0:
            break
    assert found[0].state == "clash"
    assert found[0].width == pytest.approx(-0.005, abs=1e-6)
    assert found[0].to_dict()["state"] == "clash"
