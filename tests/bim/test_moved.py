"""Elements moved in a model: what belongs to them comes along, and nothing else does."""

from __future__ import annotations

import ifcopenshell
import ifcopenshell.util.element
import ifcopenshell.util.placement
import ifcopenshell.validate
import numpy as np
import pytest

from bimfit.bim.as_built import DEVIATION_SET, MovedElement, write_as_built

T = np.eye(4)
T[:2, :2] = [[np.cos(0.01), -np.sin(0.01)], [np.sin(0.01), np.cos(0.01)]]
T[:3, 3] = 0.004, -0.003, 0.002


def world(product, unit):
    matrix = ifcopenshell.util.placement.get_local_placement(product.ObjectPlacement)
    matrix[:3, 3] *= unit
    return matrix


def placed(file, kind, name, parent, at, placement=None):
    make = file.create_entity
    axes = make("IfcAxis2Placement3D", make("IfcCartesianPoint", tuple(map(float, at))))
    where = placement or make("IfcLocalPlacement", parent, axes)
    return make(kind, GlobalId=ifcopenshell.guid.new(), Name=name, ObjectPlacement=where)


@pytest.fixture(params=["square-butt-ifc2x3.ifc", "square-butt-ifc4.ifc", "square-butt-ifc4x3.ifc"])
def assembly(samples, tmp_path, request):
    """A board with parts, an opening and its filling; bystanders placed under it or sharing its placement."""
    file = ifcopenshell.open(samples / request.param)
    a, b = file.by_type("IfcPlate")
    unit = 1.0 if request.param.endswith("ifc4.ifc") else 1e-3
    here = a.ObjectPlacement
    storey = here.PlacementRelTo
    made = {
        "part": placed(file, "IfcBuildingElementPart", "part", here, (1, 0, 0)),
        "absolute part": placed(file, "IfcBuildingElementPart", "absolute part", storey, (7, 1, 0)),
        "sharing part": placed(file, "IfcBuildingElementPart", "sharing part", None, (), here),
        "hole": placed(file, "IfcOpeningElement", "hole", here, (2, 0, 0)),
        "bystander": placed(file, "IfcBeam", "bystander", here, (3, 0, 0)),
        "sharer": placed(file, "IfcBeam", "sharer", None, (), here),
    }
    made["filling"] = placed(file, "IfcDoor", "filling", made["hole"].ObjectPlacement, (0, 1, 0))
    made["under"] = placed(file, "IfcBeam", "under", made["filling"].ObjectPlacement, (0, 0, 4))
    parts = [made[name] for name in ("part", "absolute part", "sharing part")]
    make, new = file.create_entity, ifcopenshell.guid.new
    make("IfcRelAggregates", GlobalId=new(), RelatingObject=a, RelatedObjects=parts)
    make("IfcRelVoidsElement", GlobalId=new(), RelatingBuildingElement=a, RelatedOpeningElement=made["hole"])
    make(
        "IfcRelFillsElement",
        GlobalId=new(),
        RelatingOpeningElement=made["hole"],
        RelatedBuildingElement=made["filling"],
    )
    path = tmp_path / "assembly.ifc"
    file.write(str(path))
    return path, unit, a.GlobalId, b.GlobalId, {name: one.GlobalId for name, one in made.items()}


def test_what_belongs_comes_along_and_nothing_else(assembly, tmp_path):
    path, unit, board, other, made = assembly
    output = write_as_built(path, [], tmp_path / "out.ifc", moved={board: T})
    old, new = ifcopenshell.open(path), ifcopenshell.open(output)
    carried = {board, *(made[n] for n in ("part", "absolute part", "sharing part", "hole", "filling"))}
    for guid in (board, other, *made.values()):
        before, after = (world(file.by_guid(guid), unit) for file in (old, new))
        wanted = T @ before if guid in carried else before
        np.testing.assert_allclose(after, wanted, atol=1e-9, err_msg=new.by_guid(guid).Name)


def test_a_part_that_moved_by_itself_goes_its_own_way(assembly, tmp_path):
    path, unit, board, other, made = assembly
    own = np.eye(4)
    own[:3, 3] = -0.001, 0.0, 0.005
    moved = {board: MovedElement(T, 80, 0.0004, 1), made["part"]: own, other: own}
    output = write_as_built(path, [], tmp_path / "out.ifc", moved=moved)
    old, new = ifcopenshell.open(path), ifcopenshell.open(output)
    for guid, motion in ((board, T), (made["part"], own), (made["filling"], T), (other, own)):
        before, after = (world(file.by_guid(guid), unit) for file in (old, new))
        np.testing.assert_allclose(after, motion @ before, atol=1e-9)
    told = ifcopenshell.util.element.get_psets(new.by_guid(board))[DEVIATION_SET]
    assert (told["Moved"], told["Stations"], told["UndeterminedDirections"]) == (True, 80, 1)
    assert told["ResidualRms"] == pytest.approx(0.0004 / unit)
    assert "Stations" not in ifcopenshell.util.element.get_psets(new.by_guid(other))[DEVIATION_SET]


def test_an_element_without_a_local_placement_is_left_and_says_so(samples, tmp_path):
    file = ifcopenshell.open(samples / "square-butt-ifc4.ifc")
    board = file.by_type("IfcPlate")[0]
    beam = file.create_entity("IfcBeam", GlobalId=ifcopenshell.guid.new(), Name="nowhere")
    file.write(str(tmp_path / "model.ifc"))
    moved = {beam.GlobalId: T, board.GlobalId: T}
    output = write_as_built(tmp_path / "model.ifc", [], tmp_path / "out.ifc", moved=moved)
    new = ifcopenshell.open(output)
    told = ifcopenshell.util.element.get_psets(new.by_guid(beam.GlobalId))[DEVIATION_SET]
    assert told["Moved"] is False and "local" in told["Reason"]
    assert ifcopenshell.util.element.get_psets(new.by_guid(board.GlobalId))[DEVIATION_SET]["Moved"] is True
