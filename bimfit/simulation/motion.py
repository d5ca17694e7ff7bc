"""Draw how the two components of a joint have moved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.simulation.scenario import OwnRanges, Scenario, own_ranges
from bimfit.simulation.truth import JointTruth, StationTruth, gap_truth

_MOTION_STREAM = 0


def random_truth(
    sections: Sequence[JointSection],
    scenario: Scenario,
    seed: int,
    *,
    joint_id: str = "joint",
    elements: tuple[str, str] = ("A", "B"),
    kind: str = "",
) -> JointTruth:
    """Draw the motion of a joint's components at every station (METHOD, section 1).

    Common motion turns about the section's origin; each component's own motion turns about its own mouth
    corner and comes first: full = common @ own.

    Parameters
    ----------
    sections : sequence of JointSection
        The stations, in order along the joint.
    scenario : Scenario
        Ranges; what a component moves by itself is scaled to the gap (:func:`~.scenario.own_ranges`).
    seed : int
        The same seed gives the same motion, whatever the sensor's settings.
    joint_id, elements, kind
        Carried into the truth.

    Raises
    ------
    ValueError
        Without a section.
    """
    if not sections:
        raise ValueError("a joint needs at least one section")
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_MOTION_STREAM,)))
    s = np.array([section.s for section in sections])
    least = min(_narrowest(section) for section in sections)
    lever = max(_lever(section) for section in sections)
    ranges = own_ranges(scenario, least, lever)
    motions = _draw(rng, scenario, ranges, s)
    stations = []
    for section, row in zip(sections, motions.tolist(), strict=True):
        common = Pose2D.from_array(row[0:3])
        poses = (
            common @ Pose2D.about(section.gap.mouth[0], *row[3:6]),
            common @ Pose2D.about(section.gap.mouth[1], *row[6:9]),
        )
        stations.append(StationTruth(section.s, section.frame, common, poses, gap_truth(section, *poses)))
    widths = [np.linalg.norm(section.gap.mouth[1] - section.gap.mouth[0]) for section in sections]
    return JointTruth(
        joint_id, elements, kind, float(np.median(widths)), float(s[-1] - s[0]), tuple(stations), seed
    )


def _draw(rng: np.random.Generator, scenario: Scenario, own: OwnRanges, s: Array) -> Array:
    """Parameters a station (k, 9): common, A by itself, B by itself; u, v, theta each."""
    cu, cv = scenario.common_shift
    high = np.array(
        [cu, cv, scenario.common_angle]
        + 2 * [own.closing, own.shift_v, own.angle]  # A closes the gap along +u, B along -u
    )
    low = -high
    low[3], high[6] = -own.opening, own.opening

    count = len(s)
    along = (s - s[0]) / (s[-1] - s[0]) if count > 1 and s[-1] > s[0] else np.zeros(count)
    if scenario.motion == "none":
        return np.zeros((count, 9))
    if scenario.motion == "piecewise":
        inner = min(scenario.transitions, count) - 2
        knots = np.arange(count)
        if inner >= 0:
            knots = np.sort(np.r_[0, rng.choice(np.arange(1, count - 1), inner, replace=False), count - 1])
        values = rng.uniform(low, high, (len(knots), 9))
        return np.stack([np.interp(s, s[knots], values[:, k]) for k in range(9)], axis=1)
    if scenario.motion == "bent":
        # each component stays within its own range: half for the drift, half for the bow
        ends = rng.uniform(0.5 * low, 0.5 * high, (2, 9))
        rise = rng.uniform(0.5 * low, 0.5 * high)
        rise[:3] = *rng.uniform(-scenario.bow, scenario.bow, 2), 0.0
        shape = 4.0 * along * (1.0 - along)
        return _between(ends, along) + shape[:, None] * rise
    ends = rng.uniform(low, high, (2, 9))
    if scenario.motion == "const":
        ends[1] = ends[0]
    elif scenario.motion == "rigid":
        ends[1, 2::3] = ends[0, 2::3]
    return _between(ends, along)


def _between(ends: Array, along: Array) -> Array:
    return np.asarray(ends[0] + along[:, None] * (ends[1] - ends[0]))


def _narrowest(section: JointSection) -> float:
    import shapely

    a, b = (shapely.linestrings(side) for side in (section.gap.side_a, section.gap.side_b))
    return float(shapely.distance(a, b))


def _lever(section: JointSection) -> float:
    sides = (section.gap.side_a, section.gap.side_b)
    return float(max(np.linalg.norm(side - side[0], axis=1).max() for side in sides))
