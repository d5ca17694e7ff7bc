"""Watches over the child process that tessellates a model (:mod:`bimfit.bim.tessellate`)."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import bimfit
from bimfit.bim.source import Source
from bimfit.errors import ModelError
from bimfit.geometry.mesh import TriangleMesh

MOST_HANGS = 4
MOST_CRASHES = 40
_OPENING = 60.0
_OPENING_RATE = 1e-6  # s a byte, beyond the time limit
_ITEM_RATE = 0.02
_LEAST_MEMORY = 4 << 30

_SAID = {
    "Syntax error": "its data is not well-formed (STEP, ISO 10303-21); export it again",
    "Unable to parse IFC SPF header": "its header is damaged; export it again",
}
"""What the parser says, and what that means to its user."""

Message = tuple[dict[str, Any], bytes]


@dataclass
class RawModel:
    """What the child process delivered.

    Attributes
    ----------
    index : dict
        Elements' data, georeference and notes.
    meshes : dict
        Step id -> mesh in world metres.
    failed : dict
        Step id -> why there is no mesh.
    notes : list of str
    seconds : float
        From the first to the last mesh: the tessellation without starting, parsing and describing.
    """

    index: dict[str, Any] = field(default_factory=dict)
    meshes: dict[int, TriangleMesh] = field(default_factory=dict)
    failed: dict[int, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    seconds: float = 0.0


def tessellate(source: Source, include: Sequence[str] | None, time_limit: float) -> RawModel:
    """Tessellate a model's elements in child processes.

    All elements are asked for at once first. If that process dies or makes no progress for ``time_limit``
    seconds, the rest is asked for one by one, so that the guilty element is known, skipped and listed.

    Raises
    ------
    ModelError
        When the file cannot be parsed, or not within its time.
    """
    raw = RawModel()
    hangs = crashes = 0
    one_by_one = False
    with _readable(source) as path:
        while True:
            last, outcome = _run(path, source, include, raw, one_by_one, time_limit / 2 ** max(0, hangs - 1))
            if outcome == "end":
                break
            if last is not None:
                hung = outcome == "hung"
                raw.failed[last] = (
                    f"took more than {time_limit:g} s" if hung else "crashed the geometry kernel"
                )
            hangs, crashes = hangs + (outcome == "hung"), crashes + (outcome == "died")
            if hangs > MOST_HANGS or crashes > MOST_CRASHES:
                raw.notes.append(
                    "the geometry kernel failed too often; the rest of the elements was left out"
                )
                break
            if one_by_one and last is None:
                break
            one_by_one = True
    for row in raw.index.get("elements", ()):
        if row["id"] not in raw.meshes:
            raw.failed.setdefault(row["id"], "has no body that could be made into a mesh")
    return raw


def _run(
    path: Path,
    source: Source,
    include: Sequence[str] | None,
    raw: RawModel,
    one_by_one: bool,
    time_limit: float,
) -> tuple[int | None, str]:
    """One child process: the element it was at when it stopped, and how it stopped (end, died, hung)."""
    request = {
        "path": str(path),
        "include": None if include is None else list(include),
        "index": not raw.index,
        "done": [*raw.meshes, *raw.failed],
        "one_by_one": one_by_one,
        "threads": min(os.cpu_count() or 1, 8),
        "memory": _memory(),
    }
    begun = time.perf_counter()
    opening = max(_OPENING, time_limit) + len(source.data) * _OPENING_RATE
    current: int | None = None
    with _child(request) as messages:
        patience, began = opening, False
        while True:
            message = _next(messages, patience)
            if message is None or not message[0]:
                how = "hung" if message is None else "died"
                if not began:
                    what = "took too long" if how == "hung" else "crashed the parser"
                    raise ModelError(f"could not be opened: reading it {what}", file=source.path)
                return current, how
            head, payload = message
            kind = head["kind"]
            if kind == "error":
                raise ModelError(f"could not be read: {_plain(head['message'])}", file=source.path)
            if kind == "end":
                raw.seconds += time.perf_counter() - begun
                return None, "end"
            if kind == "index":
                raw.index = head
            elif kind == "begin":
                begun = time.perf_counter()
                began, patience = True, time_limit + _ITEM_RATE * head["count"] * (not one_by_one)
            elif kind == "start":
                current = head["id"]
            elif kind == "failed":
                raw.failed[head["id"]] = head["reason"]
                current = None
            elif kind == "mesh":
                raw.meshes.setdefault(head["id"], _mesh(head, payload))
                current, patience = None, time_limit


def _mesh(head: dict[str, Any], payload: bytes) -> TriangleMesh:
    split = 24 * head["vertices"]
    vertices = np.frombuffer(payload[:split], np.float64).reshape(-1, 3)
    faces = np.frombuffer(payload[split:], np.int32).reshape(-1, 3)
    return TriangleMesh.of(vertices.copy(), faces)


def _plain(message: str) -> str:
    kind, _, text = message.partition(": ")
    for said, plain in _SAID.items():
        if said in text:
            return plain
    return text or kind


@contextmanager
def _child(request: dict[str, Any]) -> Iterator[queue.Queue[Message]]:
    """Start the child and read its messages on a thread; an empty head says that it ended."""
    home = str(Path(bimfit.__file__).resolve().parents[1])
    paths = os.pathsep.join(p for p in (home, os.environ.get("PYTHONPATH", "")) if p)
    process = subprocess.Popen(
        [sys.executable, "-m", "bimfit.bim.tessellate"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": paths},
    )
    messages: queue.Queue[Message] = queue.Queue()
    reader = threading.Thread(target=_read, args=(process, messages), daemon=True)
    reader.start()
    try:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(json.dumps(request).encode())
            process.stdin.close()
        yield messages
    finally:
        process.kill()
        process.wait()
        reader.join()
        assert process.stdout is not None
        process.stdout.close()


def _read(process: subprocess.Popen[bytes], messages: queue.Queue[Message]) -> None:
    stream = process.stdout
    assert stream is not None
    try:
        for line in stream:
            head = json.loads(line)
            payload = stream.read(head["bytes"])
            if len(payload) < head["bytes"]:
                break
            messages.put((head, payload))
    except (ValueError, KeyError, TypeError, OSError):
        pass
    messages.put(({}, b""))


def _next(messages: queue.Queue[Message], patience: float) -> Message | None:
    try:
        return messages.get(timeout=patience)
    except queue.Empty:
        return None


@contextmanager
def _readable(source: Source) -> Iterator[Path]:
    """A path that the parser can open: the user's file, or a cleaned copy for the while."""
    if source.as_is and source.path.suffix.lower() == ".ifc":
        yield source.path.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="bimfit-") as folder:
        copy = Path(folder) / "model.ifc"
        copy.write_bytes(source.data)
        yield copy


def _memory() -> int:
    """Bytes of address space for the child: most of the machine's memory, so that it cannot take it all."""
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return 1 << 36
    return max(_LEAST_MEMORY, int(0.75 * total))
