"""One station: from the combined pose to both components' poses, covariances and status."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation import _kernels_inside as kernels
from bimfit.estimation import checks
from bimfit.estimation.cloud import irregular_sensor, virtual_beams
from bimfit.estimation.inside import with_inside
from bimfit.estimation.likelihood import BeamModel, BeamSet, edge_rows
from bimfit.estimation.lookalikes import gap_places, with_lookalikes
from bimfit.estimation.ownership import (
    Cost,
    Ints,
    Mask,
    Scene,
    beside_artificial_ends,
    cover_cost,
    first_round,
    meeting,
    second_round,
    split_side,
    through,
)
from bimfit.estimation.posterior import Posterior, Window, component_posterior
from bimfit.estimation.residuals import residuals_of
from bimfit.estimation.result import ComponentEstimate, Residuals, StationEstimate
from bimfit.estimation.slide import SlideResult, best_start, designed_width
from bimfit.estimation.spread import with_spread
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.profile import Profile
from bimfit.geometry.slice import Slice
from bimfit.geometry.status import Status

_FEW_THROUGH = 3
_UNKNOWN_RANGE = 1.0
_FAR_ALONG = 0.025
_GRAZING, _FAR_OUT = 0.3, 0.2
_WORTH_A_LOOK = -15.0
_LOOSE = 5.0


@dataclass(frozen=True)
class _Context:
    """What every step of one station needs."""

    section: JointSection
    beams: BeamSet
    rows: tuple[Array, Array]
    model: BeamModel
    sensor: SensorConfig
    fit: FitConfig
    virtual: bool


def estimate_station(
    section: JointSection,
    slice_: Slice,
    combined: Pose2D | None,
    sensor: SensorConfig,
    fit: FitConfig,
    *,
    component_matches: tuple[Pose2D | None, Pose2D | None] = (None, None),
    rivals: Sequence[Pose2D] = (),
) -> StationEstimate:
    """Estimate where both components are at one station, and how well that is known.

    Parameters
    ----------
    section : JointSection
        The design.
    slice_ : Slice
        What the scan shows, in the section frame.
    combined : Pose2D or None
        Motion of both components as one, from the certified search; None when it found nothing.
    component_matches : tuple of two (Pose2D or None)
        Each component's own search result: another place to start from, never more than that.
    rivals : sequence of Pose2D
        Other combined poses within the search's near-optimal set.

    Returns
    -------
    StationEstimate
        Always; what could not be measured has a status that says why and no pose.
    """
    here = _here(sensor, slice_)[0]
    finite = np.isfinite(slice_.points).all(axis=1)
    if int(finite.sum()) < fit.min_points:
        reason = f"{int(finite.sum())} returns in the slice, {fit.min_points} are needed"
        return _nothing(slice_, combined, here, Status("no_data", reason))
    if not finite.all():
        slice_ = dataclasses.replace(slice_, points=slice_.points[finite])
    if section.components[0].empty or section.components[1].empty:
        return _nothing(slice_, combined, here, Status("no_data", "the section plane misses a component"))
    if combined is None:
        return _nothing(slice_, None, here, Status("rejected", "the search found no pose of the joint"))
    try:
        best = _estimated(section, slice_, combined, sensor, fit, component_matches, rivals)
    except np.linalg.LinAlgError as error:
        reason = f"the returns do not determine a pose: {error}"
        return _nothing(slice_, combined, here, Status("rejected", reason))
    if not all(_finite(c) for c in best.components):
        reason = "the returns do not determine a pose: its figures are not finite"
        return _nothing(slice_, combined, here, Status("rejected", reason))
    return best


def _here(sensor: SensorConfig, slice_: Slice) -> tuple[SensorConfig, float]:
    """The sensor at a slice's typical range with its neighbours pooled, and that range, m (0: any)."""
    distance = typical_range(slice_) if sensor.sigma_per_metre > 0.0 else 0.0
    return sensor.at(distance).pooled(), distance


def typical_range(slice_: Slice) -> float:
    """How far the joint is from the sensor, m: the median range of a slice, or of its points from its eye."""
    ranges = np.zeros(0)
    if slice_.beams is not None:
        ranges = slice_.beams.ranges[np.isfinite(slice_.beams.ranges)]
    elif slice_.viewpoint is not None and len(slice_.points):
        ranges = np.hypot(*(slice_.points - slice_.viewpoint).T)
    return float(np.median(ranges)) if len(ranges) else _UNKNOWN_RANGE


def _finite(c: ComponentEstimate) -> bool:
    """Whether a component's figures, if it has any, are numbers."""
    if c.pose is None or c.covariance is None:
        return True
    return bool(np.isfinite(c.pose.as_array()).all() and np.isfinite(c.covariance).all())


def _estimated(
    section: JointSection,
    slice_: Slice,
    combined: Pose2D,
    sensor: SensorConfig,
    fit: FitConfig,
    component_matches: tuple[Pose2D | None, Pose2D | None],
    rivals: Sequence[Pose2D],
) -> StationEstimate:
    """The estimate of a slice that has enough returns and a combined pose."""
    context, reason = _context(section, slice_, combined, sensor, fit)
    growth = context.sensor.sigma / sensor.pooled().sigma
    beams, sensor = context.beams, context.sensor
    best, cost = _placed(context, slice_, combined, component_matches, rivals, reason)
    best = _with_inside(context, slice_, best)
    best = dataclasses.replace(best, growth=growth)
    if not best.status.measured or best.combined is None:
        return best
    others = []
    for place in gap_places(section, beams, best.combined):
        there = best_start(section, beams, cost, (place,), sensor, fit)
        other = _components(context, slice_, there, cost, (None, None), reason)
        other = _with_inside(context, slice_, other)
        others.append(dataclasses.replace(other, growth=growth))
    return with_lookalikes(best, others, fit.joint_sigma)


def _context(
    section: JointSection, slice_: Slice, combined: Pose2D, sensor: SensorConfig, fit: FitConfig
) -> tuple[_Context, str]:
    """What every step needs, and why a hole between points is no evidence (empty where it is)."""
    virtual = None
    own, (sensor, distance) = sensor, _here(sensor, slice_)
    if slice_.beams is None or len(slice_.beams.ranges) == 0:
        virtual = virtual_beams(slice_, combined)
        beams = BeamSet.of(virtual.beams)
        if not virtual.spacing_known:
            sensor = irregular_sensor(sensor)
    else:
        beams = BeamSet.of(slice_.beams)
    rows = (edge_rows(section.components[0]), edge_rows(section.components[1]))
    grows = own.sigma_per_metre > 0.0
    expected = Scene.at(rows, (combined, combined), beams).nearest if grows else None
    beams = with_spread(beams, own, distance, expected)
    context = _Context(section, beams, rows, BeamModel.of(sensor), sensor, fit, virtual is not None)
    return context, virtual.reason if virtual else ""


def reshaped(
    section: JointSection,
    slice_: Slice,
    station: StationEstimate,
    which: int,
    profiles: Sequence[Profile],
    sensor: SensorConfig,
    fit: FitConfig,
) -> list[Posterior | None]:
    """Posteriors of one component for each of several shapes, from the same beams, the other component held.

    Parameters
    ----------
    station : StationEstimate
        The same slice, estimated before.
    profiles : sequence of Profile
        Shapes to try; their evidences compare.
    """
    pose = station.combined
    if pose is None or station.components[which].pose is None:
        return [None] * len(profiles)
    context, _ = _context(section, slice_, pose, sensor, fit)
    window = _window(context)
    # the combined pose was found with another shape, for which a prior about it would speak at every station
    window = dataclasses.replace(window, shift=_LOOSE * window.shift, angle=_LOOSE * window.angle)
    return _reshaped(context, station, pose, which, profiles, None, window)


def _with_inside(context: _Context, slice_: Slice, station: StationEstimate) -> StationEstimate:
    """The station, judged by what is inside its gap and by the edges of its mouth."""

    def reshape(which: int, profiles: Sequence[Profile], begin: Pose2D | None) -> list[Posterior | None]:
        assert station.combined is not None
        return _reshaped(context, station, station.combined, which, profiles, begin, _window(context))

    sigma = context.sensor.sigma
    return with_inside(station, context.section, context.beams, sigma, slice_.sweeps, reshape)


def _reshaped(
    context: _Context,
    station: StationEstimate,
    pose: Pose2D,
    which: int,
    profiles: Sequence[Profile],
    begin: Pose2D | None,
    window: Window,
) -> list[Posterior | None]:
    beams = context.beams
    scene = _scene(context, (pose, pose))
    side = split_side(scene, beams, np.array([pose.u, pose.v]))
    usable = _usable(context, scene, side, pose)
    poses = [pose if c.pose is None else c.pose for c in station.components]
    scene = _scene(context, poses)
    shallow = pose.inverse().apply(beams.points)[:, 1] > -3.0 * context.sensor.sigma
    passed = _through(context, poses, scene)
    cost = cover_cost(beams, context.model, _depth(context))
    use, spent = second_round(
        which, scene, side, beams, cost, context.model, territory=shallow & (passed > 0)
    )
    begin = begin or station.components[which].pose
    return [
        component_posterior(
            edge_rows(profile), pose, beams, spent, context.model, window, use=use & usable, begin=begin
        )
        for profile in profiles
    ]


def _placed(
    context: _Context,
    slice_: Slice,
    combined: Pose2D,
    matches: tuple[Pose2D | None, Pose2D | None],
    rivals: Sequence[Pose2D],
    reason: str,
) -> tuple[StationEstimate, Cost]:
    """The best estimate near the combined pose and its rivals, and what covering a beam costs."""
    slid, cost = max(
        (_place(context, combined, rivals), *(_place(context, pose, ()) for pose in _home(combined))),
        key=lambda placed: float(placed[0].scores.max()),
    )
    best = _components(context, slice_, slid, cost, matches, reason)
    if slid.rival is None or slid.rival_odds < _WORTH_A_LOOK:
        return best, cost
    # the slide's blur cannot tell the two apart for certain; both fitted at the sensor's sigma can
    turned = dataclasses.replace(slid, pose=slid.rival, rival=slid.pose)
    other = _components(context, slice_, turned, cost, (None, None), reason)
    odds = _evidence(other) - _evidence(best)
    if best.status.measured and not other.status.measured:
        return best, cost  # what explains more by being impossible is no rival
    if odds > 0.0 or (other.status.measured and not best.status.measured):
        best, odds = other, -abs(odds)
    return checks.with_rival(best, odds), cost


def _evidence(estimate: StationEstimate) -> float:
    """Log evidence of both components; one that cannot be seen explains nothing."""
    return sum(c.posterior.evidence for c in estimate.components if c.posterior is not None)


def _nothing(slice_: Slice, combined: Pose2D | None, sensor: SensorConfig, status: Status) -> StationEstimate:
    none = ComponentEstimate(status=status)
    return StationEstimate(slice_.s, combined, (none, none), status, sensor)


def _scene(context: _Context, poses: Sequence[Pose2D]) -> Scene:
    """Predicted ranges of both components at a pose each."""
    return Scene.at(context.rows, poses, context.beams)


def _depth(context: _Context) -> float:
    """A return that much behind a surface went past it, m."""
    return max(4.0 * context.sensor.sigma, 1.5 * context.fit.placement_sigma)


def _through(context: _Context, poses: Sequence[Pose2D], scene: Scene) -> int:
    """Beams that went in between the components' mouth corners."""
    a, b = (pose.apply(m) for pose, m in zip(poses, context.section.gap.mouth, strict=True))
    return through((a, b), context.beams, scene.nearest, _depth(context), context.sensor.sigma)


def _usable(context: _Context, scene: Scene, side: Ints, pose: Pose2D) -> Mask:
    """Beams that may speak: away from ends that are no surface, and not grazing a face far out.

    There a milliradian moves a range by millimetres, a ridge so sharp that the quadrature's cells miss it.
    """
    components, beams = context.section.components, context.beams
    surface = (components[0].surface, components[1].surface)
    use = np.ones(len(beams), bool)
    if not (surface[0].all() and surface[1].all()):
        edges = (pose.apply(components[0].edges), pose.apply(components[1].edges))
        margin = 2.0 * context.fit.placement_tolerance
        use = ~beside_artificial_ends(scene, side, beams, edges, surface, margin)
    kernels.far_grazing(
        *context.rows, pose.as_array(), scene.ranges, scene.faces, beams.rays, beams.start, beams.eye,
        _GRAZING, _FAR_OUT, use,
    )  # fmt: skip
    return use


def _place(context: _Context, combined: Pose2D, rivals: Sequence[Pose2D]) -> tuple[SlideResult, Cost]:
    """Slide the combined pose and its rivals; what covering a beam costs there."""
    scene = _scene(context, (combined, combined))
    side = split_side(scene, context.beams, np.array([combined.u, combined.v]))
    cost = cover_cost(context.beams, context.model, _depth(context))
    usable = _usable(context, scene, side, combined)
    beams, used = (context.beams, cost) if usable.all() else (context.beams.take(usable), cost.take(usable))
    slid = best_start(context.section, beams, used, (combined, *rivals), context.sensor, context.fit)
    return slid, cost


def _home(combined: Pose2D) -> tuple[Pose2D, ...]:
    """The combined pose slid back along the faces to the design, where it is too far for the slide to look.

    Faces that go on for longer than the scan is used leave the hits of a combined search all but flat along
    them; only the beams that miss tell where the gap is.
    """
    c, s = math.cos(combined.theta), math.sin(combined.theta)
    along = combined.u * c + combined.v * s
    if abs(along) < _FAR_ALONG:
        return ()
    return (Pose2D(combined.u - along * c, combined.v - along * s, combined.theta),)


def _window(context: _Context) -> Window:
    """The component's own window: it scales with the gap, but is never under the placement tolerance."""
    fit = context.fit
    half = max(fit.gap_fraction * designed_width(context.section), fit.placement_tolerance)
    return Window(0.64 * half, fit.component_angle / 1.5, 0.96 * half, 0.24 * half)


def _components(
    context: _Context,
    slice_: Slice,
    slid: SlideResult,
    cost: Cost,
    matches: tuple[Pose2D | None, Pose2D | None],
    reason: str,
) -> StationEstimate:
    pose, beams = slid.pose, context.beams
    scene = _scene(context, (pose, pose))
    side = split_side(scene, beams, np.array([pose.u, pose.v]))
    usable = _usable(context, scene, side, pose)
    window = _window(context)
    first: list[Posterior | None] = []
    for which in (0, 1):
        use = first_round(which, scene, side)
        first.append(_one(context, which, pose, use & usable, cost, window, matches[which]))
    posteriors = first
    poses = [p.pose if p is not None else pose for p in posteriors]
    scene = _scene(context, poses)
    passed = _through(context, poses, scene)
    both = np.isfinite(scene.rho[0]) & np.isfinite(scene.rho[1])
    if all(p is not None for p in first) and (
        bool(np.any(both & usable)) or passed < _FEW_THROUGH or meeting(scene, _FEW_THROUGH)
    ):
        posteriors = list(first)
        # near the mouth two bodies lie side by side; deep in a groove they meet, nobody knows just where
        shallow = pose.inverse().apply(beams.points)[:, 1] > -3.0 * context.sensor.sigma
        for which in (0, 1):
            use, spent = second_round(
                which, scene, side, beams, cost, context.model, territory=shallow & (passed > 0)
            )
            posteriors[which] = _one(context, which, pose, use & usable, spent, window, poses[which])
            poses[which] = posteriors[which].pose if posteriors[which] is not None else pose  # type: ignore[union-attr]
            scene = _scene(context, poses)
        passed = _through(context, poses, scene)
    if reason:
        posteriors = [p if p is None else _loosened(context, p) for p in posteriors]
    residuals = [_residuals(context, which, scene, side, usable, posteriors[which]) for which in (0, 1)]
    steps = [_corner_step(context, which, poses[which]) for which in (0, 1)]
    return checks.judge_station(
        slice_.s, context.section, slid, (posteriors[0], posteriors[1]), (residuals[0], residuals[1]),
        (steps[0], steps[1]), window, context.sensor, context.fit, passed, reason, context.virtual,
    )  # fmt: skip


def _loosened(context: _Context, p: Posterior) -> Posterior:
    """Points at random end up to two of their spacings, or of their noise, from an edge (see cloud.py)."""
    if p.weak_sd_ranges < context.sensor.sigma:
        return p
    reach = float(np.hypot(*(p.pivot - context.beams.eye[0, :2])))
    sd = 2.0 * max(context.sensor.sigma, context.beams.spacing * reach)
    wider = np.diag([sd * sd, 0.0, 0.0])
    return dataclasses.replace(
        p,
        covariance=p.covariance + wider,
        pivot_covariance=p.pivot_covariance + wider,
        weak_sd=math.hypot(p.weak_sd, sd * abs(float(p.weak_axis[0]))),
    )


def _corner_step(context: _Context, which: int, pose: Pose2D) -> float:
    """Bearing of a mouth corner from the first sensor position, in beam steps.

    Counted from the middle of the beams, which is fixed to the sensor; beams made up from points have no
    middle of their own and are counted from the designed mouth. Not from farther off: the steps differ a
    little from slice to slice, and so many of them would hide that two slices see a corner in the same place.
    """
    if context.beams.spacing <= 0.0:
        return math.nan
    x, y = pose.apply(context.section.gap.mouth[which]) - context.beams.eye[0, :2]
    lx, ly = -context.beams.eye[0, :2] if context.virtual else context.beams.eye[0, 2:]
    return math.atan2(lx * y - ly * x, lx * x + ly * y) / context.beams.spacing


def _one(
    context: _Context, which: int, prior: Pose2D, use: Mask, cost: Cost, window: Window,
    begin: Pose2D | None,
) -> Posterior | None:  # fmt: skip
    """Posterior of one component from the beams in ``use``; None where hardly any meets it."""
    return component_posterior(
        context.rows[which], prior, context.beams, cost, context.model, window, use=use, begin=begin
    )


def _residuals(
    context: _Context, which: int, scene: Scene, side: Ints, usable: Mask, posterior: Posterior | None
) -> Residuals:
    if posterior is None:
        return Residuals()
    return residuals_of(
        context.rows[which], posterior, context.beams, (scene.rho[which], scene.face[which]),
        scene.rho[1 - which], (side == which) & usable, context.sensor.sigma,
    )  # fmt: skip
