"""What a run found, before it is written anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Slice
from bimfit.geometry.status import Status

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint
    from bimfit.bim.model import Model
    from bimfit.config import Config
    from bimfit.estimation.noise import Noise
    from bimfit.gap.mesh import GapMesh
    from bimfit.gap.section import GapSection
    from bimfit.gap.step import Step
    from bimfit.gap.volume import Volumes
    from bimfit.geometry.line_scan import LineScan
    from bimfit.pipeline.placing import Placed
    from bimfit.registration.result import MatchResult
    from bimfit.scan.cloud import PointCloud


@dataclass(frozen=True)
class FreedomResult:
    """One freedom of a component's shape at one station.

    Attributes
    ----------
    name : str
        ``bevel-angle``, ``face-angle`` or ``thickness`` (:mod:`bimfit.geometry.shape`).
    value, sigma : float or None
        Difference from the design and its standard deviation, rad or m; None where the data do not show it.
    state : str
        ``estimated``, ``at its limit`` or ``unseen``.
    pooled : str
        ``constant`` or ``linear`` along the joint, or ``station``; empty where it is unseen.
    """

    name: str
    value: float | None
    sigma: float | None
    state: str
    pooled: str


@dataclass(frozen=True)
class ComponentResult:
    """One component at one station.

    Attributes
    ----------
    element : str
        Its GlobalId.
    match : MatchResult or None
        Its own search; None where none was run.
    pose : Pose2D or None
        The estimate: as built = pose * designed, in the section frame; None when not known.
    covariance : ndarray, shape (3, 3), or None
        Of (u, v, theta) of that motion.
    rms : float
        Root mean square residual of its returns, m; NaN when not known.
    shape : tuple of FreedomResult
        The freedoms of its shape that were asked for.
    """

    element: str
    match: MatchResult | None
    pose: Pose2D | None
    covariance: Array | None
    rms: float = float("nan")
    shape: tuple[FreedomResult, ...] = ()


@dataclass(frozen=True)
class StationResult:
    """Everything known of one station."""

    section: JointSection
    slice: Slice
    status: Status
    combined: MatchResult | None
    components: tuple[ComponentResult, ComponentResult]
    gap: GapSection | None
    seconds: float = 0.0

    @property
    def nearness(self) -> tuple[str, float, float]:
        """Contact, narrowest width and its deviation, m; an empty contact where there is no gap.

        The deviation is without bound where the station is not ``ok``: nothing is beyond doubt there.
        """
        if self.gap is None:
            return "", float("nan"), float("nan")
        sigma = float("nan") if self.gap.sigma is None else self.gap.sigma.width_narrowest
        sigma = sigma if self.status.name == "ok" else float("inf")
        return self.gap.contact, self.gap.width_narrowest, sigma

    @property
    def step(self) -> Step | None:
        """How flush the two components are at the mouth; None where that is not known."""
        from bimfit.gap.step import gap_step

        a, b = self.components
        if a.pose is None or b.pose is None:
            return None
        return gap_step(self.section.gap, a.pose, b.pose, a.covariance, b.covariance)


@dataclass(frozen=True)
class JointResult:
    """Everything known of one joint.

    Attributes
    ----------
    joint : Joint
        As designed, its mouth towards the sensor.
    method : str
        The matcher that was used.
    stations : tuple of StationResult
    mesh : GapMesh or None
        None where no two neighbouring stations were measured.
    volumes : Volumes or None
    motion : str
        The motion model along the joint that was chosen.
    noise : Noise or None
        What the residuals say of the sensor; None where no estimate was made.
    seconds : float
        Wall time for the joint, without reading files.
    table_seconds : float
        Of these, building look-up tables.
    """

    joint: Joint
    method: str
    stations: tuple[StationResult, ...]
    mesh: GapMesh | None
    volumes: Volumes | None
    motion: str = "independent"
    noise: Noise | None = None
    seconds: float = 0.0
    table_seconds: float = 0.0

    @property
    def measured(self) -> bool:
        """Whether at least one station has a gap."""
        return any(station.gap is not None for station in self.stations)

    @property
    def without_data(self) -> bool:
        """Whether what most of its stations say is that they hold too little to say anything."""
        commonest = self.reason
        return any(e.status.name == "no_data" and e.status.reason == commonest for e in self.stations)

    @property
    def reason(self) -> str:
        """Why the joint has no estimate: what most of its stations say."""
        if self.measured:
            return ""
        if not self.stations:
            return "the scan shows no station of it"
        reasons = [station.status.reason for station in self.stations]
        return max(reasons, key=reasons.count)


@dataclass(frozen=True)
class SurveyResult:
    """A whole run: one model, one scan, some joints.

    Attributes
    ----------
    model, scan : Path
        The files.
    building : Model
    cloud : LineScan or PointCloud
        What was read from them, in world coordinates; of a point cloud what lies near the joints.
    config : Config
    joints : tuple of JointResult
    notes : tuple of str
        What a user should know of how the files were read.
    placed : Placed or None
        How the scan was carried to the model's coordinates.
    """

    model: Path
    scan: Path
    building: Model
    cloud: LineScan | PointCloud
    config: Config
    joints: tuple[JointResult, ...]
    notes: tuple[str, ...] = ()
    placed: Placed | None = None

    @property
    def failed(self) -> Sequence[JointResult]:
        """Joints without an estimate."""
        return [joint for joint in self.joints if not joint.measured]
