"""How near the fits of simulated joints come to their truth, in the form of the paper's Table 1."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bimfit.gap.section import GapSection
from bimfit.pipeline.records import JointResult
from bimfit.simulation.accuracy import (
    PAPER_SECONDS_A_SLICE,
    PAPER_TABLE_1,
    GapErrors,
    GapEstimate,
    TableRow,
    accuracy_table,
    gap_errors,
)
from bimfit.simulation.truth import JointTruth


def gap_estimate(gap: GapSection | None) -> GapEstimate | None:
    """What is compared with the truth at one station."""
    if gap is None:
        return None
    return GapEstimate(gap.frame, gap.origin_world, gap.angle, gap.area, gap.width_mouth)


def joint_errors(joint: JointResult, truth: JointTruth) -> GapErrors:
    """Errors at all stations of a joint, NaN where there is no estimate."""
    return gap_errors([gap_estimate(station.gap) for station in joint.stations], truth)


def table_text(rows: Sequence[TableRow], title: str = "bimfit") -> str:
    """The table beside the paper's, as text."""
    lines = [f"{'absolute gap pose error':26}{title:^36}  {'paper, Table 1':^32}"]
    heads = "".join(f"{name:>9}" for name in ("min", "max", "mean", "std"))
    lines.append(f"{'':26}{heads}  {heads[4:]}")
    for ours, theirs in zip(rows, PAPER_TABLE_1, strict=True):
        mine = "".join(f"{value:9.3f}" for value in (ours.min, ours.max, ours.mean, ours.std))
        papers = "".join(f"{value:8.1f}" for value in (theirs.min, theirs.max, theirs.mean, theirs.std))
        lines.append(f"{f'{ours.name} ({ours.unit})':26}{mine}  {papers}")
    return "\n".join(lines)


def time_text(joints: Sequence[JointResult]) -> str:
    """Time a slice, beside the paper's."""
    seconds = np.array([station.seconds for joint in joints for station in joint.stations])
    whole = sum(joint.seconds for joint in joints) / max(len(seconds), 1)
    return (
        f"time a slice: {np.median(seconds) * 1e3:.2f} ms median (both searches, slide, posterior), "
        f"{whole * 1e3:.2f} ms with everything; "
        f"the paper: {PAPER_SECONDS_A_SLICE['GRCSM'] * 1e3:.0f} ms (MATLAB)"
    )


__all__ = ["accuracy_table", "gap_estimate", "joint_errors", "table_text", "time_text"]
