"""compare(): the same slices through every method."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bimfit.config import Config
from bimfit.errors import ConfigError, ScanError
from bimfit.files import protect_inputs, write_text
from bimfit.gap.section import gap_section
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Slice
from bimfit.pipeline.accuracy import gap_estimate, joint_errors
from bimfit.pipeline.fit import check_choice, fit_joint
from bimfit.pipeline.fit import methods as known_methods
from bimfit.pipeline.placing import Placing
from bimfit.pipeline.records import JointResult
from bimfit.pipeline.results import to_json
from bimfit.report.tables import MethodOutcome, plot_comparison
from bimfit.simulation.accuracy import gap_errors, truth_for
from bimfit.simulation.truth import JointTruth, read_truth

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint
    from bimfit.bim.selection import Selection

DEFAULT_METHODS = ("grcsm", "search", "paper", "mrcsm", "icp-point", "icp-plane")
LOST = 0.010
STARTS = (-1.0, 0.005, 0.015, 0.030, np.inf)
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class MethodResult:
    """One method on a set of slices.

    Attributes
    ----------
    method : str
    errors : ndarray, shape (n,)
        Position errors of the gap's origin, m, against the truth, or else against the first method;
        NaN where the method gave no pose.
    angles : ndarray, shape (n,)
        Signed angle errors, rad.
    seconds : ndarray, shape (n,)
        Wall time a slice.
    evaluations : ndarray, shape (n,)
        Of the combined search; 0 where a method has none.
    initial : ndarray, shape (n,)
        How far the designed pose, which every method starts from, was off, m; NaN where nobody knows.
    """

    method: str
    errors: Array
    angles: Array
    seconds: Array
    evaluations: Array
    initial: Array

    def summary(self) -> dict[str, Any]:
        """The figures of the table."""
        found = np.isfinite(self.errors)
        known = self.errors[found]
        angles = np.degrees(np.abs(self.angles[np.isfinite(self.angles)]))
        return {
            "method": self.method,
            "slices": len(self.errors),
            "no_pose": int((~found).sum()),
            "over_10_mm": int((known > LOST).sum()),
            "mean_mm": float(known.mean() * 1e3) if len(known) else float("nan"),
            "median_mm": float(np.median(known) * 1e3) if len(known) else float("nan"),
            "max_mm": float(known.max() * 1e3) if len(known) else float("nan"),
            "mean_angle_deg": float(angles.mean()) if len(angles) else float("nan"),
            "median_ms": float(np.median(self.seconds) * 1e3),
            "p95_ms": float(np.percentile(self.seconds, 95) * 1e3),
            "median_evaluations": float(np.median(self.evaluations)),
        }

    def by_start(self) -> tuple[dict[str, Any], ...]:
        """Share of slices lost or over 10 mm off, by how far the designed pose was off."""
        lost = ~(self.errors <= LOST)
        rows = []
        for low, high in pairwise(STARTS):
            here = (self.initial > low) & (self.initial <= high)
            count = int(here.sum())
            rows.append(
                {
                    "over_mm": low * 1e3, "to_mm": high * 1e3, "slices": count,
                    "lost_share": float(lost[here].mean()) if count else float("nan"),
                    "median_ms": float(np.median(self.seconds[here]) * 1e3) if count else float("nan"),
                }
            )  # fmt: skip
        return tuple(rows)


@dataclass(frozen=True)
class Comparison:
    """All methods on the same slices.

    Attributes
    ----------
    methods : tuple of MethodResult
    reference : str
        What errors are measured against.
    """

    methods: tuple[MethodResult, ...]
    reference: str
    inputs: tuple[Path, ...] = ()


def compare(
    model_path: Path,
    scan_path: Path,
    config: Config,
    *,
    methods: Sequence[str] = DEFAULT_METHODS,
    truth: Path | None = None,
    joints: Selection | Sequence[str] = (),
    scan_pose: Array | None = None,
    placing: Placing | None = None,
    progress: Progress = lambda step, share: None,
) -> Comparison:
    """Fit the joints that a scan shows with every method.

    Raises
    ------
    BimfitError
        For an input that cannot be used, or a method that does not exist.
    """
    from bimfit.bim.selection import Selection
    from bimfit.pipeline.survey import cut_joint, model_joints, part_of, shown_joints

    check_methods(methods)
    truths = read_truth(truth) if truth is not None else ()
    wanted = joints if isinstance(joints, Selection) else Selection(names=tuple(joints))
    if truths and not wanted.named:
        wanted = dataclasses.replace(wanted, names=tuple(",".join(one.elements) for one in truths))
    model, found = model_joints(model_path, config.joints, wanted)
    placed, shown = shown_joints(scan_path, model, found, config, placing or Placing(scan_pose), wanted.named)
    cuts = [cut_joint(model, joint, part_of(placed.nearby, joint, config), config) for joint in shown]
    cuts = [cut for cut in cuts if cut[1]]
    if not cuts:
        raise ScanError(
            "the scan shows none of the joints", file=scan_path, remedy="check its units and frame"
        )
    results = run_methods(cuts, config, methods, truths, progress)
    inputs = tuple(path for path in (model_path, scan_path, truth, wanted.pairs) if path is not None)
    return Comparison(results, "truth" if truths else methods[0], inputs)


Cut = tuple["Joint", tuple[JointSection, ...], tuple[Slice, ...]]


def run_methods(
    cuts: Sequence[Cut],
    config: Config,
    methods: Sequence[str],
    truths: Sequence[JointTruth] = (),
    progress: Progress = lambda step, share: None,
) -> tuple[MethodResult, ...]:
    """Fit joints that are already cut with every method, one slice after the other."""
    fitted: dict[str, list[JointResult]] = {}
    for method in methods:
        fitted[method] = [
            fit_joint(
                joint, sections, slices, config, method=method, motion="independent", threads=1,
                progress=lambda share, method=method: progress(method, share),  # type: ignore[misc]
            )
            for joint, sections, slices in cuts
        ]  # fmt: skip
    first = fitted[methods[0]]
    return tuple(_method_result(method, results, first, truths) for method, results in fitted.items())


def _method_result(
    method: str, results: Sequence[JointResult], first: Sequence[JointResult], truths: Sequence[JointTruth]
) -> MethodResult:
    errors, angles, initial = [], [], []
    for result, reference in zip(results, first, strict=True):
        truth = truth_for(result.joint.elements, truths)
        designed = [
            gap_section(s.section.s, s.section.frame, s.section.gap, Pose2D(), Pose2D())
            for s in result.stations
        ]
        if truth is not None:
            initial.append(gap_errors([gap_estimate(gap) for gap in designed], truth).position)
            against = joint_errors(result, truth)
            errors.append(against.position)
            angles.append(against.angle)
        else:
            initial.append(
                np.array(
                    [
                        np.nan if b.gap is None else float(np.hypot(*(a.origin - b.gap.origin)))
                        for a, b in zip(designed, reference.stations, strict=True)
                    ]
                )
            )
            pairs = zip(result.stations, reference.stations, strict=True)
            rows = [
                (np.nan, np.nan)
                if a.gap is None or b.gap is None
                else (float(np.hypot(*(a.gap.origin - b.gap.origin))), a.gap.angle - b.gap.angle)
                for a, b in pairs
            ]
            errors.append(np.array([row[0] for row in rows]))
            angles.append(np.array([row[1] for row in rows]))
    stations = [station for result in results for station in result.stations]
    evaluations = [0 if s.combined is None else s.combined.evaluations for s in stations]
    return MethodResult(
        method,
        np.concatenate(errors),
        np.concatenate(angles),
        np.array([station.seconds for station in stations]),
        np.array(evaluations, float),
        np.concatenate(initial),
    )


def check_methods(methods: Sequence[str]) -> None:
    """Refuse methods that do not exist.

    Raises
    ------
    ConfigError
        Naming those that do.
    """
    if not methods:
        raise ConfigError("no method named", remedy=f"choose from {', '.join(known_methods())}")
    for method in methods:
        check_choice(method)


def comparison_table(comparison: Comparison) -> str:
    """The comparison as text."""
    head = (
        f"{'method':18}{'slices':>7}{'no pose':>8}{'>10 mm':>7}{'mean mm':>9}{'max mm':>8}"
        f"{'mean deg':>9}{'ms':>9}{'p95 ms':>9}{'evaluations':>13}"
    )
    lines = [head]
    for result in comparison.methods:
        f = result.summary()
        lines.append(
            f"{f['method']:18}{f['slices']:7d}{f['no_pose']:8d}{f['over_10_mm']:7d}{f['mean_mm']:9.3f}"
            f"{f['max_mm']:8.2f}{f['mean_angle_deg']:9.2f}{f['median_ms']:9.2f}{f['p95_ms']:9.2f}"
            f"{f['median_evaluations']:13.0f}"
        )
    lines += _by_start(comparison.methods)
    return "\n".join(
        [*lines, f"errors of the gap's origin against the {comparison.reference}; times a slice, one thread"]
    )


def _by_start(methods: Sequence[MethodResult]) -> list[str]:
    """Shares lost or over 10 mm off, a column for each size of the designed pose's error."""
    used = [k for k, row in enumerate(methods[0].by_start()) if row["slices"]]
    head = f"{'lost or >10 mm, designed pose off by':38}"
    lines = []
    for result in methods:
        rows = [result.by_start()[k] for k in used]
        shares = "".join(f"{100.0 * row['lost_share']:15.1f}%" for row in rows)
        lines.append(f"{result.method:38}{shares}")
        sizes = [f"{max(row['over_mm'], 0.0):g}..{row['to_mm']:g} mm ({row['slices']})" for row in rows]
    return [head + "".join(f"{size:>16}" for size in sizes), *lines] if used else []


def write_comparison(comparison: Comparison, folder: Path) -> tuple[Path, ...]:
    """Write compare.csv, compare.json and compare.png.

    Raises
    ------
    ExportError
        When the folder cannot be written.
    """
    paths = tuple(folder / name for name in ("compare.csv", "compare.json", "compare.png"))
    protect_inputs(paths, comparison.inputs)
    rows = [result.summary() for result in comparison.methods]
    starts = {result.method: result.by_start() for result in comparison.methods}
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(paths[0], text.getvalue())
    slices: Mapping[str, Any] = {
        result.method: {"error": result.errors, "angle": result.angles, "seconds": result.seconds}
        for result in comparison.methods
    }
    write_text(
        paths[1],
        to_json(
            {
                "schema": 1,
                "reference": comparison.reference,
                "methods": rows,
                "by_start": starts,
                "slices": slices,
            }
        ),
    )
    plot_comparison(
        paths[2], {r.method: MethodOutcome(r.errors, r.seconds) for r in comparison.methods}, lost=LOST
    )
    return paths
