"""What can go wrong with a user's input, in one small hierarchy.

A fit that failed is not an error: it is a :class:`~bimfit.geometry.status.Status` with a reason.
"""

from __future__ import annotations


class BimfitError(Exception):
    """Root of every error that bimfit raises on purpose.

    Parameters
    ----------
    message : str
        What is wrong, in one line.
    file : str, optional
        The file it was found in.
    place : str, optional
        Where in the file: a line, a column, a GlobalId.
    remedy : str, optional
        What the user can do about it.
    """

    def __init__(self, message: str, *, file: object = None, place: str = "", remedy: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.file = "" if file is None else str(file)
        self.place = place
        self.remedy = remedy

    def __str__(self) -> str:
        where = ", ".join(part for part in (self.file, self.place) if part)
        line = f"{where}: {self.message}" if where else self.message
        line = f"{line}; {self.remedy}" if self.remedy else line
        return " ".join(line.split())


class ConfigError(BimfitError):
    """A setting or an option that cannot be used."""


class ModelError(BimfitError):
    """A building model that cannot be read, or that lacks what was asked for."""


class JointError(ModelError):
    """A joint that does not exist, or two elements between which there is none."""


class ScanError(BimfitError):
    """A scan that cannot be read, or that does not show what was asked for."""


class SensorError(BimfitError):
    """A rangefinder that cannot be reached or does not answer as it should."""


class ExportError(BimfitError):
    """A result that cannot be written."""
