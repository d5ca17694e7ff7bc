"""What a joint's stations say of one another: a shape that no slice alone can tell, and bad company."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bimfit.estimation.departure import Departure, departure
from bimfit.estimation.result import StationEstimate
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.status import Status

_SURE = 4.0
"""Standard deviations from which on pooled residuals are no accident."""
_BENT, _BOTH = 3.7, 3.8
"""The same for a bend, one figure a component and not the best of many; and for both components' together."""
_TAKES_PART = 2.5
_MATTERS = 0.06
"""A shape matters where it departs from the design by this share of sigma, however sure it is."""
_BEND_MATTERS = 0.02
"""A bend, by this: what shows of one is what no turn of the component takes up."""
_NEIGHBOURS, _MOSTLY = 6, 0.6
_SPEAKS = 0.3
_FAR, _TOGETHER = 0.030, 0.0125
"""A joint does not lie so far (m) from where most stations around it lie so near to one another."""


def with_company(
    stations: Sequence[StationEstimate], sections: Sequence[JointSection], correlation: float = 0.0
) -> tuple[StationEstimate, ...]:
    """The stations, ``weak`` where the joint as a whole contradicts what one slice cannot see.

    Parameters
    ----------
    stations, sections : sequence
        One a station, in the order of the joint, each estimated by itself.
    correlation : float
        Of neighbouring beams' noise.
    """
    trusted = _trusted(stations)
    pooled = [stations[i] for i in trusted], [sections[i] for i in trusted]
    departures = [departure(*pooled, which, correlation=correlation) for which in (0, 1)]
    sigma = min((e.sensor.sigma for e in stations), default=0.0)
    together = math.hypot(*(d.bow for d in departures)) > _BOTH
    reasons = [_reason(d, sigma, _TAKES_PART if together else _BENT) for d in departures]
    rejected = [e.status.name == "rejected" for e in stations]
    astray = _astray(stations)
    out = []
    for i, station in enumerate(stations):
        around = [
            rejected[k] for k in range(max(0, i - _NEIGHBOURS), min(len(stations), i + _NEIGHBOURS + 1))
        ]
        if station.status.name == "ok" and sum(around) > _MOSTLY * (len(around) - 1) and len(around) > 3:
            bad = sum(around)
            reason = f"{bad} of the {len(around) - 1} stations around it do not fit the design"
            out.append(replace(station, status=Status("weak", reason)))
            continue
        if station.status.name in ("ok", "weak") and i in astray:
            reason = f"it lies {astray[i] * 1e3:.0f} mm from where the stations around it see the joint"
            out.append(replace(station, status=Status("ambiguous", reason)))
            continue
        out.append(_with_shape(station, reasons))
    return tuple(out)


def _trusted(stations: Sequence[StationEstimate]) -> list[int]:
    """Stations whose residuals speak of the components: all, or only those that are ``ok`` if that is many.

    Where a part of a joint is filled or covered, returns from something else lie beside its components.
    """
    fine = [i for i, e in enumerate(stations) if e.status.name == "ok"]
    return fine if len(fine) >= _SPEAKS * len(stations) else list(range(len(stations)))


def _astray(stations: Sequence[StationEstimate]) -> dict[int, float]:
    """Stations far from a place on which those around them agree, and how far, m.

    Glare can make a slice look like the joint in another place, as a whole and well explained.
    """
    known = [i for i, e in enumerate(stations) if e.combined is not None and e.status.measured]
    places = {i: e.combined.as_array()[:2] for i, e in enumerate(stations) if e.combined is not None}
    out = {}
    for i in known:
        around = np.array([places[k] for k in known if 0 < abs(k - i) <= _NEIGHBOURS])
        if len(around) < _NEIGHBOURS:
            continue
        middle = np.median(around, axis=0)
        near = np.hypot(*(around - middle).T) < _TOGETHER
        far = float(np.hypot(*(places[i] - middle)))
        if far > _FAR and near.mean() > _MOSTLY:
            out[i] = far
    return out


def departs(found: Departure, bent: float = _SURE) -> bool:
    """Whether a component's shape is another than designed, by its residuals pooled along the joint.

    Parameters
    ----------
    bent : float
        From how many standard deviations on a bend is no accident.
    """
    return found.freedom > 0 and (abs(found.bow) > bent or found.score > _SURE)


def _reason(found: Departure, sigma: float, bent: float) -> str:
    """Why a component's shape is not as designed, "" where it is as far as matters."""
    bends = abs(found.bow) > bent and found.bend > _BEND_MATTERS * sigma
    if not bends and not (departs(found, math.inf) and found.rms > _MATTERS * sigma):
        return ""
    what = "bent" if bends else "of another shape"
    return (
        f"pooled along the joint, its surface is {what}: up to {abs(found.worst) * 1e3:.1f} mm "
        f"{'in front of' if found.worst > 0.0 else 'behind'} the designed one"
    )


def _with_shape(station: StationEstimate, reasons: Sequence[str]) -> StationEstimate:
    components = [
        replace(c, status=Status("weak", reason)) if reason and c.status.name == "ok" else c
        for c, reason in zip(station.components, reasons, strict=True)
    ]
    status = station.status
    for name, reason in zip("AB", reasons, strict=True):
        if reason and status.name == "ok":
            status = Status("weak", f"component {name}: {reason}")
    return replace(station, components=(components[0], components[1]), status=status)
