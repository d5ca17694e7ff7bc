"""Whether a station's numbers may be believed: a status with a reason in plain words."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation.context import Context
from bimfit.estimation.posterior import Posterior, Window
from bimfit.estimation.result import ComponentEstimate, Residuals, Rival, StationEstimate
from bimfit.estimation.slide import SlideResult
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.status import OK, Status

_RIVAL_ODDS = -4.0
_RIVAL_MASS = 0.2
_WORTH_NAMING = 0.01
_INLIERS = 0.5
DOZEN = 12
"""So few returns fix a pose, but cannot show that it is the right component (METHOD, section 8)."""
_RUN = 6
_CUSUM = 2.3
_CHI2 = 4.0
_CONTINUES = 4
_EDGE = 4.2
_BY_CHANCE = 0.05
_FIXED_BY_HITS = 0.001
FIXED = 0.3
"""A direction is fixed where its standard deviation is under that share of the prior's."""
_TURNED = 3.0
_ON_CHAIN = 1e-6


def judge_station(
    context: Context,
    slid: SlideResult,
    posteriors: tuple[Posterior | None, Posterior | None],
    residuals: tuple[Residuals, Residuals],
    steps: tuple[float, float],
    passed: int,
) -> StationEstimate:
    """Put a station together and say what may be believed of it.

    Parameters
    ----------
    steps : tuple of two float
        Bearings of the mouth corners in beam steps.
    passed : int
        Beams that went in between the components.
    """
    a, b = (
        _component(context, which, posteriors[which], residuals[which], slid.pose, steps[which])
        for which in (0, 1)
    )
    covered = residuals[0].n_covered + residuals[1].n_covered
    status = _joint_status(context, (a, b), slid.pose, passed, covered)
    for name, c in (("A", a), ("B", b)):
        worse = status.measured if not c.status.measured else status.name == "ok"
        if c.status.name != "ok" and worse:
            status = Status(c.status.name, f"component {name}: {c.status.reason}")
    loose = [p is None or p.weak_sd_ranges > _FIXED_BY_HITS for p in posteriors]
    if status.name == "ok" and context.reason and any(loose):
        status = Status("weak", f"not fixed across the gap (u): {context.reason}")
    return StationEstimate(
        context.slice.s, slid.pose, (a, b), status, context.sensor, slid.shift, slid.rival_odds, passed,
        context.virtual, context.growth,
    )  # fmt: skip


def with_rival(station: StationEstimate, odds: float) -> StationEstimate:
    """The station when another place of the whole joint has the log-odds ``odds`` against it."""
    status = station.status
    if odds > _RIVAL_ODDS and status.name in ("ok", "weak"):
        status = Status(
            "ambiguous", f"another place along u explains the slice as well (log-odds {odds:.1f})"
        )
    return replace(station, rival_odds=odds, status=status)


def _component(
    context: Context,
    which: int,
    posterior: Posterior | None,
    residuals: Residuals,
    prior: Pose2D,
    step: float,
) -> ComponentEstimate:
    """What is known of one component, and whether it may be believed."""
    if posterior is None:
        none = Status("no_data", "hardly any return lies on the component")
        return ComponentEstimate(status=none, corner_step=step)
    window = context.window
    status, weak = _component_status(posterior, residuals, prior, window, context.fit, context.sensor)
    if status.name == "ok" and residuals.unsupported is not None:
        face = residuals.unsupported
        weak = _direction(face.direction)
        name = _face_name(context.section, which, face.face)
        where = f"return from {name}, without which nothing fixes it {weak}"
        status = Status("weak", f"only {face.inliers} of {face.beams} beams {where}")
    rivals: tuple[Rival, ...] = ()
    if posterior.rival_mass > _WORTH_NAMING:
        du, dv = posterior.rival_offset * posterior.weak_axis[:2]
        there = Pose2D(posterior.pose.u + float(du), posterior.pose.v + float(dv), posterior.pose.theta)
        mass = min(posterior.rival_mass, 0.999)
        rivals = (Rival(there, math.log(mass / (1.0 - mass))),)
    return ComponentEstimate(
        posterior.pose, posterior.covariance, status, rivals, residuals.n_inliers, residuals.rms, weak,
        posterior, residuals, prior, (window.shift, window.shift, window.angle), step,
    )  # fmt: skip


def _component_status(
    posterior: Posterior, r: Residuals, prior: Pose2D, window: Window, fit: FitConfig, sensor: SensorConfig
) -> tuple[Status, str]:
    """Verdict on one component, and the name of its weak direction."""
    u, v = posterior.pivot.tolist()
    there = posterior.pose.point(*prior.inverse().point(u, v))
    moved = math.hypot(there[0] - u, there[1] - v)
    turned = abs(posterior.pose.theta - prior.theta)
    if r.n_inliers < fit.min_points:
        lie = "return lies" if r.n_inliers == 1 else "returns lie"
        return Status("rejected", f"only {r.n_inliers} {lie} on the component"), ""
    if r.n_inliers < _INLIERS * r.n_covered:
        share = f"{r.n_inliers} of the {r.n_covered} beams that should meet the component"
        return Status("rejected", f"only {share} return from it"), ""
    # the longest run by chance among so many beams is seldom longer than this
    rare = math.log(1e-3 / max(r.n_covered, 1))
    goes_on = max(sensor.outlier_share, 1.0 - 1.0 / sensor.outlier_run)
    lost, strayed = (rare / math.log(max(share, 0.05)) for share in (sensor.miss_share, goes_on))
    if r.miss_run >= max(_RUN, lost) or r.outlier_run >= max(_RUN, strayed):
        what = "return nothing" if r.miss_run >= r.outlier_run else "return from elsewhere"
        run = max(r.miss_run, r.outlier_run)
        return Status("rejected", f"{run} beams in a row that should meet the component {what}"), ""
    if r.cusum > _CUSUM or r.chi2 > _CHI2:
        return Status("rejected", "the returns bend away from the designed shape"), ""
    if r.edge > _EDGE:
        return Status("rejected", "its surface drops off before its designed edge"), ""
    if r.unexplained >= _CONTINUES:
        reason = f"{r.unexplained} returns carry its surface on past its designed edge"
        return Status("rejected", reason), ""
    if moved > 2.5 * window.shift or turned > _TURNED * window.angle:
        where = f"{moved * 1e3:.0f} mm and {math.degrees(turned):.1f} degrees from the joint's common pose"
        return Status("rejected", f"it lies {where}, more than the placement tolerance allows"), ""
    if r.n_inliers <= DOZEN:
        return Status("weak", f"only {r.n_inliers} returns support it: too few to tell its shape"), ""
    if posterior.weak_sd > FIXED * window.shift:
        weak = _direction(posterior.weak_axis)
        sd = f"standard deviation {posterior.weak_sd * 1e3:.1f} mm"
        return Status("weak", f"the data do not fix it {weak}: {sd}"), weak
    if posterior.rival_mass > _RIVAL_MASS:
        where = f"{posterior.rival_offset * 1e3:+.1f} mm away"
        return Status("ambiguous", f"another place {where} explains the data as well"), ""
    return OK, ""


def _joint_status(
    context: Context,
    components: tuple[ComponentEstimate, ComponentEstimate],
    pose: Pose2D,
    passed: int,
    covered: int,
) -> Status:
    """Verdict on the two components together: whether there is a gap, and whether it can be this one."""
    a, b = components
    if a.pose is None or b.pose is None:
        return OK
    fit, sensor, width = context.fit, context.sensor, context.section.gap.width
    widened = _widened(context.section, a.pose, b.pose, pose)
    if abs(widened) > 2.0 * fit.placement_tolerance:
        how = "wider" if widened > 0.0 else "narrower"
        return Status("rejected", f"the gap would be {abs(widened) * 1e3:.0f} mm {how} than designed")
    beams = abs(b.corner_step - a.corner_step)
    beams = beams if math.isfinite(beams) else 0.0
    if beams < 1.0 and passed == 0:
        return Status(
            "weak", "no beam passes between the components: the gap is narrower than the beams' spacing"
        )
    silent = sensor.missing == "unknown"
    if passed == 0 and silent:
        reason = "no return comes from between the components, and missing returns say nothing of this sensor"
        return Status("weak", reason)
    if passed == 0:
        return Status("weak", "no beam passes between the components: closed, filled, or not a gap at all")
    # a gap that would be far narrower than designed is the more likely one that chance misses have made
    doubt = _BY_CHANCE if widened > -0.5 * width else 0.1 * _BY_CHANCE
    chance = max(sensor.outlier_share if silent else sensor.miss_share, 1e-3)
    if passed and covered * chance**passed > doubt:
        beams_pass = "1 beam passes" if passed == 1 else f"{passed} beams pass"
        return Status("weak", f"only {beams_pass} between the components: too few to tell from drop-outs")
    return OK


def _widened(section: JointSection, a: Pose2D, b: Pose2D, pose: Pose2D) -> float:
    """How much wider than designed the mouth is along the designed line from corner to corner, m."""
    (au, av), (bu, bv) = section.gap.corners.tolist()
    width = section.gap.width
    c, s = math.cos(pose.theta), math.sin(pose.theta)
    across = (bu - au) / max(width, 1e-9), (bv - av) / max(width, 1e-9)
    (x0, y0), (x1, y1) = a.point(au, av), b.point(bu, bv)
    along = (c * across[0] - s * across[1]) * (x1 - x0) + (s * across[0] + c * across[1]) * (y1 - y0)
    return float(along - width)


def _direction(axis: Array) -> str:
    """Name in words of a direction (3,) in (u, v, theta * radius)."""
    names = ("across the gap (u)", "out of the mouth (v)", "in rotation")
    return names[int(np.argmax(np.abs(axis)))]


def _face_name(section: JointSection, which: int, face: int) -> str:
    """What a face of a component's profile is, in words."""
    chain = section.gap.side_a if which == 0 else section.gap.side_b
    middle = section.components[which].edges[face].mean(axis=0)
    a, way = chain[:-1], np.diff(chain, axis=0)
    t = ((middle - a) * way).sum(axis=1) / np.maximum((way * way).sum(axis=1), 1e-300)
    away = np.linalg.norm(a + np.clip(t, 0.0, 1.0)[:, None] * way - middle, axis=1)
    return "its face in the gap" if float(away.min()) < _ON_CHAIN else "one of its outer faces"
