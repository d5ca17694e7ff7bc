"""teach(): a joint's profile from slices of a scan, in place of the one that BIM gives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bimfit.config import Config
from bimfit.errors import JointError, ScanError
from bimfit.estimation.result import StationEstimate
from bimfit.estimation.teaching import taught_section
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.slice import Slice
from bimfit.pipeline.fit import fit_station
from bimfit.pipeline.placing import Placing, place_scan
from bimfit.pipeline.profile_file import TaughtProfile
from bimfit.pipeline.survey import by_name, covered_joints, cut_joint, model_joints, part_of, shows_none
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
        raise shows_none(scan_path, found, placed, config, by_name(joints))
    if len(chosen) > 1:
        names = ", ".join(joint.id for joint in chosen[:6])
        raise JointError(
            f"the scan shows {len(chosen)} joints ({names}), and one can be taught at a time",
            remedy="name it with --joint ID",
        )
    facing, sections, cuts = cut_joint(model, chosen[0], part_of(placed.nearby, chosen[0], config), config)
    kept = spread(len(sections), slices)
    profile, used = taught([sections[k] for k in kept], [cuts[k] for k in kept], config, progress)
    return TaughtProfile(
        profile.components,
        profile.gap,
        {"scan": scan_path.name, "model": model_path.name, "joint": facing.id, "slices": used},
    )


def taught(
    sections: Sequence[JointSection],
    slices: Sequence[Slice],
    config: Config,
    progress: Progress = lambda step, share: None,
) -> tuple[JointSection, int]:
    """The taught section, and how many slices went into it.

    The design only has to be near enough for the poses to be found; the stations' verdicts on its shape do
    not count, for the shape is what is taught.

    Raises
    ------
    ScanError
        Where fewer than three slices show both components, or slices hold no beams.
    """
    if not any(cut.beams is not None for cut in slices):
        raise ScanError("teaching needs beams, and the scan is a plain cloud", remedy="give a line scan")
    estimates: list[StationEstimate] = []
    for k, (section, cut, target) in enumerate(
        zip(sections, slices, prepare(sections, slices, TargetCache(config)), strict=True)
    ):
        progress("fitting the design", k / len(sections))
        estimate = fit_station(section, cut, target, config).estimate
        assert estimate is not None
        estimates.append(estimate)
    good = [k for k, e in enumerate(estimates) if all(c.pose is not None for c in e.components)]
    if len(good) < LEAST:
        raise ScanError(
            f"only {len(good)} of {len(sections)} slices show both components, {LEAST} are needed",
            remedy="give more slices, or a design nearer to what is there",
        )
    base = sections[good[len(good) // 2]]
    return (
        taught_section(base, [slices[k] for k in good], [estimates[k] for k in good], config.sensor.sigma),
        len(good),
    )


def spread(count: int, wanted: int | None) -> list[int]:
    """``wanted`` of ``count`` stations, evenly spread."""
    if wanted is None or wanted >= count:
        return list(range(count))
    return sorted({int(k) for k in np.linspace(0, count - 1, wanted).round()})
