"""The child process that opens an IFC and tessellates it: ``python -m bimfit.bim.tessellate``.

It reads a request (JSON) from standard input and writes messages to standard output. A message is a line
of JSON, followed by ``bytes`` bytes of arrays. If the geometry kernel crashes or hangs, this process ends and
the one that started it goes on (:mod:`bimfit.bim.loading`).
"""

from __future__ import annotations

import json
import math
import os
import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from bimfit.bim.georeference import map_scale
from bimfit.bim.winding import welded, wound_outwards

_NO_ELEMENTS = ("IfcFeatureElement", "IfcVirtualElement")
_KEYWORD = re.compile(rb"#\d+\s*=\s*([A-Za-z]\w*)\s*\(")
_FAR = 1e8


def main() -> None:
    """Answer one request."""
    out = _claim_stdout()
    request = json.loads(sys.stdin.buffer.read())
    _limit_resources(request["memory"])
    try:
        _serve(request, out)
    except Exception as error:
        _send(
            out, {"kind": "error", "message": f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]}
        )
    # skips the parser's destructors, which are slow and may crash
    os._exit(0)


def _serve(request: dict[str, Any], out: BinaryIO) -> None:
    import ifcopenshell

    model = ifcopenshell.open(request["path"])
    products = _products(model, request["include"])
    if request["index"]:
        index = _index(model, products)
        index["notes"] += _unknown(request["path"], model)
        _send(out, {"kind": "index", **index})
    left = {i: e for i, e in products.items() if i not in set(request["done"])}
    _send(out, {"kind": "begin", "count": len(left)})
    if request["one_by_one"]:
        _one_by_one(left, out)
    else:
        _all_at_once(model, left, request["threads"], out)
    _send(out, {"kind": "end"})


def _settings() -> Any:
    import ifcopenshell.geom

    settings = ifcopenshell.geom.settings()
    settings.set("reorient-shells", True)
    return settings


def _all_at_once(model: Any, products: dict[int, Any], threads: int, out: BinaryIO) -> None:
    import ifcopenshell.geom

    if not products:
        return
    chosen = list(products.values())
    iterator = ifcopenshell.geom.iterator(
        _settings(), model, threads, include=chosen, geometry_library="opencascade"
    )
    if not iterator.initialize():
        return
    while True:
        shape = iterator.get()
        _send_shape(shape, shape.id, out)
        if not iterator.next():
            break


def _one_by_one(products: dict[int, Any], out: BinaryIO) -> None:
    import ifcopenshell.geom

    settings = _settings()
    for number, product in products.items():
        _send(out, {"kind": "start", "id": number})
        try:
            shape = ifcopenshell.geom.create_shape(settings, product, geometry_library="opencascade")
            _send_shape(shape, number, out)
        except Exception as error:
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            _send(out, {"kind": "failed", "id": number, "reason": reason})


def _send_shape(shape: Any, number: int, out: BinaryIO) -> None:
    import ifcopenshell.util.shape as shapes

    # Local coordinates and a float64 placement: nothing is lost at map coordinates.
    local = np.asarray(shapes.get_vertices(shape.geometry), np.float64).reshape(-1, 3)
    faces = np.asarray(shapes.get_faces(shape.geometry), np.int64).reshape(-1, 3)
    placement = np.asarray(shapes.get_shape_matrix(shape), np.float64)
    with np.errstate(all="ignore"):
        world = local @ placement[:3, :3].T + placement[:3, 3]
    if not len(faces):
        _send(out, {"kind": "failed", "id": number, "reason": "has a body without faces"})
    elif not np.all(np.isfinite(world)) or np.abs(world).max() > _FAR:
        _send(
            out,
            {"kind": "failed", "id": number, "reason": "has coordinates that are not finite or absurdly far"},
        )
    else:
        kept, corners = welded(local, faces)
        if not len(corners):
            _send(out, {"kind": "failed", "id": number, "reason": "has a body without faces"})
            return
        vertices = np.ascontiguousarray(world[kept])
        corners = np.ascontiguousarray(wound_outwards(vertices - vertices.mean(axis=0), corners), np.int32)
        head = {"kind": "mesh", "id": number, "vertices": len(vertices), "faces": len(corners)}
        _send(out, head, vertices.tobytes() + corners.tobytes())


def _products(model: Any, include: list[str] | None) -> dict[int, Any]:
    """Step id -> element with a representation, by id; elements taken apart give way to their parts."""
    parents, _ = _relations(model)
    found = {e.id(): e for kind in ("IfcElement", "IfcProxy") for e in _by_type(model, kind)}
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


def _by_type(model: Any, kind: str) -> list[Any]:
    try:
        return list(model.by_type(kind))
    except RuntimeError:
        return []


def _has_representation(element: Any) -> bool:
    try:
        return element.Representation is not None
    except Exception:
        return False


def _relations(model: Any) -> tuple[dict[int, int], dict[int, Any]]:
    """Part -> whole, and element -> the spatial structure that holds it, by step id."""
    parents: dict[int, int] = {}
    holders: dict[int, Any] = {}
    for relation in _by_type(model, "IfcRelDecomposes"):
        try:
            if relation.is_a("IfcRelVoidsElement"):
                continue
            for part in relation.RelatedObjects:
                parents[part.id()] = relation.RelatingObject.id()
        except Exception:
            continue
    for relation in _by_type(model, "IfcRelContainedInSpatialStructure"):
        try:
            for element in relation.RelatedElements:
                holders[element.id()] = relation.RelatingStructure
        except Exception:
            continue
    return parents, holders


def _index(model: Any, products: dict[int, Any]) -> dict[str, Any]:
    parents, holders = _relations(model)
    rows = []
    for number, element in products.items():
        rows.append(
            {
                "id": number,
                "guid": _text(element, "GlobalId") or f"#{number}",
                "name": _text(element, "Name"),
                "class": element.is_a(),
                "storey": _storey(model, number, parents, holders),
                "parent": _parent(model, number, parents),
            }
        )
    georeference, notes = _georeference(model)
    return {
        "elements": rows,
        "georeference": georeference,
        "notes": notes,
        "bare": _without_body(model, products),
    }


def _unknown(path: str, model: Any) -> list[str]:
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
    elements = (e for e in _by_type(model, "IfcElement") if not any(e.is_a(kind) for kind in _NO_ELEMENTS))
    return sum(
        e.id() not in products and e.id() not in wholes and not _has_representation(e) for e in elements
    )


def _text(entity: Any, name: str) -> str:
    try:
        value = getattr(entity, name, None)
    except Exception:
        return ""
    return "" if value is None else str(value)


def _parent(model: Any, number: int, parents: dict[int, int]) -> str:
    return _text(model.by_id(parents[number]), "GlobalId") if number in parents else ""


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
            return _text(holder, "Name") or _text(holder, "GlobalId")
        above = parents.get(holder.id())
        holder = model.by_id(above) if above is not None else None
    return ""


def _georeference(model: Any) -> tuple[dict[str, Any] | None, list[str]]:
    """The map conversion in metres, from IfcMapConversion or the property set of IFC2X3."""
    import ifcopenshell.util.unit

    notes: list[str] = []
    try:
        project_unit = float(ifcopenshell.util.unit.calculate_unit_scale(model))
    except Exception:
        project_unit = 1.0
        notes.append("the length unit could not be read and was taken as metre")
    found = [(source, values) for source, values in _conversions(model) if values]
    if not found:
        return None, notes
    source, values = found[0]
    different = [other for other in found[1:] if other[1] != values]
    if different:
        where = ", ".join(other for other, _ in different)
        notes.append(
            f"the model carries a second, different map conversion ({where}); the one in {source} is used"
        )
    map_unit = values.get("MapUnit") or _default_map_unit(values, project_unit)
    scale, note = map_scale(values.get("Scale") or 1.0, map_unit, project_unit)
    if note:
        notes.append(note)
    abscissa, ordinate = values.get("XAxisAbscissa"), values.get("XAxisOrdinate")
    turn = 0.0 if abscissa is None or ordinate is None else math.atan2(ordinate, abscissa)
    return {
        "crs": values.get("Name") or "",
        "eastings": (values.get("Eastings") or 0.0) * map_unit,
        "northings": (values.get("Northings") or 0.0) * map_unit,
        "height": (values.get("OrthogonalHeight") or 0.0) * map_unit,
        "rotation": turn,
        "scale": scale,
        "source": source,
    }, notes


def _default_map_unit(values: dict[str, Any], project_unit: float) -> float:
    """Without a map unit the project's counts, unless eastings in it would be next to the grid's origin."""
    size = max(abs(values.get("Eastings") or 0.0), abs(values.get("Northings") or 0.0))
    return 1.0 if size * project_unit < 10_000.0 <= size else project_unit


_CONVERSION = ("Eastings", "Northings", "OrthogonalHeight", "XAxisAbscissa", "XAxisOrdinate", "Scale")


def _conversions(model: Any) -> list[tuple[str, dict[str, Any]]]:
    out = []
    for entity in _by_type(model, "IfcMapConversion"):
        values = {name: _number(getattr(entity, name, None)) for name in _CONVERSION}
        crs = getattr(entity, "TargetCRS", None)
        out.append(("IfcMapConversion", {**values, **_crs(crs)}))
    for holder in [*_by_type(model, "IfcProject"), *_by_type(model, "IfcSite")]:
        values = _property_sets(holder)
        if values:
            out.append((f"ePSet_MapConversion of {holder.is_a()}", values))
    return out


def _crs(crs: Any) -> dict[str, Any]:
    if crs is None:
        return {}
    unit = getattr(crs, "MapUnit", None)
    size = None if unit is None else _unit_size(unit)
    return {"Name": _text(crs, "Name"), "MapUnit": size}


def _unit_size(unit: Any) -> float | None:
    """Metres a unit: SI with its prefix, or a conversion-based unit."""
    prefixes = {"MILLI": 1e-3, "CENTI": 1e-2, "DECI": 1e-1, "KILO": 1e3, None: 1.0}
    try:
        if unit.is_a("IfcSIUnit"):
            return prefixes.get(unit.Prefix)
        return float(unit.ConversionFactor.ValueComponent.wrappedValue)
    except Exception:
        return None


def _property_sets(holder: Any) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for relation in getattr(holder, "IsDefinedBy", None) or ():
        pset = getattr(relation, "RelatingPropertyDefinition", None)
        title = _text(pset, "Name").lower() if pset is not None else ""
        if title not in ("epset_mapconversion", "epset_projectedcrs"):
            continue
        for item in getattr(pset, "HasProperties", None) or ():
            value = getattr(getattr(item, "NominalValue", None), "wrappedValue", None)
            key = _text(item, "Name")
            if key in _CONVERSION:
                values[key] = _number(value)
            elif key == "Name":
                values["Name"] = str(value)
    return values if any(values.get(key) is not None for key in _CONVERSION) else {}


def _number(value: Any) -> float | None:
    try:
        number = float(getattr(value, "wrappedValue", value))
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _claim_stdout() -> BinaryIO:
    """Keep standard output for messages; what the parser prints goes nowhere."""
    mine = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    return os.fdopen(mine, "wb", buffering=1 << 16)


def _limit_resources(memory: int) -> None:
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    except (ImportError, ValueError, OSError):
        return


def _send(out: BinaryIO, head: dict[str, Any], payload: bytes = b"") -> None:
    out.write(json.dumps({**head, "bytes": len(payload)}).encode() + b"\n")
    if payload:
        out.write(payload)
    out.flush()


if __name__ == "__main__":
    main()
