"""What an IFC says of its elements beside their shapes: which there are, and where they belong."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

from bimfit.bim.ifc_access import by_type, text_of
from bimfit.bim.map_conversion import read_map_conversion

_NO_ELEMENTS = ("IfcFeatureElement", "IfcVirtualElement")
_KEYWORD = re.compile(rb"#\d+\s*=\s*([A-Za-z]\w*)\s*\(")


def chosen_products(model: Any, include: list[str] | None) -> dict[int, Any]:
    """Step id -> element with a representation, by id; elements taken apart give way to their parts."""
    parents, _ = _relations(model)
    found = {e.id(): e for kind in ("IfcElement", "IfcProxy") for e in by_type(model, kind)}
    found = {i: e for i, e in found.items() if not any(e.is_a(kind) for kind in _NO_ELEMENTS)}
    bodied = {i: e for i, e in found.items() if _has_representation(e)}
    taken_apart = {parents[i] for i in bodied if i in parents and parents[i] in bodied}
    chosen = {i: e for i, e in sorted(bodied.items()) if i not in taken_apart}
    if include is None:
        return chosen
    wanted = set(include)
    named = {i: e for i, e in bodied.items() if e.GlobalId in wanted}
    of_class = {
        i: e for i, e in chosen.items() if any(kind.startswith("Ifc") and _is_a(e, kind) for kind in wanted)
    }
    return dict(sorted({**of_class, **named}.items()))


def _is_a(element: Any, kind: str) -> bool:
    try:
        return bool(element.is_a(kind))
    except RuntimeError:
        return False


def _has_representation(element: Any) -> bool:
    try:
        return element.Representation is not None
    except Exception:
        return False


def _relations(model: Any) -> tuple[dict[int, int], dict[int, Any]]:
    """Part -> whole, and element -> the spatial structure that holds it, by step id."""
    parents: dict[int, int] = {}
    holders: dict[int, Any] = {}
    for relation in by_type(model, "IfcRelDecomposes"):
        try:
            if relation.is_a("IfcRelVoidsElement"):
                continue
            for part in relation.RelatedObjects:
                parents[part.id()] = relation.RelatingObject.id()
        except Exception:
            continue
    for relation in by_type(model, "IfcRelContainedInSpatialStructure"):
        try:
            for element in relation.RelatedElements:
                holders[element.id()] = relation.RelatingStructure
        except Exception:
            continue
    return parents, holders


def describe(model: Any, products: dict[int, Any]) -> dict[str, Any]:
    """Elements' data, the map conversion, notes, and how many elements have no representation."""
    parents, holders = _relations(model)
    rows = []
    for number, element in products.items():
        rows.append(
            {
                "id": number,
                "guid": text_of(element, "GlobalId") or f"#{number}",
                "name": text_of(element, "Name"),
                "class": element.is_a(),
                "storey": _storey(model, number, parents, holders),
                "parent": _parent(model, number, parents),
            }
        )
    georeference, notes = read_map_conversion(model)
    return {
        "elements": rows,
        "georeference": georeference,
        "notes": notes,
        "bare": _without_body(model, products),
    }


def unknown_types(path: str, model: Any) -> list[str]:
    """A note on entities of types that the schema does not know: the parser passes over them in silence."""
    import ifcopenshell

    counts: Counter[bytes] = Counter()
    with Path(path).open("rb") as stream:
        for line in stream:
            counts.update(_KEYWORD.findall(line))
    schema = ifcopenshell.schema_by_name(model.schema_identifier)
    strange = {}
    for name, count in counts.items():
        try:
            schema.declaration_by_name(name.decode("ascii", "replace"))
        except RuntimeError:
            strange[name.decode("ascii", "replace")[:60]] = count
    if not strange:
        return []
    named = ", ".join(sorted(strange)[:5]) + (", ..." if len(strange) > 5 else "")
    total = sum(strange.values())
    return [f"{total} entities of types that {model.schema_identifier} does not know were not read: {named}"]


def _without_body(model: Any, products: dict[int, Any]) -> int:
    parents, _ = _relations(model)
    wholes = set(parents.values())
    elements = (e for e in by_type(model, "IfcElement") if not any(e.is_a(kind) for kind in _NO_ELEMENTS))
    return sum(
        e.id() not in products and e.id() not in wholes and not _has_representation(e) for e in elements
    )


def _parent(model: Any, number: int, parents: dict[int, int]) -> str:
    return text_of(model.by_id(parents[number]), "GlobalId") if number in parents else ""


def _storey(model: Any, number: int, parents: dict[int, int], holders: dict[int, Any]) -> str:
    """The storey's name, up through the wholes an element is part of; cycles end the search."""
    seen: set[int] = set()
    while number not in holders and number in parents and number not in seen:
        seen.add(number)
        number = parents[number]
    holder = holders.get(number)
    while holder is not None and holder.id() not in seen:
        seen.add(holder.id())
        if holder.is_a("IfcBuildingStorey"):
            return text_of(holder, "Name") or text_of(holder, "GlobalId")
        above = parents.get(holder.id())
        holder = model.by_id(above) if above is not None else None
    return ""
