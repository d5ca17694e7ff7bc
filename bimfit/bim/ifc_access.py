"""Attributes and entities of an IFC, as far as damaged files let them be read."""

from __future__ import annotations

import math
from typing import Any


def by_type(model: Any, kind: str) -> list[Any]:
    """All entities of a class; none where the schema does not know it."""
    try:
        return list(model.by_type(kind))
    except RuntimeError:
        return []


def text_of(entity: Any, name: str) -> str:
    """An attribute as text; empty where it is not there or cannot be read."""
    try:
        value = getattr(entity, name, None)
    except Exception:
        return ""
    return "" if value is None else str(value)


def number_of(value: Any) -> float | None:
    """A value or a measure as a finite number, or None."""
    try:
        number = float(getattr(value, "wrappedValue", value))
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None
