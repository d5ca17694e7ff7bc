"""Scenes in which a joint is, or is not, and what is asked of each (METHOD, section 5)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bimfit.geometry.joint_section import JointSection
from bimfit.simulation.impostors import (
    Maker,
    Random,
    arched,
    backed,
    beside,
    bevel,
    box,
    chamfered,
    clutter,
    missing,
    nothing,
    pipe,
    plain_wall,
    thick,
    too_wide,
)

_FOUND, _KEPT, _FLAGGED = "found 99 %", "kept 99 %", "wrong ones flagged 95 %"
_BENT = "joints found 99 %"
_HIGH = {"sensor_height": 0.500}
"""From here a scan shows the gaps beside the joint's, 225 mm away."""


@dataclass(frozen=True)
class Scene:
    """What is there in place of the joint, and how it is seen.

    Attributes
    ----------
    make : callable
        Draws a maker of components for a joint; None for the joint itself.
    asked : str
        What the project asks for, "" where it asks for nothing.
    width : float or None
        The joint's own boards have this width, m, as designed and as built; None: as they are.
    changes : dict
        Of the scenario.
    shift : float
        How far off across the joint the scan as a whole is placed, m.
    """

    make: Callable[[Random], Maker] | None
    asked: str = ""
    width: float | None = None
    changes: dict[str, Any] = field(default_factory=dict)
    shift: float = 0.0


TRUE = "the joint itself"
SCENES: dict[str, Scene] = {
    TRUE: Scene(None, _KEPT),
    "missing component": Scene(missing, _FOUND),
    "plain wall": Scene(plain_wall, _FOUND),
    "pipe": Scene(pipe, _FOUND),
    "clutter": Scene(clutter, _FOUND),
    "bevel for square": Scene(bevel, _FOUND),
    "gap 40 mm too wide": Scene(too_wide, _FOUND),
    "empty slice": Scene(nothing, _FOUND),
    "chamfer 6 mm": Scene(chamfered(0.006)),
    "chamfer 10 mm": Scene(chamfered(0.010)),
    "bow 1 mm": Scene(arched(0.001)),
    "bow 2 mm": Scene(arched(0.002), _BENT),
    "bow 2 mm, no drift": Scene(arched(0.002), _BENT, changes={"motion": "const"}),
    "bow 5 mm": Scene(arched(0.005), _BENT),
    "three boards": Scene(beside(3, 0.070), _FLAGGED, 0.070),
    "four boards": Scene(beside(4, 0.060), _FLAGGED, 0.060),
    "four, 60 mm off": Scene(beside(4, 0.060), _FLAGGED, 0.060, {"common_shift": (0.060, 0.020)}),
    "four wide boards": Scene(beside(4, 0.200), _KEPT, None, _HIGH),
    "four wide, 100 mm off": Scene(beside(4, 0.200), _FLAGGED, None, _HIGH, 0.100),
    "wall 5 mm behind": Scene(backed(0.005), _KEPT),
    "wall 20 mm behind": Scene(backed(0.020), _KEPT),
    "15 mm thicker": Scene(thick(0.040), _KEPT),
}
"""What the bench of refusals shows. A thickness cannot be seen from above: it is kept."""


def impostor(kind: str, sections: Sequence[JointSection], seed: int) -> tuple[JointSection, ...]:
    """The sections with other components in them: what is really there when the design is not.

    Parameters
    ----------
    kind : str
        A name of :data:`SCENES`.
    sections : sequence of JointSection
        The design of a butt joint between two boards.
    seed : int
        What is drawn (sizes, places) is drawn once for the joint, clutter anew at each station.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
    draw = SCENES[kind].make
    if draw is None:
        return tuple(sections)
    make = draw(rng)
    return tuple(dataclasses.replace(section, components=make(section)) for section in sections)


def narrowed(sections: Sequence[JointSection], width: float) -> tuple[JointSection, ...]:
    """A butt joint's design with boards of another width, m."""
    out = []
    for section in sections:
        parts = []
        for component, mouth, sign in zip(section.components, section.gap.mouth, (-1.0, 1.0), strict=True):
            (_, v0), (_, v1) = component.bounds
            inner = float(mouth[0])
            parts.append(box(min(inner, inner + sign * width), max(inner, inner + sign * width), v0, v1))
        out.append(dataclasses.replace(section, components=(parts[0], parts[1])))
    return tuple(out)
