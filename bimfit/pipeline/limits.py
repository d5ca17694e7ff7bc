"""What a joint may measure, and whether it does."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array
from bimfit.pipeline.document import SURE, JointDocument, StationDocument

Range = tuple[float, float]
Outcome = Literal["pass", "fail", "not measured", ""]
LEAST_MEASURED = 0.5
"""A joint passes only where at least this share of its stations was measured."""
_WORDS = {
    "width": "width at the mouth",
    "root": "width at the root",
    "narrowest": "narrowest width",
    "deviation": "deviation from the designed width",
    "step": "step between the faces",
}


@dataclass(frozen=True)
class Limits:
    """Allowed ranges, m; None where there is no limit.

    Attributes
    ----------
    width, root, narrowest : tuple of two float or None
        Of the gap at its mouth, at its root and where it is narrowest.
    deviation : tuple of two float or None
        Of the width at the mouth less the designed one.
    step : tuple of two float or None
        Of the step between the two faces at the mouth, less the designed one.
    """

    width: Range | None = None
    root: Range | None = None
    narrowest: Range | None = None
    deviation: Range | None = None
    step: Range | None = None

    @classmethod
    def of(cls, ranges: Mapping[str, Range]) -> Limits:
        """Limits by name.

        Raises
        ------
        ConfigError
            For a name that is none; says which there are.
        """
        for name in ranges:
            if name not in _WORDS:
                raise ConfigError(f"there is no limit called {name}", remedy=f"there are {', '.join(_WORDS)}")
        return cls(**ranges)

    @property
    def given(self) -> dict[str, Range]:
        """Those that there are, by name."""
        ranges = {name: getattr(self, name) for name in _WORDS}
        return {name: pair for name, pair in ranges.items() if pair is not None}

    def words(self, name: str) -> str:
        """One of them, mm."""
        return f"limits {range_text(self.given[name])}"

    def __str__(self) -> str:
        return ", ".join(f"{_WORDS[name]} {range_text(pair)}" for name, pair in self.given.items())


@dataclass(frozen=True)
class Breach:
    """Where a joint is farthest out of one of its limits.

    Attributes
    ----------
    name : str
        Of the limit.
    value, sigma, excess : float
        What was measured there, its standard deviation and by how much it is out, m.
    station : StationDocument
    count : int
        How many stations are out of it.
    """

    name: str
    value: float
    sigma: float
    excess: float
    station: StationDocument
    count: int

    @property
    def sure(self) -> bool:
        """Whether no known uncertainty could excuse it."""
        return not self.excess <= SURE * self.sigma

    def words(self, limits: Limits) -> str:
        """The breach in a sentence, mm."""
        spread = f" ± {SURE * self.sigma * 1e3:.1f}" if math.isfinite(self.sigma) else ""
        doubt = "" if self.sure else " (within the uncertainty)"
        places = f"{self.count} stations" if self.count > 1 else "1 station"
        measured = f"{self.value * 1e3:.1f}{spread} mm at {self.station.s * 1e3:.0f} mm along the joint"
        excess = f"{self.excess * 1e3:.1f} mm out of {range_text(limits.given[self.name])}{doubt}"
        return f"{_WORDS[self.name]} {measured}, {excess}; {places} out"


@dataclass(frozen=True)
class Verdict:
    """Whether a joint keeps its limits.

    Attributes
    ----------
    outcome : {"pass", "fail", "not measured", ""}
        Empty where there are no limits to keep.
    reason : str
        Why it fails or was not measured; of a pass, what speaks against it.
    breaches : tuple of Breach
        One for each limit that is broken, the worst first.
    """

    outcome: Outcome
    reason: str = ""
    breaches: tuple[Breach, ...] = ()


def judge(joint: JointDocument, limits: Limits | None) -> Verdict:
    """Hold a joint against its limits: any station out of them fails it, a weak one if that is sure.

    A joint of weak stations alone was not measured well enough to pass.
    """
    trusted = joint.trusted
    if not trusted:
        return Verdict("not measured", joint.reason or _commonest(joint.stations))
    if limits is None or not limits.given:
        return Verdict("")
    found = [_breach(name, pair, trusted) for name, pair in limits.given.items()]
    breaches = tuple(sorted((b for b in found if b is not None), key=lambda b: -b.excess))
    if breaches:
        return Verdict("fail", "; ".join(breach.words(limits) for breach in breaches), breaches)
    if not any(station.status == "ok" for station in trusted):
        return Verdict("not measured", _commonest(joint.stations))
    share = len(trusted) / len(joint.stations)
    if share < LEAST_MEASURED:
        why = _commonest([station for station in joint.stations if not station.trusted])
        return Verdict("not measured", f"only {len(trusted)} of {len(joint.stations)} stations: {why}")
    close = sum(_near(name, pair, station) for name, pair in limits.given.items() for station in trusted)
    return Verdict("pass", f"{close} figures lie within their uncertainty of a limit" if close else "")


def values(name: str, stations: Iterable[StationDocument]) -> tuple[Array, Array]:
    """What a limit is about at each station, and its standard deviation, m; NaN where not known."""
    rows = [_value(name, station) for station in stations]
    return np.array([row[0] for row in rows]), np.array([row[1] for row in rows])


def range_text(pair: Range) -> str:
    """A range in mm."""
    low, high = (f"{1e3 * end:g}" for end in pair)
    if math.isinf(pair[0]):
        return f"at most {high} mm"
    if math.isinf(pair[1]):
        return f"at least {low} mm"
    return f"±{high} mm" if pair[0] == -pair[1] else f"{low} to {high} mm"


def _value(name: str, station: StationDocument) -> tuple[float, float]:
    if name == "deviation":
        return station.width - station.designed_width, station.sigma_width
    if name == "step":
        return station.step - station.designed_step, station.sigma_step
    return getattr(station, name), getattr(station, f"sigma_{name}")


def _breach(name: str, pair: Range, stations: tuple[StationDocument, ...]) -> Breach | None:
    value, sigma = values(name, stations)
    excess = np.fmax(pair[0] - value, value - pair[1])
    weak = np.array([station.status != "ok" for station in stations])
    out = excess > np.where(weak, SURE * sigma, 0.0)
    if not out.any():
        return None
    worst = int(np.nanargmax(np.where(out, excess, np.nan)))
    return Breach(
        name, float(value[worst]), float(sigma[worst]), float(excess[worst]), stations[worst], int(out.sum())
    )


def _near(name: str, pair: Range, station: StationDocument) -> bool:
    value, sigma = _value(name, station)
    return min(value - pair[0], pair[1] - value) < SURE * sigma


def _commonest(stations: Iterable[StationDocument]) -> str:
    reasons = [station.reason or station.status for station in stations]
    return max(reasons, key=reasons.count) if reasons else "the scan shows no station of it"
