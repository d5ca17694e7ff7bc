"""A joint as designed: two elements that face each other across a gap."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from bimfit.geometry.path import JointPath

Kind = Literal[
    "square-butt",
    "v-groove",
    "bevel",
    "tapered",
    "scarf",
    "mitre",
    "lap",
    "t-joint",
    "corner",
    "rebate",
    "sheet",
    "patch",
]
State = Literal["open", "touch", "clash", "filled"]

KINDS: tuple[Kind, ...] = (
    "square-butt",  # two edges, square to their faces
    "v-groove",  # both edges prepared: the gap opens towards its mouth
    "bevel",  # one edge prepared, or small chamfers on both
    "tapered",  # plane edges, 1.5 degrees or more from parallel
    "scarf",  # slanting edges of elements that continue one another
    "mitre",  # slanting edges of elements that meet at a corner
    "lap",  # faces that lie over one another
    "t-joint",  # an edge against the middle of a face
    "corner",  # an edge against the rim of a face
    "rebate",  # edges with a step in them: rebated, halved, tongue and groove, keyed
    "sheet",  # large faces parallel to one another, as layers of a wall are
    "patch",  # a contact about as short as it is deep
)


@dataclass(frozen=True)
class Joint:
    """Two elements that face each other across a gap.

    Attributes
    ----------
    id : str
        Short, unique within the model, the same for the same model.
    elements : tuple of two str
        GlobalIds of A and B, sorted.
    kind : str
        One of ``KINDS``.
    width : float
        Mean designed gap between the facing faces, m; negative where they overlap. Of a groove with a root
        land it is the gap between the lands, of a stepped section that of its narrowest faces.
    length, depth : float
        Along the joint and out of its mouth, m. The length is that of the faces that meet, which at corners
        is less than the path's. The depth of a groove includes its prepared edges.
    path : JointPath
        The spine, midway in the gap and in its depth; u from A to B, v out of the default mouth.
    two_sided : bool
        Whether the gap is free on both sides.
    state : {"open", "touch", "clash", "filled"}
        A clearance, faces within 1 mm, an overlap, or a gap with another element in it.
    filler : str or None
        GlobalId of the element in the gap.
    widths : tuple of two float
        Least and greatest designed gap between the facing faces, m.
    accessible : bool
        Whether either side is free; otherwise it is a cavity.
    legs : tuple of float
        Lengths of the faces that meet, leg by leg, m.
    """

    id: str
    elements: tuple[str, str]
    kind: Kind
    width: float
    length: float
    depth: float
    path: JointPath
    two_sided: bool
    state: State
    filler: str | None = None
    widths: tuple[float, float] = (0.0, 0.0)
    accessible: bool = True
    legs: tuple[float, ...] = ()

    def facing(self, viewpoint: ArrayLike) -> Joint:
        """The joint with its mouth towards a viewpoint (3,) in world coordinates."""
        path = self.path
        middle = 0.5 * (path.points[1:] + path.points[:-1])
        sight = np.asarray(viewpoint, float) - middle
        cosine = np.einsum("ij,ij->i", path.v, sight) / np.maximum(np.linalg.norm(sight, axis=1), 1e-9)
        return self if float(cosine @ path.leg_lengths) >= 0.0 else self.turned()

    def turned(self) -> Joint:
        """The joint with its mouth on the other side."""
        return replace(self, path=self.path.flipped(), legs=self.legs[::-1])

    def to_dict(self) -> dict[str, Any]:
        """Plain values, with the keys that the contract names."""
        return {
            "id": self.id,
            "elements": list(self.elements),
            "kind": self.kind,
            "state": self.state,
            "designed": {
                "width": self.width,
                "length": self.length,
                "depth": self.depth,
                "width_min": self.widths[0],
                "width_max": self.widths[1],
            },
            "two_sided": self.two_sided,
            "accessible": self.accessible,
            "filler": self.filler,
            "closed": self.path.closed,
            "legs": list(self.legs),
        }
