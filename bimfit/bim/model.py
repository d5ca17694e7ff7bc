"""A building model: its elements as meshes in world metres."""

from __future__ import annotations

import difflib
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from bimfit.bim.cache import cache_wanted, load_cached, store_cached
from bimfit.bim.georeference import GeoReference
from bimfit.bim.loading import tessellate
from bimfit.bim.source import Source, read_source
from bimfit.errors import JointError, ModelError
from bimfit.geometry.mesh import TriangleMesh

TIME_LIMIT = 30.0
"""Seconds that one element's geometry may take."""

_ODD_SIZES = (2e-3, 500.0)


@dataclass(frozen=True)
class Element:
    """A building element.

    Attributes
    ----------
    guid, name, ifc_class, storey : str
        GlobalId, Name, IFC class and the storey's name; empty where the file has none.
    mesh : TriangleMesh
        In world metres.
    parent_guid : str
        GlobalId of the element that this one is a part of; empty where it is none.
    """

    guid: str
    name: str
    ifc_class: str
    mesh: TriangleMesh
    storey: str = ""
    parent_guid: str = ""


@dataclass(frozen=True)
class Skipped:
    """An element that was left out, and why."""

    guid: str
    name: str
    ifc_class: str
    reason: str


@dataclass(frozen=True)
class Model:
    """A building model.

    World coordinates are the IFC project's, in metres, large offsets included.

    Attributes
    ----------
    path : Path
    schema : str
        As the file names it.
    elements : tuple of Element
        Sorted by GlobalId.
    skipped : tuple of Skipped
    georeference : GeoReference or None
    notes : tuple of str
        What a user should know about how the file was read.
    cached : bool
        Whether what is worked out from it may be kept in the user's cache folder.
    """

    path: Path
    schema: str
    elements: tuple[Element, ...]
    skipped: tuple[Skipped, ...] = ()
    georeference: GeoReference | None = None
    notes: tuple[str, ...] = ()
    cached: bool = False
    _by_guid: dict[str, Element] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self._by_guid.update((element.guid, element) for element in self.elements)

    def element(self, guid: str) -> Element:
        """The element of that GlobalId.

        Raises
        ------
        JointError
            When there is none; says why it was left out, or names the nearest GlobalIds.
        """
        if guid in self._by_guid:
            return self._by_guid[guid]
        parts = [element.guid for element in self.elements if element.parent_guid == guid and guid]
        if parts:
            named = ", ".join(parts[:4]) + (", ..." if len(parts) > 4 else "")
            raise JointError(
                f"element {guid} is made of parts", file=self.path, remedy=f"name a part: {named}"
            )
        for skip in self.skipped:
            if skip.guid == guid:
                raise JointError(f"element {guid} was left out: it {skip.reason}", file=self.path)
        near = difflib.get_close_matches(guid, self._by_guid, n=3, cutoff=0.6)
        remedy = f"the nearest are {', '.join(near)}" if near else "bimfit joints lists those that meet"
        raise JointError(f"no element has the GlobalId {guid}", file=self.path, remedy=remedy)

    def left_out(self, most: int = 20) -> tuple[str, ...]:
        """A line for each element that was skipped, and why; beyond ``most``, how many more there are."""
        lines = [
            f"left out: {' '.join(part for part in (skip.guid, skip.name) if part)} "
            f"({skip.ifc_class}): it {skip.reason}"
            for skip in self.skipped[:most]
        ]
        more = len(self.skipped) - most
        return (*lines, f"left out: {more} more elements") if more > 0 else tuple(lines)

    @cached_property
    def bounds(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Least and greatest corner, m, shape (2, 3)."""
        boxes = np.stack([element.mesh.bounds for element in self.elements])
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


def element_from_mesh(mesh: TriangleMesh, name: str, guid: str | None = None) -> Element:
    """Let a mesh in world metres stand in for an IFC element; its GlobalId follows from name and shape."""
    if guid is None:
        hashed = hashlib.sha256(name.encode() + mesh.vertices.tobytes() + mesh.faces.tobytes())
        guid = _ifc_guid(hashed.digest()[:16])
    return Element(guid, name, "", mesh)


def model_from_elements(elements: Sequence[Element], path: str | Path = "meshes") -> Model:
    """A model of elements that come from elsewhere than an IFC.

    Raises
    ------
    ModelError
        When two of them share a GlobalId.
    """
    ordered = tuple(sorted(elements, key=lambda element: element.guid))
    if len({element.guid for element in ordered}) < len(ordered):
        raise ModelError("two elements have the same GlobalId", file=path)
    return Model(Path(path), "", ordered)


def load_model(
    path: str | Path,
    *,
    include: Sequence[str] | None = None,
    time_limit: float = TIME_LIMIT,
    cache: bool = True,
) -> Model:
    """Load an IFC's elements, whatever its state.

    Parameters
    ----------
    path : path
        An ``.ifc`` or ``.ifczip`` file.
    include : sequence of str, optional
        GlobalIds and IFC classes to load; all elements without it.
    time_limit : float
        Seconds that one element's geometry may take before it is skipped.
    cache : bool
        Whether meshes, and joints found between them, are kept in the user's cache folder, by content.

    Raises
    ------
    ModelError
        When the file cannot be read or holds no element with geometry.
    """
    source = read_source(path)
    cache = cache and cache_wanted()
    kept = load_cached(source.digest) if cache and include is None else None
    if kept is None:
        raw = tessellate(source, include, time_limit)
        failed = {str(number): reason for number, reason in raw.failed.items()}
        about = {"index": raw.index, "failed": failed, "notes": raw.notes}
        kept = about, raw.meshes
        # what failed may have failed for want of time or memory: then try again next time
        if cache and include is None and raw.meshes and not raw.notes and not _by_chance(failed):
            store_cached(source.digest, about, raw.meshes)
    return _assemble(source, *kept, cached=cache and include is None)


def _by_chance(failed: dict[str, str]) -> bool:
    return any("took more than" in reason for reason in failed.values())


def _assemble(
    source: Source, about: dict[str, Any], meshes: dict[int, TriangleMesh], *, cached: bool
) -> Model:
    index = about["index"]
    notes = [*source.notes, *index.get("notes", ()), *about["notes"]]
    elements: dict[str, Element] = {}
    skipped: list[Skipped] = []
    for row in index.get("elements", ()):
        guid, name, kind = row["guid"], row["name"], row["class"]
        if row["id"] not in meshes:
            skipped.append(Skipped(guid, name, kind, about["failed"].get(str(row["id"]), "has no body")))
        elif guid in elements:
            skipped.append(Skipped(guid, name, kind, "has a GlobalId that another element has too"))
        else:
            elements[guid] = Element(guid, name, kind, meshes[row["id"]], row["storey"], row["parent"])
    if not elements:
        raise ModelError(_why_bare(index, skipped), file=source.path)
    if index.get("bare"):
        notes.append(f"{index['bare']} elements without a representation were left out")
    ordered = tuple(elements[guid] for guid in sorted(elements))
    notes.extend(_odd_unit(ordered))
    place = index.get("georeference")
    return Model(
        source.path,
        source.schema,
        ordered,
        tuple(sorted(skipped, key=lambda skip: skip.guid)),
        GeoReference(**place) if place else None,
        tuple(notes),
        cached,
    )


def _why_bare(index: dict[str, Any], skipped: list[Skipped]) -> str:
    if skipped:
        return f"none of its {len(skipped)} elements has readable geometry: the first {skipped[0].reason}"
    if index.get("bare"):
        return f"has no geometry: none of its {index['bare']} elements has a representation"
    return "holds no building element with geometry"


def _odd_unit(elements: Sequence[Element]) -> list[str]:
    """A note where the elements' size speaks for a wrong length unit."""
    sizes = [float(np.linalg.norm(np.ptp(element.mesh.bounds, axis=0))) for element in elements]
    middle = float(np.median(sizes))
    low, high = _ODD_SIZES
    if middle > high:
        return [f"half of its elements measure more than {middle:.0f} m: is its unit millimetre, not metre?"]
    if middle < low:
        return [f"half of its elements measure less than {middle * 1e3:.2g} mm: is its unit metre?"]
    return []


_GUID_DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz_$"


def _ifc_guid(raw: bytes) -> str:
    """16 bytes as an IFC GlobalId: 128 bits in 22 digits of base 64."""
    number = int.from_bytes(raw, "big")
    digits = []
    for _ in range(22):
        number, digit = divmod(number, 64)
        digits.append(_GUID_DIGITS[digit])
    return "".join(reversed(digits))
