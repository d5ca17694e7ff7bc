"""teach(): a joint's profile from slices of a scan, in place of the one that BIM gives."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bimfit.config import Config
from bimfit.errors import JointError, ScanError
from bimfit.estimation.agreement import disagreement
from bimfit.estimation.cloud import virtual_beams
from bimfit.estimation.noise import estimate_noise
from bimfit.estimation.result import StationEstimate
from bimfit.estimation.teaching import taught_section
from bimfit.geometry.joint_section import GapOutline, JointSection
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.slice import Slice
from bimfit.pipeline.fit import fit_station
from bimfit.pipeline.placing import Placing, place_scan
from bimfit.pipeline.profile_file import TaughtProfile
from bimfit.pipeline.survey import by_name, covered_joints, cut_joint, model_joints, part_of
from bimfit.pipeline.targets import TargetCache, prepare

if TYPE_CHECKING:
    from bimfit.bim.selection import Selection

Progress = Callable[[str, float], None]
LEAST = 3


def teach(
    model_path: Path,
    scan_path: Path,
    config: Config,
    *,
    joints: Selection | Sequence[str] = (),
    placing: Placing | None = None,
    slices: int | None = None,
    progress: Progress = lambda step, share: None,
) -> TaughtProfile:
    """Teach the profile of the one joint that is asked for, or that the scan shows most of.

    Parameters
    ----------
    slices : int, optional
        How many stations to learn from, evenly along the joint; all unless told.

    Raises
    ------
    BimfitError
        For a model, scan or joint that cannot be used, or of which too little is seen.
    """
    progress("reading the model", 0.0)
    model, found = model_joints(model_path, config.joints, joints)
    progress("reading the scan", 0.0)
    placed = place_scan(scan_path, model, found, config, placing or Placing(None))
    chosen = covered_joints(found, placed.nearby, config, asked=by_name(joints))
    if not chosen:
        raise ScanError("the scan does not show the joint", file=scan_path, remedy="name one with --joint")
    if len(chosen) > 1:
        names = ", ".join(joint.id for joint in chosen[:6])
        raise JointError(
            f"the scan shows {len(chosen)} joints ({names}), and one can be taught at a time",
            remedy="name it with --joint ID",
        )
    facing, sections, cuts = cut_joint(model, chosen[0], part_of(placed.nearby, chosen[0], config), config)
    kept = spread(len(sections), slices)
    profile = taught([sections[k] for k in kept], [cuts[k] for k in kept], config, progress)
    return profile.from_source(scan=scan_path.name, model=model_path.name, joint=facing.id)


def taught(
    sections: Sequence[JointSection],
    slices: Sequence[Slice],
    config: Config,
    progress: Progress = lambda step, share: None,
    *,
    as_found: bool = False,
) -> TaughtProfile:
    """The taught profile, how many slices went into it and whether they agree.

    The design only has to be near enough for the poses to be found; the stations' verdicts on its shape do
    not count, for the shape is what is taught. Points without beams are looked at from where their sensor
    stood, or must have stood.

    Parameters
    ----------
    as_found : bool
        Whether the components stand to one another as they do on average, and not as in ``sections``.

    Raises
    ------
    ScanError
        Where fewer than three slices show both components.
    """
    estimates = _fitted(sections, slices, config, progress)
    good = [k for k, e in enumerate(estimates) if all(c.pose is not None for c in e.components)]
    if len(good) < LEAST:
        raise ScanError(
            f"only {len(good)} of {len(sections)} slices show both components, {LEAST} are needed",
            remedy="give more slices, or a design nearer to what is there",
        )
    base = sections[good[len(good) // 2]]
    noise = estimate_noise([estimates[k] for k in good], config.sensor)
    sensor = noise.sensor if config.sensor.adapt else config.sensor
    seen = [with_beams(slices[k]) for k in good]
    section = taught_section(base, seen, [estimates[k] for k in good], sensor.pooled().sigma)
    own = [dataclasses.replace(sections[k], components=section.components, gap=section.gap) for k in good]
    again = _fitted(own, [slices[k] for k in good], config, progress)
    said = disagreement(again, own, noise.correlation)
    found = {"slices": len(good), **({"disagreement": said} if said else {})}
    if as_found:
        section = standing(section, again)
    return TaughtProfile(section.components, section.gap, found)


def standing(section: JointSection, estimates: Sequence[StationEstimate]) -> JointSection:
    """The section with each component where it stands in the middle of all stations (medians)."""
    profiles, sides = list(section.components), [section.gap.side_a, section.gap.side_b]
    for which in (0, 1):
        poses = [c.pose for e in estimates if (c := e.components[which]).pose is not None]
        if not poses:
            continue
        corner = sides[which][0]
        moved = np.array([[*(pose.apply(corner) - corner), pose.theta] for pose in poses])
        there = Pose2D.about(corner, *np.median(moved, axis=0).tolist())
        profiles[which] = profiles[which].moved(there)
        sides[which] = there.apply(sides[which])
    return dataclasses.replace(
        section, components=(profiles[0], profiles[1]), gap=GapOutline(sides[0], sides[1])
    )


def _fitted(
    sections: Sequence[JointSection], slices: Sequence[Slice], config: Config, progress: Progress
) -> list[StationEstimate]:
    """Every slice fitted with its section."""
    out: list[StationEstimate] = []
    targets = prepare(sections, slices, TargetCache(config))
    for k, (section, cut, target) in enumerate(zip(sections, slices, targets, strict=True)):
        progress("fitting the slices", k / len(sections))
        estimate = fit_station(section, cut, target, config).estimate
        assert estimate is not None
        out.append(estimate)
    return out


def with_beams(slice_: Slice) -> Slice:
    """A slice with beams: its own, or such as its points must have come by."""
    if (slice_.beams is not None and len(slice_.beams.ranges)) or not len(slice_.points):
        return slice_
    return dataclasses.replace(slice_, beams=virtual_beams(slice_, Pose2D()).beams)


def spread(count: int, wanted: int | None) -> list[int]:
    """``wanted`` of ``count`` stations, evenly spread."""
    if wanted is None or wanted >= count:
        return list(range(count))
    return sorted({int(k) for k in np.linspace(0, count - 1, wanted).round()})
