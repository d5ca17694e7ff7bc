"""A model and a scan in, every joint that the scan shows out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bimfit.bim.stations import HasElements, HasMesh, design_sections
from bimfit.config import Config
from bimfit.errors import ScanError
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.geometry.slice import Slice
from bimfit.pipeline.fit import check_choice, fit_joint
from bimfit.pipeline.listing import model_joints as model_joints
from bimfit.pipeline.mouth import mouth_paths as mouth_paths
from bimfit.pipeline.mouth import spine_stations
from bimfit.pipeline.placing import NEAR, Placed, Placing, joint_boxes, place_scan
from bimfit.pipeline.profile_file import TaughtProfile
from bimfit.pipeline.records import JointResult, SurveyResult
from bimfit.pipeline.shown import LOOKS, fitted_shown, fully_shown, left_out, surface_shown
from bimfit.pipeline.targets import match_reach, profile_reach, with_assumed_view, with_recovered_view
from bimfit.scan.cloud import PointCloud
from bimfit.scan.coverage import covers, scan_stations, slice_thickness
from bimfit.scan.nearby import Nearby
from bimfit.scan.slicing import cut_slices

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint
    from bimfit.bim.model import Model
    from bimfit.bim.selection import Selection

Scan = LineScan | PointCloud
LEAST_COVER = 0.3
"""A joint that was not asked for by name is fitted where the scan shows at least this share of it."""
Progress = Callable[[str, float], None]


def silent(_step: str, _share: float) -> None:
    """Report no progress."""


def survey(
    model_path: Path,
    scan_path: Path,
    config: Config,
    *,
    joints: Selection | Sequence[str] = (),
    method: str = "grcsm",
    motion: str = "auto",
    scan_pose: Array | None = None,
    placing: Placing | None = None,
    profile: TaughtProfile | None = None,
    progress: Progress = silent,
) -> SurveyResult:
    """Fit every joint that is asked for, or every joint that the scan shows.

    Parameters
    ----------
    model_path, scan_path : Path
    config : Config
    joints : Selection, or sequence of str
        Ids or ``GUID,GUID``; empty takes all that the scan covers. Of a selection that names no joint, too,
        those that the scan covers.
    method : str
        A name of :data:`bimfit.registration.matchers.MATCHERS`.
    motion : str
        Motion model along the joint.
    scan_pose : ndarray, shape (4, 4), optional
        T_world_scanner of a scan in scanner coordinates; short for ``Placing(pose=...)``.
    placing : Placing, optional
        How the scan is read and where it lies.
    profile : TaughtProfile, optional
        Taught by :func:`bimfit.pipeline.teach.teach`; it takes the place of the designed cross-sections.
    progress : callable
        Told (step, share done).

    Raises
    ------
    BimfitError
        For a model, scan or joint that cannot be used.
    """
    check_choice(method, motion)
    progress("reading the model", 0.0)
    model, found = model_joints(model_path, config.joints, joints)
    progress("reading the scan", 0.0)
    asked = by_name(joints)
    placed, chosen = shown_joints(scan_path, model, found, config, placing or Placing(scan_pose), asked)
    results: list[JointResult] = []
    progress("cutting the joints", 0.0)
    cuts = [cut_joint(model, joint, part_of(placed.nearby, joint, config), config) for joint in chosen]
    cuts, partly = (cuts, []) if asked else fully_shown(cuts, config)
    if profile is not None:
        cuts = [(facing, profile.applied(sections), slices) for facing, sections, slices in cuts]
    for k, (facing, sections, slices) in enumerate(cuts):
        step = f"joint {facing.id} ({k + 1} of {len(cuts)})"
        results.append(
            fit_joint(
                facing,
                sections,
                slices,
                config,
                method=method,
                motion=motion,
                progress=partial(progress, step),
            )
        )
    if not asked:
        results, unseen = fitted_shown(results)
        partly = [*partly, *unseen]
    said = (*model.notes, *model.left_out(most=3), *placed.notes)
    notes = (*said, *left_out(partly))
    return SurveyResult(
        model_path, scan_path, model, placed.nearby.scan, config, tuple(results), notes, placed
    )


def shown_joints(
    path: Path, model: Model, joints: Sequence[Joint], config: Config, placing: Placing, asked: bool
) -> tuple[Placed, list[Joint]]:
    """A scan in its place, aligned where that is wanted, and the joints that it shows.

    Raises
    ------
    ScanError
        When it shows none, or cannot be aligned safely.
    """
    margin = 0.0
    if placing.align is not None:
        from bimfit.pipeline.aligning import aligned, reach_of

        margin = (
            reach_of(placing.align, joints) if asked else max(reach_of(placing.align, [j]) for j in joints)
        )
    placed = place_scan(path, model, joints, config, placing, margin)
    chosen = covered_joints(joints, placed.nearby, config, asked=asked, margin=margin)
    if chosen and placing.align is not None:
        placed = aligned(placed, model, chosen, config, placing.align)
        chosen = covered_joints(chosen, placed.nearby, config, asked=asked)
    if not chosen:
        raise shows_none(path, joints, placed, config, asked)
    return placed, chosen


def shows_none(path: Path, joints: Sequence[Joint], placed: Placed, config: Config, asked: bool) -> ScanError:
    """Why a scan that has returns near joints shows none of them, and what would help."""
    shown = {joint.id: _cover(placed.nearby, joint, config) for joint in joints}
    best = max(shown, key=lambda name: shown[name])
    if not asked and shown[best] > 0.0:
        return ScanError(
            f"the scan shows no joint as a whole: most of joint {best}, of which it shows"
            f" {100.0 * shown[best]:.0f} % ({100.0 * LEAST_COVER:.0f} % are wanted)",
            file=path,
            remedy=f"--joint {best} fits what there is of it; else check the scan's units and frame",
        )
    return ScanError(
        f"the scan does not show {'the joint that was asked for' if asked else 'any joint'}",
        file=path,
        remedy="check its units and its frame; --scan-pose places a scan that is in scanner coordinates",
    )


def _cover(scan: Scan | Nearby, joint: Joint, config: Config, margin: float = 0.0) -> float:
    """Share of a joint, 0 to 1, that the scan shows from the side from which it shows more."""
    part = part_of(scan, joint, config, margin)
    return max(covers(part, path, NEAR + margin) for path in mouth_paths(joint))


def by_name(joints: Selection | Sequence[str]) -> bool:
    """Whether joints are asked for one by one."""
    return bool(joints) if isinstance(joints, Sequence) else joints.named


def covered_joints(
    joints: Sequence[Joint], scan: Scan | Nearby, config: Config, *, asked: bool, margin: float = 0.0
) -> list[Joint]:
    """Joints that the scan shows: any of their length where they were asked for, else a good part of it.

    ``margin`` (m) is by how much the scan may still be off.
    """
    least = 0.0 if asked else LEAST_COVER
    return [joint for joint in joints if _cover(scan, joint, config, margin) > least]


def part_of(scan: Scan | Nearby, joint: Joint, config: Config, margin: float = 0.0) -> Scan:
    """What of a scan matters to a joint."""
    return scan.around(joint_boxes(joint, config, margin)) if isinstance(scan, Nearby) else scan


def cut_joint(
    elements: HasElements | Mapping[str, HasMesh], joint: Joint, scan: Scan, config: Config
) -> tuple[Joint, tuple[JointSection, ...], tuple[Slice, ...]]:
    """Cut design and scan at the same stations, the joint's mouth towards the sensor.

    Returns
    -------
    tuple
        The joint as seen, its designed sections, and a slice for each.
    """
    eye = viewpoint_of(scan, joint)
    joint = seen_side(elements, joint, scan, config) if eye is None else joint.facing(eye)
    mouth = mouth_paths(joint)[0]
    along = scan_stations(scan, mouth, config.slices.spacing)
    sections, slices = _cut_at(elements, joint, scan, config, along)
    if eye is None:
        slices = with_recovered_view(slices)
    viewed = [with_assumed_view(cut, section) for cut, section in zip(slices, sections, strict=True)]
    return joint, tuple(sections), tuple(viewed)


def seen_side(
    elements: HasElements | Mapping[str, HasMesh], joint: Joint, scan: Scan, config: Config
) -> Joint:
    """The joint with its mouth on the side whose surface the points lie on, where both are free.

    For a cloud that does not know its sensor. Points on both sides: the mouth stays where more of them are.
    """
    if not joint.two_sided:
        return joint
    shown = []
    for facing in (joint, joint.turned()):
        along = scan_stations(scan, mouth_paths(facing)[0], config.slices.spacing)
        picked = along[np.unique(np.linspace(0, len(along) - 1, min(LOOKS, len(along))).astype(int))]
        shown.append((surface_shown(*_cut_at(elements, facing, scan, config, picked), config), facing))
    return max(shown, key=lambda pair: pair[0])[1]


def _cut_at(
    elements: HasElements | Mapping[str, HasMesh], joint: Joint, scan: Scan, config: Config, along: Array
) -> tuple[Sequence[JointSection], Sequence[Slice]]:
    """Design and scan at places along a joint's mouth (k,); a few have no section plane."""
    mouth = mouth_paths(joint)[0]
    stations = spine_stations(joint.path, mouth, along)
    sections = design_sections(elements, joint, stations, profile_reach(config)) if len(stations) else ()
    if not sections:
        return (), ()
    thickness = config.slices.thickness or slice_thickness(scan, mouth, config.slices.spacing)
    slices = cut_slices(
        scan,
        [section.frame for section in sections],
        [section.s for section in sections],
        thickness=thickness,
        reach=match_reach(config),
    )
    return sections, slices


def viewpoint_of(scan: Scan, joint: Joint) -> Array | None:
    """Where the sensor was while it saw the joint, in world coordinates; None when the scan does not say."""
    if isinstance(scan, PointCloud):
        return scan.viewpoint
    ends = scan.origins + scan.directions * scan.ranges[:, None]
    for path in sorted(mouth_paths(joint), key=lambda path: -covers(scan, path, NEAR)):
        low, high = path.points.min(axis=0) - NEAR, path.points.max(axis=0) + NEAR
        near = ((ends >= low) & (ends <= high)).all(axis=1)
        if near.any():
            return np.asarray(scan.origins[near].mean(axis=0))
    return None
