"""An IFC file's bytes, made fit for the parser."""

from __future__ import annotations

import hashlib
import io
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path

from bimfit.errors import ModelError

_BOM = b"\xef\xbb\xbf"
_HEAD = 1 << 16
_LARGEST = 2 << 30
_LARGEST_RATIO = 200
_SCHEMA = re.compile(rb"FILE_SCHEMA\s*\(\s*\(\s*'([^']*)'", re.IGNORECASE)
_END = b"END-ISO-10303-21"
_TAIL = 4096
# subtypes of IFC4 without attributes of their own, which IFC4X3 has no more
_CASES = re.compile(
    rb"(=\s*IFC(?:BEAM|COLUMN|DOOR|MEMBER|OPENING|PLATE|SLAB|WALL|WINDOW))(?:STANDARD|ELEMENTED)CASE(?=\s*\()"
)
_LONGEST_NAME = 40
_READABLE = ("IFC2X3", "IFC4", "IFC4X3_ADD2")


@dataclass(frozen=True)
class Source:
    """What is to be parsed.

    Attributes
    ----------
    path : Path
        The user's file.
    data : bytes
        An IFC in STEP form, as the parser takes it.
    as_is : bool
        Whether ``data`` is the file's content unchanged.
    digest : str
        SHA-256 of ``data``.
    schema : str
        As the file names it.
    notes : tuple of str
        What was changed to read it.
    """

    path: Path
    data: bytes
    as_is: bool
    digest: str
    schema: str
    notes: tuple[str, ...]


def read_source(path: str | Path) -> Source:
    """Read an ``.ifc`` or ``.ifczip`` file.

    Raises
    ------
    ModelError
        When it is missing, empty, not an IFC in STEP form, or of an unknown schema.
    """
    file = Path(path)
    try:
        raw = file.read_bytes()
    except IsADirectoryError as error:
        raise ModelError("is a folder, not an IFC file", file=file, remedy="name the .ifc in it") from error
    except OSError as error:
        raise ModelError(f"cannot be read: {error.strerror}", file=file) from error
    if not raw.strip():
        raise ModelError("is empty", file=file)
    notes: list[str] = []
    data = raw
    if data[:4] == b"PK\x03\x04":
        data = _unzip(data, file)
        notes.append("unpacked from a zip archive")
    if data.startswith(_BOM):
        data = data[len(_BOM) :]
        notes.append("a byte-order mark was removed")
    _check_kind(data, file)
    named = _SCHEMA.search(data[:_HEAD])
    if not named:
        raise ModelError(
            "names no schema in its header (FILE_SCHEMA)", file=file, remedy="export it again as IFC"
        )
    schema = named.group(1).decode("ascii", "replace").strip().upper()
    nearest = nearest_schema(schema)
    if nearest is None:
        raise ModelError(
            f"is of schema {_printable(schema) or 'unknown'}, which is not IFC2X3, IFC4 or IFC4X3",
            file=file,
            remedy="export it again as IFC4",
        )
    if named.group(1) != nearest.encode():
        data = data[: named.start(1)] + nearest.encode() + data[named.end(1) :]
        if schema != nearest:
            notes.append(f"schema {schema} was read as {nearest}")
        if schema.startswith(("IFC4X1", "IFC4X2")):
            data = _CASES.sub(rb"\1", data)
    if _END not in data[-_TAIL:].upper():
        notes.append(f"the file does not end as it should ({_END.decode()}): it may be cut off")
    digest = hashlib.sha256(data).hexdigest()
    return Source(file, data, data is raw, digest, schema, tuple(notes))


def nearest_schema(name: str) -> str | None:
    """The schema to read a file of schema ``name`` with; None where there is none."""
    if name in _READABLE:
        return name
    if name.startswith("IFC2X"):
        return "IFC2X3"
    if name.startswith(("IFC4X1", "IFC4X2", "IFC4X3")):
        return "IFC4X3_ADD2"
    return "IFC4" if re.fullmatch(r"IFC4(_.*)?", name) else None


def _printable(name: str) -> str:
    short = "".join(c for c in name if c.isprintable())
    return short if len(short) <= _LONGEST_NAME else f"{short[:_LONGEST_NAME]}..."


def _check_kind(data: bytes, file: Path) -> None:
    head = data[:_HEAD].lstrip()
    if head.startswith(b"ISO-10303-21") or (b"ISO-10303-21" in head[:4096] and b"HEADER" in head):
        return
    if head[:1] == b"<":
        raise ModelError("is XML; ifcXML is not read", file=file, remedy="export it as .ifc (STEP)")
    if head[:1] == b"{":
        raise ModelError("is JSON; ifcJSON is not read", file=file, remedy="export it as .ifc (STEP)")
    raise ModelError(
        "is not an IFC file (no ISO-10303-21 header)",
        file=file,
        remedy="name a model as .ifc or .ifczip, and before the scan",
    )


def _unzip(data: bytes, file: Path) -> bytes:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = [
                e for e in archive.infolist() if e.filename.lower().endswith(".ifc") and not e.is_dir()
            ]
            if len(entries) != 1:
                raise ModelError(
                    f"is an archive with {len(entries)} .ifc files in it, not one",
                    file=file,
                    remedy="unpack it and name one of them",
                )
            entry = entries[0]
            limit = min(_LARGEST, max(1 << 20, _LARGEST_RATIO * max(entry.compress_size, 1)))
            with archive.open(entry) as stream:
                content = stream.read(limit + 1)
    except ModelError:
        raise
    except Exception as error:  # zlib, lzma and zipfile raise errors of many kinds
        raise ModelError(f"is a damaged archive: {_printable(str(error))}", file=file) from error
    if len(content) > limit:
        raise ModelError(
            "unpacks to far more than an IFC file would", file=file, remedy="unpack it and name the .ifc"
        )
    return content
