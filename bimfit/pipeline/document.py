"""results.json read back: what reports, schedules and issues are made of, in the same run or years later."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array

NAME = "results.json"
SURE = 2.0
"""A figure is beyond doubt when it lies this many standard deviations off."""
TRUSTED = ("ok", "weak")
"""A station of another status has no figures that a verdict could rest on."""


@dataclass(frozen=True)
class StationDocument:
    """One station; NaN where a figure is not known.

    Attributes
    ----------
    s : float
        Distance along the joint, m.
    status, reason : str
    origin, u, v, n : ndarray, shape (3,)
        The section frame, world.
    width, root, narrowest, area, step : float
        Of the gap as built; m, m^2.
    designed_width, designed_step : float
        m.
    sigma_width, sigma_root, sigma_narrowest, sigma_step : float
        m.
    contact : str
        ``clearance``, ``touch`` or ``overlap``; empty where there is no gap.
    polygon : ndarray, shape (k, 3)
        Outline of the open gap, world; no rows where there is none.
    """

    s: float
    status: str
    reason: str
    origin: Array
    u: Array
    v: Array
    n: Array
    width: float
    root: float
    narrowest: float
    area: float
    step: float
    designed_width: float
    designed_step: float
    sigma_width: float
    sigma_root: float
    sigma_narrowest: float
    sigma_step: float
    contact: str
    polygon: Array

    @property
    def trusted(self) -> bool:
        """Whether there is a gap whose figures count."""
        return self.status in TRUSTED and bool(np.isfinite(self.width))


@dataclass(frozen=True)
class JointDocument:
    """One joint.

    Attributes
    ----------
    id, kind, state : str
    elements, names, classes, storeys : tuple of two str
    width, length, depth : float
        As designed, m.
    status, reason, motion : str
    stations : tuple of StationDocument
    volume, volume_sigma : float
        Of the lofted gap, m^3; NaN where not known.
    path : ndarray, shape (k, 3)
        Mid-gap, world; no rows where the file has none.
    outward : ndarray, shape (k - 1, 3)
        Out of the mouth, for each leg of the path.
    files : mapping
        Mesh format -> file name.
    """

    id: str
    kind: str
    state: str
    elements: tuple[str, str]
    names: tuple[str, str]
    classes: tuple[str, str]
    storeys: tuple[str, str]
    width: float
    length: float
    depth: float
    status: str
    reason: str
    motion: str
    stations: tuple[StationDocument, ...]
    volume: float
    volume_sigma: float
    path: Array
    outward: Array
    files: Mapping[str, str]

    @property
    def trusted(self) -> tuple[StationDocument, ...]:
        """The stations whose figures count."""
        return tuple(station for station in self.stations if station.trusted)

    @property
    def counts(self) -> dict[str, int]:
        """How many stations there are of each status that occurs."""
        names = [station.status for station in self.stations]
        order = ("ok", "weak", "ambiguous", "rejected", "no_data")
        return {name: names.count(name) for name in order if name in names}

    @property
    def contact(self) -> str:
        """The closest that the two components come as built, see :func:`closest`."""
        return closest(
            (one.contact, one.narrowest, one.sigma_narrowest if one.status == "ok" else math.inf)
            for one in self.trusted
        )

    @property
    def storey(self) -> str:
        """The storey of both elements, or both of them."""
        return " / ".join(dict.fromkeys(name for name in self.storeys if name))


@dataclass(frozen=True)
class ResultsDocument:
    """A whole results.json.

    Attributes
    ----------
    version : str
        Of the bimfit that wrote it.
    model, scan : str
    notes : tuple of str
    joints : tuple of JointDocument
    limits : mapping of str to (float, float)
        What joints might measure when they were fitted, m; infinite where an end is open.
    """

    version: str
    model: str
    scan: str
    notes: tuple[str, ...]
    joints: tuple[JointDocument, ...]
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def closest(gaps: Iterable[tuple[str, float, float]]) -> str:
    """The closest that two components come, of (contact, narrowest width, its deviation; m) a station.

    Returns
    -------
    str
        ``clash`` where they overlap beyond doubt, ``possible clash`` where the uncertainty excuses it,
        ``touch``, ``clear``, or nothing without a station.
    """
    found = {
        "possible clash"
        if contact == "overlap" and -narrowest <= SURE * sigma
        else {"overlap": "clash", "touch": "touch", "clearance": "clear"}.get(contact, "")
        for contact, narrowest, sigma in gaps
    }
    return next((name for name in ("clash", "possible clash", "touch", "clear") if name in found), "")


def read_results(folder: Path) -> ResultsDocument:
    """Read the results.json of a folder.

    Raises
    ------
    ConfigError
        When there is none, or it is not one that bimfit has written.
    """
    file = folder / NAME
    try:
        value = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(
            f"holds no {NAME} that can be read", file=folder, remedy="name a folder of bimfit fit"
        ) from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"is not JSON: {error}", file=file) from error
    try:
        if value["schema"] != 1:
            raise ConfigError(f"is of schema {value['schema']}, and schema 1 is read here", file=file)
        return ResultsDocument(
            version=str(value["bimfit"]),
            model=str(value["model"]),
            scan=str(value["scan"]),
            notes=tuple(str(note) for note in value.get("notes", ())),
            joints=tuple(_joint(joint) for joint in value["joints"]),
            limits={str(name): _range(pair) for name, pair in (value.get("limits") or {}).items()},
        )
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else f"cannot be used: {error}"
        raise ConfigError(f"is not a results file of bimfit: it {reason}", file=file) from error


def _joint(value: Mapping[str, Any]) -> JointDocument:
    volume, path, designed = value["volume"] or {}, value.get("path") or {}, value["designed"]
    return JointDocument(
        id=str(value["id"]),
        kind=str(value["kind"]),
        state=str(value.get("state", "")),
        elements=_pair(value["elements"]),
        names=_pair(value.get("names", ("", ""))),
        classes=_pair(value.get("classes", ("", ""))),
        storeys=_pair(value.get("storeys", ("", ""))),
        width=_number(designed["width"]),
        length=_number(value["length"]),
        depth=_number(designed.get("depth")),
        status=str(value.get("status", "")),
        reason=str(value.get("reason", "")),
        motion=str(value.get("motion", "")),
        stations=tuple(_station(station) for station in value["stations"]),
        volume=_number(volume.get("mesh")),
        volume_sigma=_number(volume.get("sigma")),
        path=_rows(path.get("points")),
        outward=_rows(path.get("v")),
        files={str(kind): str(name) for kind, name in (value.get("meshes") or {}).items()},
    )


def _station(value: Mapping[str, Any]) -> StationDocument:
    gap = value["gap"] or {}
    sigma, widths, designed = gap.get("sigma") or {}, gap.get("width") or {}, gap.get("designed") or {}
    frame = {axis: _rows([value["frame"][axis]])[0] for axis in ("origin", "u", "v", "n")}
    return StationDocument(
        s=_number(value["s"]),
        status=str(value["status"]),
        reason=str(value["reason"]),
        **frame,
        width=_number(widths.get("mouth")),
        root=_number(widths.get("root")),
        narrowest=_number(widths.get("narrowest")),
        area=_number(gap.get("area")),
        step=_number(gap.get("step")),
        designed_width=_number((designed.get("width") or {}).get("mouth")),
        designed_step=_number(designed.get("step")),
        sigma_width=_number(sigma.get("width")),
        sigma_root=_number(sigma.get("root")),
        sigma_narrowest=_number(sigma.get("narrowest")),
        sigma_step=_number(sigma.get("step")),
        contact=str(gap.get("contact", "")),
        polygon=_rows(gap.get("polygon")),
    )


def _range(value: Any) -> tuple[float, float]:
    low, high = value
    return -math.inf if low is None else float(low), math.inf if high is None else float(high)


def _pair(value: Any) -> tuple[str, str]:
    first, second = value
    return str(first), str(second)


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)


def _rows(value: Any) -> Array:
    return np.asarray(value if value is not None else [], float).reshape(-1, 3)
