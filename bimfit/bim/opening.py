"""Open an IFC file in this process, for what needs more of it than its elements' meshes."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

from bimfit.bim.source import read_source
from bimfit.errors import ModelError

_PROJECT = re.compile(rb"=\s*IFCPROJECT\s*\(\s*'([0-9A-Za-z_$]{22})'", re.IGNORECASE)


def project_guid(path: str | Path) -> str:
    """GlobalId of a file's IfcProject; empty where the file or the project is not there."""
    try:
        found = _PROJECT.search(read_source(path).data)
    except ModelError:
        return ""
    return found.group(1).decode("ascii") if found else ""


def open_ifc(path: str | Path) -> Any:
    """The file as ifcopenshell has it, whatever the form it is kept in.

    Raises
    ------
    ModelError
        When it cannot be read or parsed.
    """
    import ifcopenshell

    file = Path(path)
    source = read_source(file)
    with tempfile.TemporaryDirectory(prefix="bimfit-") as folder:
        place = file
        if not source.as_is:
            place = Path(folder) / "model.ifc"
            place.write_bytes(source.data)
        try:
            return ifcopenshell.open(str(place))
        except Exception as error:  # ifcopenshell's errors share no base
            raise ModelError(f"cannot be parsed: {error}", file=file) from error
