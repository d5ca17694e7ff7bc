"""teach_line(): a joint's profile from a scan alone, along a line that the user gives."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bimfit.config import Config
from bimfit.errors import ConfigError, ScanError
from bimfit.estimation.guess import guessed_section
from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.joint_section import GapOutline, JointSection
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.path import JointPath
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Slice
from bimfit.pipeline.placing import Placing
from bimfit.pipeline.profile_file import TaughtProfile
from bimfit.pipeline.scan_file import Scan, load_scan
from bimfit.pipeline.targets import match_reach, with_assumed_view, with_recovered_view
from bimfit.pipeline.teach import LEAST, Progress, spread, taught, with_beams
from bimfit.scan.coverage import scan_stations
from bimfit.scan.slicing import cut_slices

DEPTH = 0.020
"""Depth of a side of the gap that no beam sees, m, unless told."""
_ROUNDS = 2
_TRIES = 7


@dataclass(frozen=True)
class JointLine:
    """Where a joint runs, in the scan's coordinates.

    Attributes
    ----------
    start, end : tuple of 3 float
        Ends of a line along the gap, about at its mouth, m.
    out : tuple of 3 float or None
        About the direction out of the mouth; None: towards the sensor.
    depth : float or None
        How deep the gap is where no beam sees it, m.
    """

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    out: tuple[float, float, float] | None = None
    depth: float | None = None


def teach_line(
    scan_path: Path,
    line: JointLine,
    config: Config,
    *,
    placing: Placing | None = None,
    slices: int | None = None,
    progress: Progress = lambda step, share: None,
) -> TaughtProfile:
    """Teach the profile of the joint that runs along a line; no model is needed.

    The first guess is what one slice shows; all slices are fitted with it, then with what they teach.

    Raises
    ------
    BimfitError
        For a scan or a line that cannot be used, or where too little is seen.
    """
    progress("reading the scan", 0.0)
    where = placing or Placing()
    scan = load_scan(scan_path, where.options)
    if where.pose is not None:
        scan = scan.transformed(where.pose)
    frames, cuts = cut_line(scan, line, config)
    kept = spread(len(cuts), slices)
    profile = taught_along([frames[k] for k in kept], [cuts[k] for k in kept], line, config, progress)
    said = {"line": [*line.start, *line.end]}
    return profile.from_source(scan=scan_path.name, joint="along the line that was given", **said)


def cut_line(scan: Scan, line: JointLine, config: Config) -> tuple[list[SectionFrame], list[Slice]]:
    """Frames across the line, and a slice for each that shows anything.

    Raises
    ------
    ConfigError
        For a line without length, or along which no direction out of the mouth is known.
    ScanError
        Where the scan shows fewer than three slices along it.
    """
    a, b = np.array(line.start, float), np.array(line.end, float)
    n = b - a
    size = float(np.linalg.norm(n))
    if not size > 1e-6:
        raise ConfigError("the line has no length", remedy="give two points apart: --line X,Y,Z,X,Y,Z")
    out = _out(scan, line, 0.5 * (a + b))
    across = np.cross(out, n / size)
    if not float(np.linalg.norm(across)) > 0.05 * float(np.linalg.norm(out)):
        raise ConfigError("the direction out of the mouth runs along the line", remedy="give another --out")
    path = JointPath.straight(a, b, across)
    stations = scan_stations(scan, path, config.slices.spacing)
    frames = [path.rough_frame(float(s)) for s in stations]
    cuts = cut_slices(scan, frames, stations, thickness=config.slices.thickness, reach=match_reach(config))
    if not isinstance(scan, LineScan) and scan.viewpoint is None:
        cuts = with_recovered_view(cuts)
    shown = [k for k, cut in enumerate(cuts) if len(cut.points) >= config.fit.min_points]
    if len(shown) < LEAST:
        raise ScanError(
            f"the scan shows {len(shown)} slices along the line, {LEAST} are needed",
            remedy="check the line and its unit, or give --spacing",
        )
    return [frames[k] for k in shown], [cuts[k] for k in shown]


def _out(scan: Scan, line: JointLine, middle: Array) -> Array:
    if line.out is not None:
        return np.array(line.out, float)
    eye = scan.origins.mean(axis=0) if isinstance(scan, LineScan) else scan.viewpoint
    if eye is None:
        raise ConfigError(
            "the scan does not say where its sensor stood",
            remedy="give the direction out of the mouth: --out X,Y,Z",
        )
    return np.asarray(eye - middle)


def taught_along(
    frames: Sequence[SectionFrame],
    cuts: Sequence[Slice],
    line: JointLine,
    config: Config,
    progress: Progress = lambda step, share: None,
) -> TaughtProfile:
    """The profile that these slices teach, its origin midway between its mouth corners.

    Raises
    ------
    ScanError
        Where no slice gives a first guess, or too few show both components.
    """
    guess = _guess(frames, cuts, line, config)
    notes: Mapping[str, Any] = {}
    for _ in range(_ROUNDS):
        middle = _middle(guess)
        guess = _shifted(guess, -middle)
        cuts = [_shifted_slice(cut, -middle) for cut in cuts]
        sections = [
            dataclasses.replace(guess, s=cut.s, frame=frame) for frame, cut in zip(frames, cuts, strict=True)
        ]
        seen = [with_assumed_view(cut, section) for cut, section in zip(cuts, sections, strict=True)]
        profile = taught(sections, seen, config, progress, as_found=True)
        guess, notes = (
            dataclasses.replace(guess, components=profile.components, gap=profile.gap),
            profile.taught,
        )
    guess = _shifted(guess, -_middle(guess))
    return TaughtProfile(guess.components, guess.gap, notes)


def _guess(
    frames: Sequence[SectionFrame], cuts: Sequence[Slice], line: JointLine, config: Config
) -> JointSection:
    """What the first slice shows, from the middle outwards, that shows both components."""
    depth = DEPTH if line.depth is None else line.depth
    order = sorted(range(len(cuts)), key=lambda k: abs(k - len(cuts) // 2))
    failed: ScanError | None = None
    for k in order[:_TRIES]:
        beams = with_beams(cuts[k]).beams
        assert beams is not None
        try:
            return guessed_section(cuts[k].s, frames[k], beams, config.sensor.sigma, depth)
        except ScanError as error:
            failed = failed or error
    assert failed is not None
    raise failed


def _middle(section: JointSection) -> Array:
    a, b = section.gap.mouth
    return np.asarray(0.5 * (a + b))


def _shifted(section: JointSection, by: Array) -> JointSection:
    """A section in a frame whose origin is elsewhere."""
    a, b = (profile.moved(Pose2D(*by.tolist())) for profile in section.components)
    gap = GapOutline(section.gap.side_a + by, section.gap.side_b + by)
    return dataclasses.replace(section, components=(a, b), gap=gap)


def _shifted_slice(cut: Slice, by: Array) -> Slice:
    beams = cut.beams
    if beams is not None:
        beams = dataclasses.replace(beams, origins=beams.origins + by)
    eye = None if cut.viewpoint is None else cut.viewpoint + by
    return dataclasses.replace(cut, points=cut.points + by, beams=beams, viewpoint=eye)
