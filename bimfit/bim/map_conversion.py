"""Where an IFC says that it lies on the map: IfcMapConversion, or the property sets of IFC2X3."""

from __future__ import annotations

import math
from typing import Any

from bimfit.bim.georeference import map_scale
from bimfit.bim.ifc_access import by_type, number_of, text_of


def read_map_conversion(model: Any) -> tuple[dict[str, Any] | None, list[str]]:
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
    for entity in by_type(model, "IfcMapConversion"):
        values = {name: number_of(getattr(entity, name, None)) for name in _CONVERSION}
        crs = getattr(entity, "TargetCRS", None)
        out.append(("IfcMapConversion", {**values, **_crs(crs)}))
    for holder in [*by_type(model, "IfcProject"), *by_type(model, "IfcSite")]:
        values = _property_sets(holder)
        if values:
            out.append((f"ePSet_MapConversion of {holder.is_a()}", values))
    return out


def _crs(crs: Any) -> dict[str, Any]:
    if crs is None:
        return {}
    unit = getattr(crs, "MapUnit", None)
    size = None if unit is None else _unit_size(unit)
    return {"Name": text_of(crs, "Name"), "MapUnit": size}


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
        title = text_of(pset, "Name").lower() if pset is not None else ""
        if title not in ("epset_mapconversion", "epset_projectedcrs"):
            continue
        for item in getattr(pset, "HasProperties", None) or ():
            value = getattr(getattr(item, "NominalValue", None), "wrappedValue", None)
            key = text_of(item, "Name")
            if key in _CONVERSION:
                values[key] = number_of(value)
            elif key == "Name":
                values["Name"] = str(value)
    return values if any(values.get(key) is not None for key in _CONVERSION) else {}
