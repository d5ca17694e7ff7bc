"""Which stations of a joint belong together, and which stretch between them nobody measured."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bimfit.gap.section import GapSection

#: Without another limit, a stretch is bridged that is at most this many station spacings long.
BRIDGE_STATIONS = 4.0

Span = tuple[float, float]


@dataclass(frozen=True)
class Runs:
    """Measured sections in unbroken order.

    Attributes
    ----------
    sections : tuple of tuple of GapSection
        Each run in order along the joint; a ring that is measured all the way is one run.
    ring : bool
        Whether the only run closes on itself.
    bridged : tuple of (float, float)
        Stretches (from s to s, m) without a measurement that are interpolated.
    unmeasured : tuple of (float, float)
        Stretches without a measurement that are left out. On a ring the last may end beyond the ring's
        length.
    """

    sections: tuple[tuple[GapSection, ...], ...]
    ring: bool
    bridged: tuple[Span, ...]
    unmeasured: tuple[Span, ...]


def find_runs(
    sections: Sequence[GapSection | None], *, ring: float | None = None, max_bridge: float | None = None
) -> Runs:
    """Split a joint where too long a stretch was not measured.

    Parameters
    ----------
    sections : sequence of GapSection or None
        In order along the joint; None where a station has no estimate.
    ring : float, optional
        Length of a path that closes on itself, m: the last section is then the first one's neighbour.
    max_bridge : float, optional
        Longest distance of two measured stations that is interpolated when stations between them have no
        estimate, m; by default four times the median spacing. Neighbouring stations are never torn apart,
        however far they lie.
    """
    order = [(k, section) for k, section in enumerate(sections) if section is not None]
    if not order:
        return Runs((), False, (), ())
    steps = [(b.s - a.s, j - k) for (k, a), (j, b) in itertools.pairwise(order)]
    if ring is not None and len(order) > 1:
        (k, a), (j, b) = order[0], order[-1]
        steps.append((a.s + ring - b.s, k + len(sections) - j))
    if any(length <= 0.0 for length, _ in steps):
        raise ValueError("sections must be given in order along the joint, one a station")
    limit = max_bridge
    if limit is None:
        limit = (
            BRIDGE_STATIONS * float(np.median([length / count for length, count in steps])) if steps else 0.0
        )
    runs: list[list[GapSection]] = [[order[0][1]]]
    bridged: list[Span] = []
    unmeasured: list[Span] = []
    found = [section for _, section in order]
    for n, (here, (length, count)) in enumerate(zip(found, steps, strict=False)):
        span = (here.s, here.s + length)
        torn = count > 1 and length > limit * (1.0 + 1e-9)
        if count > 1:
            (unmeasured if torn else bridged).append(span)
        seam = n == len(found) - 1
        if torn and not seam:
            runs.append([])
        if not seam:
            runs[-1].append(found[n + 1])
        elif not torn:
            # The seam of a ring: the last run leads into the first.
            if len(runs) == 1:
                return Runs((tuple(runs[0]),), len(runs[0]) > 2, tuple(bridged), tuple(unmeasured))
            runs[0] = runs.pop() + runs[0]
    return Runs(tuple(tuple(run) for run in runs), False, tuple(bridged), tuple(unmeasured))
