"""Tessellated models kept between runs, by the content of their file."""

from __future__ import annotations

import contextlib
import json
import os
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from bimfit.errors import ExportError
from bimfit.files import whole_file
from bimfit.geometry.mesh import TriangleMesh

OFF = "BIMFIT_NO_CACHE"
"""Set to anything but nothing or 0, this environment variable keeps the cache out of use."""
DAMAGE = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    IndexError,
    EOFError,
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
)
"""What reading a damaged file of the cache may raise."""

_VERSION = 2
_MOST_BYTES = 2 << 30


def cache_folder() -> Path:
    """The user's cache folder for models; ``BIMFIT_CACHE`` names another."""
    import platformdirs

    named = os.environ.get("BIMFIT_CACHE")
    return Path(named) if named else Path(platformdirs.user_cache_dir("bimfit")) / "models"


def cache_wanted() -> bool:
    """Whether models and joints may be kept between runs at all."""
    return os.environ.get(OFF, "") in ("", "0")


def cache_path(digest: str) -> Path:
    """Where a model with that SHA-256 is kept."""
    from importlib.metadata import version

    return cache_folder() / f"{digest[:40]}-{version('ifcopenshell')}-{_VERSION}.npz"


def load_cached(digest: str) -> tuple[dict[str, Any], dict[int, TriangleMesh]] | None:
    """Description and meshes (by step id) of a model kept before; None without one or if it is damaged."""
    path = cache_path(digest)
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            about = json.loads(arrays["about"].tobytes())
            vertices, faces = arrays["vertices"], arrays["faces"]
            ids, splits = arrays["ids"].tolist(), arrays["splits"]
        if about["digest"] != digest or splits[-1].tolist() != [len(vertices), len(faces)]:
            return None
        meshes = {}
        for number, (v0, f0), (v1, f1) in zip(ids, splits[:-1].tolist(), splits[1:].tolist(), strict=True):
            meshes[int(number)] = TriangleMesh.of(vertices[v0:v1], faces[f0:f1])
        with contextlib.suppress(OSError):
            os.utime(path)
        return about, meshes
    except DAMAGE:
        return None


def store_cached(digest: str, about: dict[str, Any], meshes: dict[int, TriangleMesh]) -> bool:
    """Keep a model; False where the folder cannot be written, which is no error."""
    sizes = [(len(mesh.vertices), len(mesh.faces)) for mesh in meshes.values()]
    splits = np.concatenate([np.zeros((1, 2), np.int64), np.cumsum(np.reshape(sizes, (-1, 2)), axis=0)])
    text = json.dumps({**about, "digest": digest}).encode()
    blank_v, blank_f = np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    arrays = {
        "about": np.frombuffer(text, np.uint8),
        "ids": np.array(list(meshes), np.int64),
        "splits": splits.astype(np.int64),
        "vertices": np.concatenate([blank_v, *(m.vertices for m in meshes.values())]),
        "faces": np.concatenate([blank_f, *(m.faces.astype(np.int32) for m in meshes.values())]),
    }
    return keep_file(cache_path(digest), lambda stream: np.savez(stream, **arrays))  # type: ignore[arg-type]


def keep_file(path: Path, write: Callable[[BinaryIO], None]) -> bool:
    """Write a file of the cache, whole; False where that is impossible, which is no error."""
    try:
        with whole_file(path) as part, part.open("wb") as stream:
            write(stream)
        _prune(path.parent)
    except (ExportError, OSError):
        return False
    return True


def _prune(folder: Path) -> None:
    """Drop what was used longest ago, down to the folder's limit."""
    files = sorted(((p.stat().st_mtime, p.stat().st_size, p) for p in folder.glob("*.npz")), reverse=True)
    used = 0
    for _, size, path in files:
        used += size
        if used > _MOST_BYTES:
            path.unlink(missing_ok=True)
