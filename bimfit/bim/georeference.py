"""Where a model lies on the map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bimfit.geometry.pose import Array


@dataclass(frozen=True)
class GeoReference:
    """A map conversion in metres: project coordinates to map coordinates and back.

    Attributes
    ----------
    crs : str
        Name of the projected coordinate system, as the file gives it; may be empty.
    eastings, northings, height : float
        Map coordinates of the project's origin, m.
    rotation : float
        Angle from map east to the project's x axis, rad, counter-clockwise.
    scale : float
        Map metres a project metre.
    source : str
        Where the file keeps it.
    """

    crs: str
    eastings: float
    northings: float
    height: float
    rotation: float
    scale: float = 1.0
    source: str = "IfcMapConversion"

    @property
    def T_map_project(self) -> Array:
        """Maps project coordinates to map coordinates, both in metres, shape (4, 4)."""
        c, s = self.scale * math.cos(self.rotation), self.scale * math.sin(self.rotation)
        out = np.eye(4)
        out[:2, :2] = [[c, -s], [s, c]]
        out[2, 2] = self.scale
        out[:3, 3] = self.eastings, self.northings, self.height
        return out

    def to_map(self, points: ArrayLike) -> Array:
        """Project points (..., 3) in map coordinates, m."""
        T = self.T_map_project
        return np.asarray(np.asarray(points, float) @ T[:3, :3].T + T[:3, 3])

    def to_project(self, points: ArrayLike) -> Array:
        """Map points (..., 3) in project coordinates, m."""
        T = self.T_map_project
        shifted = np.asarray(points, float) - T[:3, 3]
        return np.asarray(shifted @ T[:3, :3] / self.scale**2)


def map_scale(stated: float, map_unit: float, project_unit: float) -> tuple[float, str]:
    """Map metres a project metre, from a stated ``Scale`` that files use in several senses.

    The standard: map units a project unit. Many files state the ratio of metres instead, or its inverse.

    Parameters
    ----------
    stated : float
        ``Scale`` as the file has it.
    map_unit, project_unit : float
        Metres a map unit and a project unit.

    Returns
    -------
    scale : float
    note : str
        What was made of it, where it is not what the standard says.
    """
    ratio = map_unit / project_unit
    readings = ((stated * ratio, ""), (stated, "as a ratio of metres"))
    inverse = ((ratio / stated, "upside down"), (1.0 / stated, "upside down")) if stated else ()
    for value, note in (*readings, *inverse):
        if 0.98 < value < 1.02:
            return value, f"the map conversion's Scale {stated:g} was read {note}" if note else ""
    return 1.0, f"the map conversion's Scale {stated:g} makes no sense and was taken as 1"
