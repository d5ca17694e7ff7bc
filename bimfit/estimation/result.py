"""What the estimate of a station and of a joint consists of."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bimfit.config import SensorConfig
from bimfit.estimation.posterior import Posterior
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.status import OK, Status


@dataclass(frozen=True)
class Unsupported:
    """A face that a direction of the pose depends on, and that hardly a return bears out.

    Attributes
    ----------
    face : int
        Edge of the component's profile.
    beams, inliers : int
        Beams that should meet it, and those that return from it.
    direction : ndarray, shape (3,)
        What the other faces leave open, in (u, v, theta * radius).
    """

    face: int
    beams: int
    inliers: int
    direction: Array


@dataclass(frozen=True)
class Residuals:
    """How the returns of one component agree with its estimate.

    Attributes
    ----------
    n_beams, n_covered, n_inliers : int
        Beams used, beams predicted to meet the component, returns within 4 sigma of it.
    rms : float
        Root mean square of the inliers' range residuals, m; NaN without any.
    chi2 : float
        Sum of their squares over sigma^2, a degree of freedom; NaN without any.
    outlier_share, miss_share : float
        Share of covered beams that returned from elsewhere, and that returned nothing.
    outlier_run, miss_run : int
        Longest unbroken run of each, along the component.
    cusum : float
        Range of the cumulated standardised residuals over sqrt(n): bends and wrong shapes show here.
    lag1 : float
        Correlation of neighbouring residuals.
    unexplained : int
        Returns that carry the component's surface on past where it should end.
    edge : float
        How far the last returns at an end of the main face lie behind it, in standard deviations.
    residuals, places : ndarray, shape (n_inliers,) and (n_inliers, 2)
        Residuals in range, m, and where the returns lie in the section.
    feet : ndarray, shape (n_inliers, 2)
        Where the beams should have met the component.
    lean : ndarray, shape (n_inliers,)
        How far in front of the surface (negative: behind) a residual of one metre lies.
    faces : ndarray, shape (n_inliers,)
        The edge of the component's profile that each should have met.
    unsupported : Unsupported or None
        A face without which the pose is not fixed and that the returns do not bear out.
    """

    n_beams: int = 0
    n_covered: int = 0
    n_inliers: int = 0
    rms: float = float("nan")
    chi2: float = float("nan")
    outlier_share: float = 0.0
    miss_share: float = 0.0
    outlier_run: int = 0
    miss_run: int = 0
    cusum: float = 0.0
    lag1: float = 0.0
    unexplained: int = 0
    edge: float = 0.0
    residuals: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    places: Array = field(default_factory=lambda: np.zeros((0, 2)), repr=False)
    feet: Array = field(default_factory=lambda: np.zeros((0, 2)), repr=False)
    lean: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    faces: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64), repr=False)
    unsupported: Unsupported | None = None


@dataclass(frozen=True)
class Rival:
    """Another pose that explains the data about as well.

    Attributes
    ----------
    pose : Pose2D
    log_odds : float
        Log posterior odds against the reported pose; negative.
    """

    pose: Pose2D
    log_odds: float


@dataclass(frozen=True)
class ComponentEstimate:
    """One component at one station.

    Attributes
    ----------
    pose : Pose2D or None
        Posterior mean; None where there is nothing to report.
    covariance : ndarray, shape (3, 3), or None
        Of (u, v, theta) of ``pose``, i.e. of the motion about the frame's origin.
    status : Status
    rivals : tuple of Rival
        Other modes, best first.
    n_inliers : int
        Returns that agree with the estimate.
    rms : float
        Their root mean square range residual, m.
    weak_direction : str
        Name of the direction that the data do not fix, "" where all are.
    posterior : Posterior or None
        The details: pivot, weak axis, evidence.
    residuals : Residuals
    prior : Pose2D or None
        What the prior was centred on (the combined pose).
    prior_sd : tuple of 3 float
        Its standard deviations about the pivot in u, v (m) and theta (rad).
    corner_step : float
        Bearing of the mouth corner in beam steps; NaN where unknown.
    """

    pose: Pose2D | None = None
    covariance: Array | None = None
    status: Status = OK
    rivals: tuple[Rival, ...] = ()
    n_inliers: int = 0
    rms: float = float("nan")
    weak_direction: str = ""
    posterior: Posterior | None = None
    residuals: Residuals = field(default_factory=Residuals)
    prior: Pose2D | None = None
    prior_sd: tuple[float, float, float] = (0.0, 0.0, 0.0)
    corner_step: float = float("nan")


@dataclass(frozen=True)
class StationEstimate:
    """Both components at one station.

    Attributes
    ----------
    s : float
        Distance along the joint, m.
    combined : Pose2D or None
        Combined pose after the slide.
    components : tuple of two ComponentEstimate
        A and B.
    status : Status
        The worse of what is wrong with the station as a whole and with its components.
    sensor : SensorConfig
        The noise that was assumed.
    slide_shift : float
        How far the slide moved the combined pose along u, m.
    rival_odds : float
        Log-odds of the best shift of the combined pose that lies apart, against the chosen one.
    through : int
        Beams that passed between the components.
    virtual : bool
        Whether the beams were made up from a plain point cloud.
    growth : float
        How many times the sensor's sigma at no range ``sensor.sigma`` is, because it grows with range.
    """

    s: float
    combined: Pose2D | None
    components: tuple[ComponentEstimate, ComponentEstimate]
    status: Status
    sensor: SensorConfig = field(default_factory=SensorConfig)
    slide_shift: float = 0.0
    rival_odds: float = -np.inf
    through: int = 0
    virtual: bool = False
    growth: float = 1.0
