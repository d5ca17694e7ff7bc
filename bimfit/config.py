"""Settings: one frozen dataclass a stage, checked when made, TOML in and out.

Lengths are metres and angles are radians, as everywhere in the library.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_type_hints

from bimfit.errors import ConfigError

Bound = Literal["majorant", "overlap", "block"]
Missing = Literal["gap", "unknown"]
Triple = tuple[float, float, float]
T = TypeVar("T")


def _positive(owner: object, *names: str) -> None:
    for name in names:
        value = getattr(owner, name)
        if not (math.isfinite(value) and value > 0.0):
            raise ConfigError(f"{name} must be a positive number, got {value}")


def _share(owner: object, *names: str) -> None:
    for name in names:
        value = getattr(owner, name)
        if not (0.0 <= value < 1.0):
            raise ConfigError(f"{name} must lie in [0, 1), got {value}")


@dataclass(frozen=True)
class SensorConfig:
    """What is known of the sensor.

    Attributes
    ----------
    sigma : float
        Standard deviation of a range, m.
    sigma_per_metre, sigma_beyond : float
        How much sigma grows with each metre of range, from what range on (m): sigma + sigma_per_metre
        max(range - sigma_beyond, 0). Of a sensor good to 30 mm, and 3 % beyond 1 m: 0.03, 0.03 and 1.
    correlation : float
        Of the noise of neighbouring beams (lag 1).
    outlier_share, miss_share : float
        Share of beams that return from something else, and of beams that meet the
        component but return nothing.
    outlier_run : float
        How many neighbouring beams such strays take on average: 1 alone, 4 of a sensor that sees streaks of
        glare or ghosts. A run of them is then no sign of another shape, nor of something behind.
    max_range : float
        Farthest range the sensor reports, m.
    missing : {"gap", "unknown"}
        What a beam says that returned nothing: that hardly anything can be there, or nothing at all, as on
        shiny or dark surfaces. Returns from far behind say that nothing is there either way.
    adapt : bool
        Whether sigma, the shares and the correlation of neighbouring beams are estimated anew from each
        joint's residuals.
    """

    sigma: float = 0.003
    sigma_per_metre: float = 0.0
    sigma_beyond: float = 0.0
    correlation: float = 0.0
    outlier_share: float = 0.01
    miss_share: float = 0.01
    outlier_run: float = 1.0
    max_range: float = 5.6
    missing: Missing = "gap"
    adapt: bool = True

    def __post_init__(self) -> None:
        _positive(self, "sigma", "max_range")
        for name in ("sigma_per_metre", "sigma_beyond"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ConfigError(f"{name} must be a number of at least 0, got {value}")
        _share(self, "outlier_share", "miss_share", "correlation")
        if not 1.0 <= self.outlier_run <= 100.0:
            raise ConfigError(f"outlier_run must lie in [1, 100], got {self.outlier_run}")
        if self.missing not in get_args(Missing):
            raise ConfigError(f"missing is one of {', '.join(get_args(Missing))}; got {self.missing}")

    def growth(self, distance: float) -> float:
        """How many times sigma a range of that length, m, deviates."""
        return 1.0 + self.sigma_per_metre * max(distance - self.sigma_beyond, 0.0) / self.sigma

    @property
    def independent_share(self) -> float:
        """Independent beams that each is worth among many neighbours: (1 - rho) / (1 + rho)."""
        return (1.0 - self.correlation) / (1.0 + self.correlation)

    def pooled(self) -> SensorConfig:
        """The sensor whose beams are independent and together worth the same: sigma / sqrt(f)."""
        if self.correlation == 0.0:
            return self
        more = 1.0 / math.sqrt(self.independent_share)
        return dataclasses.replace(
            self, sigma=more * self.sigma, sigma_per_metre=more * self.sigma_per_metre, correlation=0.0
        )

    def at(self, distance: float) -> SensorConfig:
        """The sensor at one range, m: sigma is what it is there, and grows no more."""
        if self.sigma_per_metre == 0.0:
            return self
        sigma = self.sigma * self.growth(distance)
        return dataclasses.replace(self, sigma=sigma, sigma_per_metre=0.0, sigma_beyond=0.0)


@dataclass(frozen=True)
class SearchConfig:
    """One correlative search: its window, its tolerances and when it may stop.

    Attributes
    ----------
    window : tuple of 3 float
        Half widths of the search window in u, v (m) and theta (rad).
    tolerance : tuple of 3 float
        Spacing of the finest lattice (the paper's t) in u, v (m) and theta (rad).
    tests_per_level : int
        The paper's s: tests an axis and level.
    levels : int or None
        The paper's L; None derives it per axis from Eq. 1 and 2. 2 gives MRCSM, in
        which the tests an axis and level follow from L.
    bound : {"majorant", "overlap", "block"}
        Quadratic majorants, block maxima with one overlap (both proven), or the paper's
        block maxima as printed (Eq. 3 to 5), which is not an upper bound.
    eps : float
        Stop once the open bound is within ``eps`` times the best score.
    max_evaluations : int or None
        Give up after that many bound or score evaluations.
    time_budget : float or None
        Give up after that many seconds.
    delta : float
        Collect every pose whose score is within ``delta`` times the best score.
    axis_tests, axis_levels : tuple of 3 int or None
        ``tests_per_level`` and ``levels`` for each of u, v, theta where they differ.
    prior_sigma : tuple of 3 float or None
        Standard deviations of a Gaussian prior on the motion within the window, in u, v (m) and theta
        (rad); its log, times ``prior_weight``, is added to the score. ``inf`` leaves an axis free.
    prior_weight : float
        Points' worth of one unit of log-prior.
    """

    window: Triple = (0.1215, 0.1215, math.radians(45.0))
    tolerance: Triple = (0.001, 0.001, math.radians(0.6))
    tests_per_level: int = 3
    levels: int | None = None
    bound: Bound = "majorant"
    eps: float = 0.0
    max_evaluations: int | None = None
    time_budget: float | None = None
    delta: float = 0.0
    axis_tests: tuple[int, int, int] | None = None
    axis_levels: tuple[int, int, int] | None = None
    prior_sigma: Triple | None = None
    prior_weight: float = 1.0

    def __post_init__(self) -> None:
        if len(self.window) != 3 or len(self.tolerance) != 3:
            raise ConfigError("window and tolerance take three numbers: u, v, theta")
        if not all(math.isfinite(w) and w >= 0.0 for w in self.window):
            raise ConfigError(f"window must be three numbers of at least 0, got {self.window}")
        if not all(math.isfinite(t) and t > 0.0 for t in self.tolerance):
            raise ConfigError(f"tolerance must be three positive numbers, got {self.tolerance}")
        if self.window[2] > math.pi + 1e-12:
            raise ConfigError(f"the angular window is at most pi each way, got {self.window[2]}")
        if self.tests_per_level < 2:
            raise ConfigError(f"tests_per_level must be at least 2, got {self.tests_per_level}")
        if self.levels is not None and self.levels < 1:
            raise ConfigError(f"levels must be at least 1, got {self.levels}")
        if self.bound not in ("majorant", "overlap", "block"):
            raise ConfigError(f"bound is one of majorant, overlap, block; got {self.bound}")
        if not (self.eps >= 0.0 and self.delta >= 0.0 and self.prior_weight >= 0.0):
            raise ConfigError("eps, delta and prior_weight must be at least 0")
        if self.axis_tests is not None and (len(self.axis_tests) != 3 or min(self.axis_tests) < 2):
            raise ConfigError(f"axis_tests takes three numbers of at least 2, got {self.axis_tests}")
        if self.axis_levels is not None and (len(self.axis_levels) != 3 or min(self.axis_levels) < 1):
            raise ConfigError(f"axis_levels takes three numbers of at least 1, got {self.axis_levels}")
        if self.prior_sigma is not None and not (len(self.prior_sigma) == 3 and min(self.prior_sigma) > 0.0):
            raise ConfigError(f"prior_sigma takes three positive numbers, got {self.prior_sigma}")


@dataclass(frozen=True)
class FitConfig:
    """How a joint is fitted at one station.

    Attributes
    ----------
    placement_sigma : float
        How far each component may have moved by itself, m; the combined table is
        blurred by sqrt(sensor.sigma^2 + placement_sigma^2).
    gap_fraction : float
        Half window of a component's own search as a fraction of the designed gap.
    placement_tolerance : float
        Half window of a component's own search is never less than this, m.
    component_angle : float
        Half window of a component's own search in theta, rad.
    joint_sigma : float
        Standard deviation of the joint's place as a whole about its design, m: it decides between gaps in
        the scan that look alike.
    reach : float
        How far from the joint the cross-sections are used, m.
    min_points : int
        Fewer returns than this in a slice: ``no_data``.
    """

    placement_sigma: float = 0.0052
    gap_fraction: float = 0.5
    placement_tolerance: float = 0.0125
    component_angle: float = math.radians(6.0)
    joint_sigma: float = 0.020
    reach: float = 0.2
    min_points: int = 6

    def __post_init__(self) -> None:
        _positive(self, "placement_sigma", "gap_fraction", "placement_tolerance", "component_angle", "reach")
        _positive(self, "joint_sigma")
        if self.min_points < 3:
            raise ConfigError(f"min_points must be at least 3, got {self.min_points}")


@dataclass(frozen=True)
class ShapeConfig:
    """How far components may differ in shape from their design; 0 holds a freedom fixed.

    Attributes
    ----------
    bevel_angle, face_angle : float
        Prior standard deviations of the angle of the face in the gap and of the outer face beside it, rad.
    thickness : float
        Of a component's thickness, m.
    limit : float
        No freedom goes farther than so many of its prior standard deviations; a station that gets there is
        ``weak``.
    """

    bevel_angle: float = 0.0
    face_angle: float = 0.0
    thickness: float = 0.0
    limit: float = 3.0

    def __post_init__(self) -> None:
        _positive(self, "limit")
        for name, most in (("bevel_angle", 0.5), ("face_angle", 0.5), ("thickness", 0.5)):
            value = getattr(self, name)
            if not 0.0 <= value <= most:
                raise ConfigError(f"{name} must lie in [0, {most}], got {value}")

    @property
    def freedoms(self) -> dict[str, float]:
        """The freedoms that are not fixed, by their names on the command line, and their priors."""
        named = {"bevel-angle": self.bevel_angle, "face-angle": self.face_angle, "thickness": self.thickness}
        return {name: sd for name, sd in named.items() if sd > 0.0}


@dataclass(frozen=True)
class SliceConfig:
    """How a scan is cut into slices.

    Attributes
    ----------
    spacing : float or None
        Distance between stations, m; None takes it from the scan.
    thickness : float or None
        How much of a scan along the joint makes a slice, m; None: the spacing, but where that is wider than
        10 mm no more than this or than the scan's own sweeps or rows are apart.
    """

    spacing: float | None = None
    thickness: float | None = None

    def __post_init__(self) -> None:
        for name in ("spacing", "thickness"):
            if getattr(self, name) is not None:
                _positive(self, name)


@dataclass(frozen=True)
class JointConfig:
    """Which pairs of elements count as joints.

    Attributes
    ----------
    max_gap : float
        Widest gap, m.
    min_length : float
        Shortest joint, m.
    classes : tuple of str
        IFC classes to look at, subclasses that begin with the same name included (IfcWall: also
        IfcWallStandardCase); empty: every building element but openings, spaces, doors, windows and
        furniture.
    storeys : tuple of str
        Names of the storeys to look at; empty: all.
    min_gap : float or None
        Narrowest gap, m; None lists touching and overlapping elements too.
    everything : bool
        List also what is seldom a joint that anyone works on: cavities that are shut on both sides, large
        parallel layers ("sheet"), contacts about as short as they are deep ("patch").
    """

    max_gap: float = 0.060
    min_length: float = 0.100
    classes: tuple[str, ...] = ()
    storeys: tuple[str, ...] = ()
    min_gap: float | None = None
    everything: bool = False

    def __post_init__(self) -> None:
        _positive(self, "max_gap", "min_length")
        if self.min_gap is not None and not self.min_gap < self.max_gap:
            raise ConfigError(f"min_gap must be less than max_gap, got {self.min_gap} and {self.max_gap}")


@dataclass(frozen=True)
class Config:
    """Every stage's settings together."""

    sensor: SensorConfig = field(default_factory=SensorConfig)
    joints: JointConfig = field(default_factory=JointConfig)
    slices: SliceConfig = field(default_factory=SliceConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    shape: ShapeConfig = field(default_factory=ShapeConfig)


def from_dict(kind: type[T], values: dict[str, Any], place: str = "") -> T:
    """Make a settings dataclass of type ``kind`` from nested plain values.

    Raises
    ------
    ConfigError
        For a key that does not exist (the nearest one is named) or a value of the wrong kind.
    """
    hints = get_type_hints(kind)
    known: dict[str, Any] = {}
    for key, value in values.items():
        where = f"{place}.{key}" if place else key
        if key not in hints:
            near = difflib.get_close_matches(key, hints, n=1)
            raise ConfigError(f"unknown setting {where}", remedy=f"did you mean {near[0]}?" if near else "")
        if dataclasses.is_dataclass(hints[key]) and isinstance(hints[key], type):
            if not isinstance(value, dict):
                raise ConfigError(f"{where} must be a table")
            known[key] = from_dict(hints[key], value, where)
        else:
            known[key] = tuple(value) if isinstance(value, list) else value
    try:
        return kind(**known)
    except TypeError as error:
        raise ConfigError(f"{place or 'settings'}: {error}") from error


def load_config(path: str | Path) -> Config:
    """Read settings from a TOML file; what it does not name keeps its default.

    Raises
    ------
    ConfigError
        When the file cannot be read or holds something that is not a setting.
    """
    try:
        with Path(path).open("rb") as stream:
            values = tomllib.load(stream)
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", file=path) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"not TOML: {error}", file=path) from error
    try:
        return from_dict(Config, values)
    except ConfigError as error:
        raise ConfigError(error.message, file=path, remedy=error.remedy) from error


def dump_config(config: Config) -> str:
    """Write settings as TOML; what is None is left out."""
    import tomli_w

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items() if item is not None}
        return list(value) if isinstance(value, tuple) else value

    return tomli_w.dumps(plain(dataclasses.asdict(config)))
