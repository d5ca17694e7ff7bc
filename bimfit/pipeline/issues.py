"""Joints out of their limits, and those that could not be measured, as BCF topics."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bimfit.bim.bcf import Issue, Version, Viewpoint, check_bcf, distance_to_see, write_bcf
from bimfit.errors import BimfitError, ConfigError
from bimfit.files import protect_inputs
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array
from bimfit.pipeline.document import SURE, JointDocument, ResultsDocument
from bimfit.pipeline.gap_files import load_gap
from bimfit.pipeline.limits import Limits, Verdict, judge, values
from bimfit.report.limit_plots import LimitSeries, plot_limits
from bimfit.report.scene import JointScene, View, render_joint

if TYPE_CHECKING:
    from bimfit.bim.model import Model

_NEAREST, _FARTHEST = 0.6, 6.0
_SLANT = math.radians(25.0)
_NEEDLE = 0.12
_MARGIN, _LEAST_MARGIN = 0.25, 0.15
"""How much around a joint its picture shows, of its length, and at least, m."""
_VIEW = View(azimuth=62.0, elevation=48.0, opacity=0.35, size=(1400, 640))
Progress = Callable[[str, float], None]


def write_issues(
    results: ResultsDocument,
    folder: Path,
    path: Path,
    limits: Limits,
    *,
    building: Model | None = None,
    version: Version = "2.1",
    progress: Progress = lambda step, share: None,
) -> tuple[Issue, ...]:
    """Write a topic for each joint that is out of its limits or could not be measured.

    Parameters
    ----------
    results : ResultsDocument
    folder : Path
        Where the results' gap meshes are.
    path : Path
        The ``.bcf`` to write.
    limits : Limits
    building : Model, optional
        Draws the elements into the snapshots.
    version : {"2.1", "3.0"}

    Returns
    -------
    tuple of Issue

    Raises
    ------
    BimfitError
        Without bcf-client, or when the file cannot be written.
    """
    check_bcf(path, version)
    protect_inputs([path], [Path(results.model), Path(results.scan)])
    judged = [(joint, judge(joint, limits)) for joint in results.joints]
    bad = [(joint, verdict) for joint, verdict in judged if verdict.outcome in ("fail", "not measured")]
    issues = []
    for k, (joint, verdict) in enumerate(bad):
        progress("drawing issues", k / len(bad))
        issues.append(_issue(joint, verdict, limits, folder, building))
    name, project = _model(results, building)
    write_bcf(path, issues, model=name, project=project, version=version)
    return tuple(issues)


def open_building(results: ResultsDocument) -> Model | None:
    """The model that results are of; None where it is no longer there."""
    from bimfit.bim.model import load_model

    try:
        return load_model(Path(results.model))
    except BimfitError:
        return None


def _model(results: ResultsDocument, building: Model | None) -> tuple[str, str]:
    from bimfit.bim.opening import project_guid

    file = Path(results.model) if building is None else building.path
    return file.name, project_guid(file)


def _issue(
    joint: JointDocument, verdict: Verdict, limits: Limits, folder: Path, building: Model | None
) -> Issue:
    failed = verdict.outcome == "fail"
    return Issue(
        key=joint.id,
        title=_title(joint, verdict, limits),
        description=describe_issue(joint, verdict, limits),
        elements=joint.elements,
        viewpoint=viewpoint(joint, verdict),
        snapshot=_snapshot(joint, verdict, limits, folder, building),
        labels=("out of limits" if failed else "not measured", joint.kind),
        urgent=any(breach.sure for breach in verdict.breaches),
    )


def _title(joint: JointDocument, verdict: Verdict, limits: Limits) -> str:
    between = " / ".join(name for name in joint.names if name) or joint.kind
    if not verdict.breaches:
        return f"Joint {joint.id} could not be measured ({between})"
    worst = verdict.breaches[0]
    return (
        f"Joint {joint.id}: {worst.name} {worst.value * 1e3:.1f} mm, {limits.words(worst.name)} ({between})"
    )


def describe_issue(joint: JointDocument, verdict: Verdict, limits: Limits) -> str:
    """The figures in words, mm."""
    size = f"{joint.length * 1e3:.0f} mm long, designed {joint.width * 1e3:.1f} mm wide"
    lines = [
        f"{joint.kind} joint {joint.id}, {size}.",
        *(f"Out of limits: {breach.words(limits)}." for breach in verdict.breaches),
    ]
    if verdict.outcome == "not measured":
        lines.append(f"Not measured: {verdict.reason}.")
    if joint.trusted:
        widths = 1e3 * np.array([station.width for station in joint.trusted])
        sigma = 1e3 * np.array([station.sigma_width for station in joint.trusted])
        typical = SURE * float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else math.nan
        spread = f" (± {typical:.1f} mm at a station)" if math.isfinite(typical) else ""
        ends = f"{widths.min():.1f} to {widths.max():.1f} mm"
        lines.append(f"Width at the mouth {ends}, mean {widths.mean():.1f} mm{spread}.")
    if math.isfinite(joint.volume):
        spread = f" ± {SURE * joint.volume_sigma * 1e3:.3f}" if math.isfinite(joint.volume_sigma) else ""
        lines.append(f"Gap volume {joint.volume * 1e3:.3f}{spread} litre.")
    counts = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in joint.counts.items())
    lines.append(f"Stations: {counts or 'none'}. Limits: {limits}. ± is {SURE:g} standard deviations.")
    lines.append(
        "Elements: "
        + "; ".join(f"{guid} {name}".strip() for guid, name in zip(joint.elements, joint.names, strict=True))
    )
    return "\n".join(lines)


def viewpoint(joint: JointDocument, verdict: Verdict) -> Viewpoint:
    """Look at the worst station, or at the middle, from out of the mouth and a little aside."""
    target, outward, along = focus(joint, verdict)
    away = min(max(distance_to_see(1.2 * joint.length), _NEAREST), _FARTHEST)
    toward = math.cos(_SLANT) * outward + math.sin(_SLANT) * along
    up = _upward(toward, outward)
    return Viewpoint(target + away * toward, -toward, up)


def focus(joint: JointDocument, verdict: Verdict) -> tuple[Array, Array, Array]:
    """What to look at (3,), out of the mouth there (3,) and along the joint (3,), world."""
    if verdict.breaches or joint.stations:
        stations = joint.stations
        worst = verdict.breaches[0].station if verdict.breaches else stations[len(stations) // 2]
        return worst.origin, worst.v, worst.n
    if len(joint.path) < 2:
        raise ConfigError(f"joint {joint.id} has neither stations nor a path", remedy="fit it again")
    legs = np.diff(joint.path, axis=0)
    middle = len(legs) // 2
    along = legs[middle] / np.linalg.norm(legs[middle])
    return 0.5 * (joint.path[middle] + joint.path[middle + 1]), joint.outward[middle], along


def _upward(toward: Array, outward: Array) -> Array:
    """The picture's up direction: the world's, unless one looks straight down or up."""
    up = np.array([0.0, 0.0, 1.0])
    if abs(float(up @ toward)) > math.cos(math.radians(15.0)):
        up = np.array([0.0, 1.0, 0.0])
    up = up - (up @ toward) * toward
    return np.asarray(up / np.linalg.norm(up))


def _snapshot(
    joint: JointDocument, verdict: Verdict, limits: Limits, folder: Path, building: Model | None
) -> bytes | None:
    """The joint in space, and its figures along it against the limits."""
    with tempfile.TemporaryDirectory(prefix="bimfit-") as place:
        series = limit_series(joint, limits) if joint.trusted else []
        title = _headline(joint, verdict)
        view = draw_joint(
            Path(place) / "view.png", joint, verdict, folder, building, title="" if series else title
        )
        if not series:
            return None if view is None else view.read_bytes()
        picture = plot_limits(Path(place) / "snapshot.png", series, picture=view, title=title)
        return picture.read_bytes()


def draw_joint(
    path: Path,
    joint: JointDocument,
    verdict: Verdict,
    folder: Path,
    building: Model | None,
    *,
    title: str = "",
) -> Path | None:
    """Draw a joint in space, its worst station marked; None where neither elements nor gap are known."""
    elements, gap = joint_elements(joint, building), load_gap(joint, folder)
    if not elements and gap is None:
        return None
    target, outward, along = focus(joint, verdict)
    needle = np.stack([target, target + _NEEDLE * max(joint.length, 0.2) * outward])
    scene = JointScene(
        elements=elements,
        gap=None if gap is None else gap[0],
        gap_width=None if gap is None else gap[1],
        marked=([needle] if verdict.breaches else []) + ([joint.path] if gap is None else []),
        up=outward,
        along=along,
        title=title,
    )
    line = joint.path if len(joint.path) else target[None]
    # of a joint that was not measured, what it is a part of says more
    margin = max((_MARGIN if joint.trusted else 1.0) * joint.length, _LEAST_MARGIN)
    box = margin * np.array([*np.eye(3), *-np.eye(3)])
    around = (line[:, None, :] + box).reshape(-1, 3)
    return render_joint(path, scene, dataclasses.replace(_VIEW, around=around))


def limit_series(joint: JointDocument, limits: Limits) -> list[LimitSeries]:
    """What there is to draw along a joint: the width at its mouth, and all that is limited."""
    if not joint.stations:
        return []
    s = np.array([station.s for station in joint.stations])
    status = [station.status for station in joint.stations]
    trusted = np.array([station.trusted for station in joint.stations])
    out = []
    for name in dict.fromkeys(("width", *limits.given)):
        value, sigma = values(name, joint.stations)
        low, high = limits.given.get(name, (-math.inf, math.inf))
        designed = np.array([station.designed_width for station in joint.stations])
        middle = float(np.nanmedian(designed)) if np.isfinite(designed).any() else math.nan
        out.append(
            LimitSeries(
                label=name,
                s=s,
                value=np.where(trusted, value, np.nan),
                sigma=np.where(trusted, sigma, np.nan),
                status=status,
                designed=middle if name == "width" else 0.0 if name in ("step", "deviation") else math.nan,
                low=low,
                high=high,
            )
        )
    return out


def _headline(joint: JointDocument, verdict: Verdict) -> str:
    if not verdict.breaches:
        return f"{joint.id}: not measured"
    worst = verdict.breaches[0]
    return f"{joint.id}: {worst.name} {worst.value * 1e3:.1f} mm at {worst.station.s * 1e3:.0f} mm"


def joint_elements(joint: JointDocument, building: Model | None) -> list[TriangleMesh]:
    """Meshes of the joint's elements, as designed; none without the model."""
    if building is None:
        return []
    known: Mapping[str, TriangleMesh] = {element.guid: element.mesh for element in building.elements}
    return [known[guid] for guid in joint.elements if guid in known]
