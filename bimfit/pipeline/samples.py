"""The sample models that come with bimfit."""

from __future__ import annotations

from pathlib import Path

from bimfit.errors import ModelError

_PACKAGE = Path(__file__).resolve().parent.parent


def sample_model(name: str) -> Path:
    """Path of a sample model, in an installed package or in a source tree.

    Raises
    ------
    ModelError
        When there is none of that name.
    """
    for folder in (_PACKAGE / "_samples", _PACKAGE.parent / "ifc_samples"):
        if (folder / name).is_file():
            return folder / name
    raise ModelError("the sample model is not installed", file=name, remedy="reinstall bimfit")
