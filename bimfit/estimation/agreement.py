"""Whether slices that a profile was taught from show one shape."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from bimfit.estimation.company import departs
from bimfit.estimation.departure import departure, on_outline
from bimfit.estimation.result import StationEstimate
from bimfit.geometry.joint_section import JointSection

_PARTS = 3
_MATTERS = 0.25
"""A part's departure matters from this share of sigma."""
_SURE = 3.5
_TURN = math.radians(1.0)
_CLEAR = 2.0
_LEAST = 40

Slopes = dict[int, tuple[float, float]]


def disagreement(
    stations: Sequence[StationEstimate], sections: Sequence[JointSection], correlation: float = 0.0
) -> str:
    """What parts of a joint contradict the shape that all of it was taught to have; "" where none does.

    Each third of the joint is compared: its pooled residuals with the taught surface, and how its faces are
    turned with those of the other thirds.

    Parameters
    ----------
    stations, sections : sequence
        Estimated with the taught sections, in the order of the joint.
    correlation : float
        Of neighbouring beams' noise.
    """
    parts = [p for p in np.array_split(np.arange(len(stations)), _PARTS) if len(p)]
    for which, name in enumerate("AB"):
        groups = [([stations[k] for k in p], [sections[k] for k in p]) for p in parts]
        for group, designs in groups:
            found = departure(group, designs, which, correlation=correlation)
            if departs(found) and found.rms > _MATTERS * group[0].sensor.sigma:
                side = "in front of" if found.worst > 0.0 else "behind"
                return (
                    f"the slices do not show one shape: from {group[0].s:.3f} to {group[-1].s:.3f} m along "
                    f"the joint, component {name} lies up to {abs(found.worst) * 1e3:.1f} mm {side} the "
                    "taught surface"
                )
        slopes = [_slopes(group, designs, which, correlation) for group, designs in groups]
        turn = max((_turned(a, b) for a, b in combinations(slopes, 2)), default=0.0)
        if turn > 0.0:
            return (
                f"the slices do not show one shape: a face of component {name} turns by "
                f"{math.degrees(turn):.1f} degrees along the joint"
            )
    return ""


def _slopes(
    stations: Sequence[StationEstimate], sections: Sequence[JointSection], which: int, correlation: float
) -> Slopes:
    """How each face seen is turned against the taught one, and its standard deviation, rad.

    Every station's own mean is taken out of its offsets, for a shift explains it.
    """
    sums: dict[int, list[float]] = {}
    for station, section in zip(stations, sections, strict=True):
        c = station.components[which]
        if c.pose is None or not len(c.residuals.feet):
            continue
        r = c.residuals
        faces, offset = r.faces, r.residuals * r.lean
        along, clear, _ = on_outline(section.components[which], c.pose.inverse().apply(r.feet), faces)
        keep = clear > _CLEAR * station.sensor.sigma
        for face in np.unique(faces[keep]).tolist():
            mine = keep & (faces == face)
            a, z = along[mine] - along[mine].mean(), offset[mine] - offset[mine].mean()
            total = sums.setdefault(face, [0.0] * 4)
            for k, x in enumerate((float(a @ a), float(a @ z), float(z @ z), float(len(a) - 1))):
                total[k] += x
    more = math.sqrt((1.0 + correlation) / (1.0 - correlation))
    out: Slopes = {}
    for face, (aa, az, zz, n) in sums.items():
        if n >= _LEAST and aa > 0.0:
            left = max(zz - az * az / aa, 0.0) / (n - 1.0)
            out[face] = az / aa, more * math.sqrt(left / aa)
    return out


def _turned(one: Slopes, two: Slopes) -> float:
    """By how much a face is surely turned between two parts of a joint, rad; 0 where none is."""
    worst = 0.0
    for face in one.keys() & two.keys():
        turn = abs(one[face][0] - two[face][0])
        if turn > max(_SURE * math.hypot(one[face][1], two[face][1]), _TURN):
            worst = max(worst, turn)
    return worst
