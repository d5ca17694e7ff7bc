"""bench(): hostile and damaged model files, each of which must end in a model or in one clear line."""

from __future__ import annotations

import io
import re
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from bimfit.bim.joints import find_joints
from bimfit.bim.model import load_model
from bimfit.errors import BimfitError
from bimfit.pipeline.samples import sample_model

BASES = (
    "lap",
    "mitre",
    "curved",
    "facade",
    "square-butt-ifc2x3",
    "square-butt-ifc4x3",
    "t-joint",
    "v-groove",
)
ELEMENT_LIMIT = 5.0
"""Seconds that an element's geometry may take."""
FILE_LIMIT = 60.0
"""Seconds that a file may take from first to last."""

_NUMBER = re.compile(rb"(?<=[(,])-?\d+\.(?:\d*)(?:E[+-]?\d+)?(?=[,)])")
_REFERENCE = re.compile(rb"#\d+")
_ENTITY = re.compile(rb"^#(\d+)=\s*(\w+)\((.*)\);", re.MULTILINE)
_HUGE = (b"1E+400", b"-1E300", b"1E30", b"-1E18", b"1.E9", b"99999999999999999999.", b"1E-320", b"0.")
_NOT_NUMBERS = (
    b"NAN",
    b"nan",
    b"1.#QNAN",
    b"INF",
    b"-1.#INF",
    b"$",
    b"*",
    b"()",
    b"'text'",
    b"#99999999",
    b".T.",
)
Mutation = Callable[[bytes, Random], bytes]


@dataclass(frozen=True)
class Case:
    """One file's end.

    Attributes
    ----------
    number : int
        The seed that makes the same file again.
    mutation : str
    outcome : str
        ``model``, ``refused`` or what went wrong.
    line : str
        What was said.
    seconds : float
    """

    number: int
    mutation: str
    outcome: str
    line: str
    seconds: float

    @property
    def good(self) -> bool:
        """Whether it ended as it must, in time."""
        return self.outcome in ("model", "refused") and self.seconds <= FILE_LIMIT


def bench_fuzz(files: int, seed: int, progress: Callable[[str, float], None]) -> tuple[str, dict[str, Any]]:
    """Mutate the samples so many times; every file is loaded and searched for joints: (text, data)."""
    cases = []
    with tempfile.TemporaryDirectory(prefix="bimfit-fuzz-") as folder:
        for k in range(files):
            progress("fuzz", k / files)
            cases.append(try_case(seed + k, Path(folder)))
    return _text(cases), {"cases": [asdict(case) for case in cases]}


def try_case(number: int, folder: Path) -> Case:
    """Make the file of that number, load it and find its joints."""
    name, content = mutated(number)
    path = folder / f"{number}.ifc"
    path.write_bytes(content)
    begun = time.perf_counter()
    try:
        model = load_model(path, time_limit=ELEMENT_LIMIT, cache=False)
        found = find_joints(model)
        finite = all(bool(np.isfinite(element.mesh.vertices).all()) for element in model.elements) and all(
            bool(np.isfinite([joint.width, joint.length, joint.depth]).all()) for joint in found
        )
        outcome = "model" if finite else "numbers that are not finite"
        line = f"{len(model.elements)} elements, {len(model.skipped)} left out, {len(found)} joints"
    except BimfitError as error:
        line = str(error).removeprefix(f"{path}: ")
        outcome = "refused" if "\n" not in line and len(line) < 500 else "more than a line"
    except Exception as error:
        outcome, line = f"exception {type(error).__name__}", " ".join(str(error).split())[:200]
    finally:
        path.unlink(missing_ok=True)
    return Case(number, name, outcome, line, time.perf_counter() - begun)


def mutated(number: int, bases: Sequence[Path] = ()) -> tuple[str, bytes]:
    """The file of that number: (name of its mutation, content); the same at every call."""
    rng = Random(number)
    sources = list(bases) or [sample_model(f"{name}.ifc") for name in BASES]
    data = rng.choice(sources).read_bytes()
    names = list(MUTATIONS)
    name = names[number % len(names)]
    return name, MUTATIONS[name](data, rng)


# -- what is done to a file ------------------------------------------------------------------------


def _truncated(data: bytes, rng: Random) -> bytes:
    return data[: rng.randrange(len(data))]


def _flipped(data: bytes, rng: Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice([1, 5, 20, 200])):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _noise(data: bytes, rng: Random) -> bytes:
    at, size = rng.randrange(len(data)), rng.choice([4, 64, 1024])
    return data[:at] + rng.randbytes(size) + data[at + size * rng.randrange(2) :]


def _replaced(pattern: re.Pattern[bytes], words: Sequence[bytes]) -> Mutation:
    def mutate(data: bytes, rng: Random) -> bytes:
        places = list(pattern.finditer(data))
        chosen = sorted(
            rng.sample(places, min(len(places), rng.choice([1, 1, 3, 20]))), key=lambda m: m.start()
        )
        parts, last = [], 0
        for match in chosen:
            parts += [data[last : match.start()], rng.choice(words)]
            last = match.end()
        return b"".join([*parts, data[last:]])

    return mutate


def _crossed(data: bytes, rng: Random) -> bytes:
    """References that point somewhere else."""
    body = data.index(b"DATA;")
    numbers = [match.group(1) for match in _ENTITY.finditer(data)]
    words = [b"#" + rng.choice(numbers) for _ in range(20)]
    return data[:body] + _replaced(_REFERENCE, words)(data[body:], rng)


def _cyclic(data: bytes, rng: Random) -> bytes:
    """Placements, wholes and operands that lead back to themselves."""
    kind = rng.choice(
        [b"IFCLOCALPLACEMENT", b"IFCAXIS2PLACEMENT3D", b"IFCSHAPEREPRESENTATION", b"IFCRELAGGREGATES"]
    )
    rows = [match for match in _ENTITY.finditer(data) if match.group(2) == kind]
    if not rows:
        return data
    if kind == b"IFCLOCALPLACEMENT":
        last, others = rows[0], [row.group(1) for row in rows]
        target = rng.choice([last.group(1), *others])
        first = last.group(3).split(b",", 1)[1]
        new = b"#%s=%s(#%s,%s);" % (last.group(1), kind, target, first)
    elif kind == b"IFCRELAGGREGATES":
        last = rng.choice(rows)
        wholes = last.group(3).split(b",")
        part = _REFERENCE.findall(last.group(3))[-1]
        parts = b",".join([*wholes[:4], part, b"(" + part + b")"])
        new = b"#%s=%s(%s);" % (last.group(1), kind, parts)
    else:
        last = rng.choice(rows)
        own = b"#" + last.group(1)
        references = _REFERENCE.findall(last.group(3))
        new = last.group(0).replace(rng.choice(references) if references else b"$", own)
        new = new.replace(own + b"=", own + b"=", 1)
    return data[: last.start()] + new + data[last.end() :]


def _shuffled(data: bytes, rng: Random) -> bytes:
    """Lines lost, doubled and moved."""
    lines = data.split(b"\n")
    for _ in range(rng.choice([1, 3, 10])):
        k = rng.randrange(len(lines))
        if rng.random() < 0.5:
            lines.insert(rng.randrange(len(lines)), lines[k])
        else:
            del lines[k]
    return b"\n".join(lines)


def _nested(data: bytes, rng: Random) -> bytes:
    """Brackets, strings and numbers far beyond what anyone writes."""
    depth = rng.choice([100, 10_000, 1_000_000])
    blob = rng.choice(
        [b"(" * depth, b"(" * depth + b")" * depth, b"'" + b"x" * depth, b"9" * depth, b"#" * depth]
    )
    places = list(_NUMBER.finditer(data))
    match = rng.choice(places)
    return data[: match.start()] + blob + data[match.end() :]


def _retyped(data: bytes, rng: Random) -> bytes:
    """Entities that claim to be of another type."""
    rows = list(_ENTITY.finditer(data))
    row, other = rng.choice(rows), rng.choice(rows)
    kind = rng.choice([other.group(2), b"IFCNOTHING", b"IFCBOOLEANRESULT", b"IFCMAPPEDITEM", b""])
    return data[: row.start(2)] + kind + data[row.end(2) :]


def _header(data: bytes, rng: Random) -> bytes:
    schema = rng.choice(
        [b"IFC4X3", b"IFC4X3_TC1", b"IFC4X1", b"IFC2X3_FINAL", b"IFC5", b"IFC2X3", b"", b"x" * 5000]
    )
    return re.sub(rb"FILE_SCHEMA\(\('[^']*'\)\)", b"FILE_SCHEMA(('" + schema + b"'))", data)


def _zipped(data: bytes, rng: Random) -> bytes:
    """Archives: bombs, damaged ones, and ones that hold something else."""
    holds = rng.choice(["bomb", "damaged", "many", "xml", "plain", "nested", "outside"])
    content = {
        "bomb": data + b" " * 50_000_000,
        "xml": _XML,
        "nested": _archive({"inner.ifc": data}),
    }.get(holds, data)
    names = {"many": [f"{k}.ifc" for k in range(2000)], "outside": ["../../outside.ifc"]}.get(
        holds, ["model.ifc"]
    )
    out = bytearray(_archive(dict.fromkeys(names, content)))
    if holds == "damaged":
        for _ in range(5):
            out[rng.randrange(4, len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _archive(entries: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            # a fixed date: the clock would make another file of the same number
            entry = zipfile.ZipInfo(name)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, content)
    return stream.getvalue()


_XML = (
    b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">'
    + b"".join(b'<!ENTITY %c "%s">' % (98 + k, b"&%c;" % (97 + k) * 10) for k in range(9))
    + b'<!ENTITY f SYSTEM "file:///etc/passwd">]><ifcXML>&j;&f;</ifcXML>'
)


def _xml(data: bytes, rng: Random) -> bytes:
    """IfcXML with entities that grow, or that name other files."""
    return rng.choice(
        [_XML, b"\xef\xbb\xbf" + _XML, b" \n" + _XML, _XML.decode().encode("utf-16"), _XML[:300]]
    )


MUTATIONS: dict[str, Mutation] = {
    "truncated": _truncated,
    "bits flipped": _flipped,
    "noise": _noise,
    "huge numbers": _replaced(_NUMBER, _HUGE),
    "not a number": _replaced(_NUMBER, _NOT_NUMBERS),
    "references crossed": _crossed,
    "cyclic": _cyclic,
    "lines shuffled": _shuffled,
    "nested": _nested,
    "retyped": _retyped,
    "header": _header,
    "zip": _zipped,
    "xml": _xml,
}


def _text(cases: Sequence[Case]) -> str:
    lines = [f"{'mutation':20} {'files':>6} {'models':>7} {'refused':>8} {'bad':>4} {'slowest s':>10}"]
    for name in MUTATIONS:
        some = [case for case in cases if case.mutation == name]
        if some:
            count = Counter(case.outcome for case in some)
            bad = sum(not case.good for case in some)
            slowest = max(case.seconds for case in some)
            lines.append(
                f"{name:20} {len(some):6} {count['model']:7} {count['refused']:8} {bad:4} {slowest:10.1f}"
            )
    failed = [case for case in cases if not case.good]
    lines.append(
        f"{len(cases)} files, {len(failed)} of which did not end as they must (within {FILE_LIMIT:g} s)"
    )
    lines += [f"  {case.number}: {case.mutation}: {case.outcome}: {case.line}" for case in failed]
    return "\n".join(lines)
