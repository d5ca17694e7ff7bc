"""A virtual 2D laser rangefinder that is moved along a joint (METHOD, section 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ConfigError
from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.geometry.profile import Profile
from bimfit.simulation.aim import open_direction
from bimfit.simulation.disturbance import Disturber
from bimfit.simulation.scenario import Scenario
from bimfit.simulation.truth import JointTruth

_NOISE_STREAM = 1
_EDGE_SLACK = 1e-9
"""Rays this near to the end of an edge still meet it, so that none slips through a corner."""


@dataclass(frozen=True)
class Cast:
    """What rays meet first.

    Attributes
    ----------
    ranges : ndarray, shape (n,)
        m; inf where nothing is met.
    profile, edge : ndarray, shape (n,), int64
        Which profile and which of its edges; -1 where nothing is met.
    """

    ranges: Array
    profile: NDArray[np.int64]
    edge: NDArray[np.int64]


def cast(profiles: Sequence[Profile], origins: Array, directions: Array) -> Cast:
    """Exact first intersection of rays with the boundaries of profiles.

    Parameters
    ----------
    profiles : sequence of Profile
    origins, directions : ndarray, shape (n, 2)
        In the frame of the profiles; directions of unit length.
    """
    count = len(directions)
    edges = np.concatenate([p.edges for p in profiles]) if profiles else np.zeros((0, 2, 2))
    if not len(edges):
        nothing = np.full(count, -1, np.int64)
        return Cast(np.full(count, np.inf), nothing, nothing.copy())
    along = edges[:, 1] - edges[:, 0]
    to_start = edges[None, :, 0] - origins[:, None]
    # o + t d = a + q e, solved by crossing with e and with d
    with np.errstate(divide="ignore", invalid="ignore"):
        across = _cross(directions[:, None], along[None])
        t = _cross(to_start, along[None]) / across
        q = _cross(to_start, directions[:, None]) / across
    slack = _EDGE_SLACK / np.maximum(np.linalg.norm(along, axis=1), 1e-300)
    meets = (across != 0.0) & (t > 0.0) & (q >= -slack) & (q <= 1.0 + slack)
    t = np.where(meets, t, np.inf)
    first = np.argmin(t, axis=1)
    ranges = t[np.arange(count), first]
    met = np.isfinite(ranges)
    owner = np.repeat(np.arange(len(profiles)), [len(p.edges) for p in profiles])
    local = np.concatenate([np.arange(len(p.edges)) for p in profiles])
    return Cast(ranges, np.where(met, owner[first], -1), np.where(met, local[first], -1))


def simulate_scan(
    sections: Sequence[JointSection], truth: JointTruth, scenario: Scenario, seed: int, *, first_scan: int = 0
) -> LineScan:
    """Scan a joint as built, one sweep a section.

    The sensor is where the plan has it: ``sensor_height`` from the designed mouth, looking at it; straight
    over a butt joint, half way between the faces of a corner (:func:`aim`), wherever
    the components have really gone. Ranges get noise N(0, sigma), correlated from beam to
    beam if asked; then returns get lost, and beams return from anywhere in range instead; last comes what
    else goes wrong (:mod:`bimfit.simulation.disturbance`).

    Parameters
    ----------
    sections : sequence of JointSection
        Not clipped to less than what the sensor can reach.
    truth : JointTruth
        Made of the same sections.
    scenario : Scenario
    seed : int
        The noise is drawn from a stream of its own: the same seed in
        :func:`~bimfit.simulation.motion.random_truth` gives independent draws.
    first_scan : int
        Number of the first sweep.

    Raises
    ------
    ConfigError
        When the sensor would stand inside a component.
    ValueError
        When sections and truth differ in number.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_NOISE_STREAM,)))
    bearings = scenario.bearings
    out = aim(sections[len(sections) // 2], scenario.sensor_height) if sections else None
    eye, directions = _view(out, scenario, bearings)
    starts = np.broadcast_to(eye, directions.shape)
    origins, rays, ranges = [], [], []
    spoil = Disturber(scenario.disturbance, scenario.sigma, seed) if scenario.disturbance else None
    for section, station in zip(sections, truth.stations, strict=True):
        moved = [p.moved(pose) for p, pose in zip(section.components, station.components, strict=True)]
        if any(inside(profile, eye) for profile in moved):
            raise ConfigError(
                f"the sensor would stand inside a component at station {station.s:.3f} m of joint {truth.id}",
                remedy="choose another sensor_height",
            )
        seen = cast(moved, starts, directions)
        sweep = measured(seen.ranges, scenario, rng)
        if spoil is not None:
            copies = [p.moved(spoil.ghost) for p in moved]
            sweep = spoil.spoiled(sweep, seen, cast(copies, starts, directions).ranges)
        ranges.append(sweep)
        o, d = _to_world(section.frame, starts, directions)
        origins.append(o)
        rays.append(d)
    count = len(sections)
    return LineScan.of(
        np.repeat(np.arange(first_scan, first_scan + count), len(bearings)),
        np.concatenate(origins) if count else [],
        np.concatenate(rays) if count else [],
        np.concatenate(ranges) if count else [],
        source=f"simulated, seed {seed}",
    )


def aim(section: JointSection, reach: float) -> Array:
    """Unit direction (2,) from a joint's mouth to where the sensor is best held: it halves the open angle."""

    def ranges(origins: Array, directions: Array) -> Array:
        return cast(section.components, origins, directions).ranges

    return open_direction(section, ranges, reach)


def _view(out: Array | None, scenario: Scenario, bearings: Array) -> tuple[Array, Array]:
    """Sensor position (2,) and beam directions (n, 2) in the section, ascending in bearing."""
    outward = np.array([0.0, 1.0]) if out is None else out
    across = np.array([outward[1], -outward[0]])
    directions = np.sin(bearings)[:, None] * across - np.cos(bearings)[:, None] * outward
    return scenario.sensor_height * outward, directions


def measured(true_ranges: Array, scenario: Scenario, rng: np.random.Generator) -> Array:
    """What the sensor makes of one sweep's true ranges (n,); NaN where nothing comes back."""
    count = len(true_ranges)
    beyond = np.maximum(np.where(np.isfinite(true_ranges), true_ranges, 0.0) - scenario.sigma_beyond, 0.0)
    sigma = scenario.sigma + scenario.sigma_per_metre * beyond
    ranges = true_ranges + sigma * correlated_noise(rng, count, scenario.correlation)
    # Draws are made whether or not they are used, so that one setting does not shift another's numbers.
    lost, strayed, anywhere = rng.random(count), rng.random(count), rng.random(count)
    ranges = np.where(lost < scenario.dropouts, np.nan, ranges)
    stray = scenario.min_range + anywhere * (scenario.max_range - scenario.min_range)
    ranges = np.where(strayed < scenario.outliers, stray, ranges)
    with np.errstate(invalid="ignore"):
        seen = (ranges >= scenario.min_range) & (ranges <= scenario.max_range)
    return np.where(seen, ranges, np.nan)


def correlated_noise(rng: np.random.Generator, count: int, rho: float) -> Array:
    """Gaussian noise (count,) of variance 1 whose neighbours correlate by ``rho`` (autoregression)."""
    white = rng.standard_normal(count)
    if rho == 0.0 or not count:
        return white
    from scipy.signal import lfilter

    # the first sample already has the stationary variance, which the filter must not scale
    scale = np.sqrt(1.0 - rho * rho)
    out, _ = lfilter([scale], [1.0, -rho], white[1:], zi=np.array([rho * white[0]]))
    return np.concatenate([white[:1], out])


def inside(profile: Profile, point: Array) -> bool:
    """Whether a point (2,) lies in the material of a profile."""
    edges = profile.edges
    (x0, y0), (x1, y1) = edges[:, 0].T, edges[:, 1].T
    spans = (y0 > point[1]) != (y1 > point[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = x0 + (point[1] - y0) / (y1 - y0) * (x1 - x0)
    return bool(np.count_nonzero(spans & (crossing > point[0])) % 2)


def _to_world(frame: SectionFrame, origins: Array, directions: Array) -> tuple[Array, Array]:
    return frame.to_world(origins), frame.direction_to_world(directions)


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
