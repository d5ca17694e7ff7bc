"""What is simulated: how components have moved and how the sensor measures (METHOD, section 1)."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from bimfit.config import from_dict
from bimfit.errors import ConfigError
from bimfit.geometry.pose import Array
from bimfit.simulation.disturbance import Disturbance

Motion = Literal["piecewise", "none", "const", "rigid", "linear", "bent"]


@dataclass(frozen=True)
class Scenario:
    """Ranges that a joint's motion is drawn from, and the virtual sensor; by default the reference scenario.

    Each component moves with the joint as a whole (``common_*``, about the joint's centre) and by itself
    (``own_*``, about its own mouth corner). What is drawn by itself shrinks with a designed gap under
    ``reference_gap``; see :func:`own_ranges`.

    Attributes
    ----------
    motion : {"piecewise", "none", "const", "rigid", "linear", "bent"}
        How the motion changes along the joint: piecewise linear between transition slices (the paper), not at
        all and nothing moved, the same everywhere, a rigid body that drifts (shift linear, rotation
        constant), everything linear, linear and a parabola on top.
    transitions : int
        Transition slices of ``piecewise``: first, last, the others drawn at random.
    common_shift, own_shift : tuple of 2 float
        Half ranges in u and v, m.
    common_angle, own_angle : float
        Half ranges in theta, rad.
    bow : float
        Half range of the rise of ``bent`` in the middle of the joint, common to both components, m.
    reference_gap : float
        The designed gap that ``own_shift`` and ``own_angle`` are meant for, m.
    spacing : float
        Distance between sweeps along the joint, m.
    sensor_height : float
        Distance of the sensor from the designed mouth, m, half way between the faces beside it.
    bearing_step, bearing_limit : float
        Between beams, and the half opening, rad.
    sigma : float
        Standard deviation of a range, m.
    sigma_per_metre, sigma_beyond : float
        How much sigma grows with each metre of range, from what range on (m).
    correlation : float
        Of the noise of neighbouring beams (lag 1).
    outliers, dropouts : float
        Share of beams that return from anywhere in range, and share of returns that are lost.
    min_range, max_range : float
        What the sensor can report, m.
    disturbance : Disturbance
        What else goes wrong: glare, ghosts, mixed pixels, spikes, bursts.
    """

    motion: Motion = "piecewise"
    transitions: int = 12
    common_shift: tuple[float, float] = (0.020, 0.020)
    common_angle: float = math.radians(5.0)
    own_shift: tuple[float, float] = (0.006, 0.006)
    own_angle: float = math.radians(3.0)
    bow: float = 0.005
    reference_gap: float = 0.025
    spacing: float = 0.010
    sensor_height: float = 0.250
    bearing_step: float = math.radians(0.352)
    bearing_limit: float = math.radians(30.0)
    sigma: float = 0.003
    sigma_per_metre: float = 0.0
    sigma_beyond: float = 0.0
    correlation: float = 0.0
    outliers: float = 0.0
    dropouts: float = 0.0
    min_range: float = 0.020
    max_range: float = 5.6
    disturbance: Disturbance = field(default_factory=Disturbance)

    def __post_init__(self) -> None:
        if self.motion not in get_args(Motion):
            raise ConfigError(f"motion is one of {', '.join(get_args(Motion))}; got {self.motion}")
        if (
            isinstance(self.transitions, bool)
            or not isinstance(self.transitions, int)
            or self.transitions < 2
        ):
            raise ConfigError(f"transitions must be a whole number of at least 2, got {self.transitions}")
        for name in ("common_shift", "own_shift"):
            value = getattr(self, name)
            if not (isinstance(value, tuple) and len(value) == 2 and all(_at_least_zero(x) for x in value)):
                raise ConfigError(f"{name} takes two numbers of at least 0 (u, v in metres), got {value}")
        for name in (
            "common_angle",
            "own_angle",
            "bow",
            "sigma",
            "sigma_per_metre",
            "sigma_beyond",
            "min_range",
        ):
            if not _at_least_zero(getattr(self, name)):
                raise ConfigError(f"{name} must be a number of at least 0, got {getattr(self, name)}")
        for name in (
            "reference_gap",
            "spacing",
            "sensor_height",
            "bearing_step",
            "bearing_limit",
            "max_range",
        ):
            if not _at_least_zero(getattr(self, name)) or getattr(self, name) == 0:
                raise ConfigError(f"{name} must be a positive number, got {getattr(self, name)}")
        for name in ("correlation", "outliers", "dropouts"):
            if not (_at_least_zero(getattr(self, name)) and getattr(self, name) < 1.0):
                raise ConfigError(f"{name} must lie in [0, 1), got {getattr(self, name)}")
        if self.bearing_limit >= math.pi:
            raise ConfigError(f"bearing_limit must be under pi rad, got {self.bearing_limit}")
        if self.min_range >= self.max_range:
            raise ConfigError("min_range must be less than max_range")

    @property
    def bearings(self) -> Array:
        """Of the beams, ascending, rad from -v towards u; shape (n,)."""
        count = math.floor(self.bearing_limit / self.bearing_step + 1e-9)
        return np.arange(-count, count + 1, dtype=np.float64) * self.bearing_step

    def stations(self, length: float) -> Array:
        """Where along a joint of ``length`` the sweeps are, m; what is left over goes to both ends."""
        count = math.floor(length / self.spacing + 1e-6)
        return np.clip((length - count * self.spacing) / 2 + np.arange(count + 1) * self.spacing, 0.0, length)


def load_scenario(path: str | Path) -> Scenario:
    """Read a scenario from a TOML file; what it does not name keeps its default.

    Raises
    ------
    ConfigError
        When the file cannot be read or holds something that is not a setting.
    """
    try:
        values = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", file=path) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"not TOML: {error}", file=path) from error
    try:
        return from_dict(Scenario, values)
    except ConfigError as error:
        raise ConfigError(error.message, file=path, remedy=error.remedy) from error


@dataclass(frozen=True)
class OwnRanges:
    """What a component may move by itself, at one joint.

    Attributes
    ----------
    closing, opening : float
        Greatest shift in u towards the other component, and away from it, m.
    shift_v, angle : float
        Half ranges in v, m, and theta, rad.
    """

    closing: float
    opening: float
    shift_v: float
    angle: float


FREE_OPENING = 0.002
"""Components that touch as designed may still stand this far apart, m."""
CLOSED_SHARE = 0.45
"""No point of a gap's side moves further towards the other than this share of the narrowest designed gap."""


def own_ranges(scenario: Scenario, narrowest: float, lever: float) -> OwnRanges:
    """Scale a component's own motion to a designed gap, so that the gap never closes.

    Shifts shrink in proportion to the narrowest designed gap below the reference gap (6 mm at 25 mm, 0.72 mm
    at 3 mm); above it they stay. The rotation about the mouth corner is cut down such that shift
    and rotation together move no point of the gap's side by more than 45 % of the narrowest gap. Only away
    from the other component up to 2 mm are always allowed.

    Parameters
    ----------
    narrowest : float
        Least designed distance between the gap's sides, m.
    lever : float
        Greatest distance of a point of the gap's side from its mouth corner, m.
    """
    scale = min(1.0, max(narrowest, 0.0) / scenario.reference_gap)
    limit = CLOSED_SHARE * max(narrowest, 0.0)
    u, v = (scale * x for x in scenario.own_shift)
    size = math.hypot(u, v)
    if size > limit:
        u, v, size = u * limit / size, v * limit / size, limit
    turn = min(1.0, (limit - size) / max(lever, 1e-9))
    return OwnRanges(
        closing=u,
        opening=max(u, min(FREE_OPENING, scenario.own_shift[0])),
        shift_v=v,
        angle=min(scenario.own_angle, turn),
    )


def _at_least_zero(value: object) -> bool:
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and math.isfinite(value)
        and value >= 0.0
    )
