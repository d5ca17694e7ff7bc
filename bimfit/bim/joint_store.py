"""Found joints kept between runs, by all that they follow from."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import bimfit
from bimfit.bim.cache import DAMAGE, cache_folder, keep_file
from bimfit.bim.drafts import Limits
from bimfit.bim.joint import Joint
from bimfit.bim.model import Element
from bimfit.geometry.path import JointPath

_ENDING = ".joints.npz"
_ROOMS = ("bim", "geometry")


def store_key(elements: Sequence[Element], eligible: NDArray[np.bool_], limits: Limits) -> str:
    """What names a search: the elements with their meshes, which take part, the limits, and the finder."""
    hashed = hashlib.sha256(_finder_version().encode())
    hashed.update(repr(limits).encode())
    hashed.update(np.packbits(eligible).tobytes())
    for element in elements:
        mesh = element.mesh
        hashed.update(f"{element.guid}|{element.parent_guid}|{len(mesh.vertices)}|{len(mesh.faces)}".encode())
        hashed.update(mesh.vertices.tobytes())
        hashed.update(mesh.faces.tobytes())
    return hashed.hexdigest()


def load_joints(key: str, elements: Sequence[Element]) -> tuple[Joint, ...] | None:
    """The joints that a search of that name found; None where it is unknown or its file is damaged."""
    path = _path(key)
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            about = json.loads(arrays["about"].tobytes())
            points, axes, splits = arrays["points"], arrays["axes"], arrays["splits"].tolist()
        if about["key"] != key or len(splits) != len(about["joints"]) + 1 or splits[-1] != len(points):
            return None
        return tuple(
            _joint(row, points[low:high], axes[low : high - 1], elements)
            for row, low, high in zip(about["joints"], splits[:-1], splits[1:], strict=True)
        )
    except DAMAGE:
        return None


def store_joints(key: str, joints: Sequence[Joint], elements: Sequence[Element]) -> bool:
    """Keep what a search found; False where the folder cannot be written, which is no error."""
    number = {element.guid: k for k, element in enumerate(elements)}
    rows = [_row(joint, number) for joint in joints]
    sizes = [len(joint.path.points) for joint in joints]
    axes = np.zeros((sum(sizes), 2, 3))
    splits = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    for joint, low, high in zip(joints, splits[:-1], splits[1:], strict=True):
        axes[low : high - 1, 0], axes[low : high - 1, 1] = joint.path.u, joint.path.v
    text = json.dumps({"key": key, "joints": rows}).encode()
    arrays = {
        "about": np.frombuffer(text, np.uint8),
        "points": np.concatenate([np.zeros((0, 3)), *(joint.path.points for joint in joints)]),
        "axes": axes,
        "splits": splits,
    }
    return keep_file(_path(key), lambda stream: np.savez(stream, **arrays))  # type: ignore[arg-type]


def _path(key: str) -> Path:
    return cache_folder() / f"{key[:40]}{_ENDING}"


@cache
def _finder_version() -> str:
    """Changes whenever the code below does, or a library that it computes with."""
    from importlib.metadata import PackageNotFoundError, version

    parts = [bimfit.__version__]
    home = Path(bimfit.__file__).parent
    for file in sorted(file for room in _ROOMS for file in (home / room).glob("*.py")):
        parts.append(hashlib.sha256(file.read_bytes()).hexdigest())
    for library in ("numpy", "scipy", "shapely"):
        with contextlib.suppress(PackageNotFoundError):
            parts.append(version(library))
    return " ".join(parts)


def _row(joint: Joint, number: dict[str, int]) -> list[Any]:
    first, second = (number[guid] for guid in joint.elements)
    filler = None if joint.filler is None else number[joint.filler]
    return [
        joint.id,
        first,
        second,
        joint.kind,
        joint.width,
        joint.length,
        joint.depth,
        joint.two_sided,
        joint.state,
        filler,
        joint.widths,
        joint.accessible,
        joint.legs,
        joint.path.closed,
    ]


def _joint(row: list[Any], points: Any, axes: Any, elements: Sequence[Element]) -> Joint:
    name, a, b, kind, width, length, depth, two, state, filler, widths, accessible, legs, closed = row
    return Joint(
        id=name,
        elements=(elements[a].guid, elements[b].guid),
        kind=kind,
        width=width,
        length=length,
        depth=depth,
        path=JointPath.restored(points, axes[:, 0], axes[:, 1], closed=closed),
        two_sided=two,
        state=state,
        filler=None if filler is None else elements[filler].guid,
        widths=(widths[0], widths[1]),
        accessible=accessible,
        legs=tuple(legs),
    )
