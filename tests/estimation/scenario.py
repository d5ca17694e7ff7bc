"""An independent, small generator of METHOD section 1 joints in the section frame, for these tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.joint_section import GapOutline, JointSection
from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile
from bimfit.geometry.slice import Beams, Slice

STEP = 0.352 * np.pi / 180
FRAME = SectionFrame.from_axes((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
BUTT_A = [(-0.0125, 0.0), (-0.2125, 0.0), (-0.2125, -0.025), (-0.0125, -0.025)]
BUTT_B = [(0.0125, 0.0), (0.0125, -0.025), (0.2125, -0.025), (0.2125, 0.0)]


def section(a=BUTT_A, b=BUTT_B, side_a=None, side_b=None, s: float = 0.0) -> JointSection:
    side_a = np.array(side_a if side_a is not None else [(-0.0125, 0.0), (-0.0125, -0.025)])
    side_b = np.array(side_b if side_b is not None else [(0.0125, 0.0), (0.0125, -0.025)])
    return JointSection(s, FRAME, (Profile.polygon(a), Profile.polygon(b)), GapOutline(side_a, side_b))


def butt(gap: float = 0.025, depth: float = 0.025, width: float = 0.2) -> JointSection:
    h = gap / 2
    a = [(-h, 0.0), (-h - width, 0.0), (-h - width, -depth), (-h, -depth)]
    b = [(h, 0.0), (h, -depth), (h + width, -depth), (h + width, 0.0)]
    return section(a, b, [(-h, 0.0), (-h, -depth)], [(h, 0.0), (h, -depth)])


def groove(
    gap: float = 0.025, depth: float = 0.025, root: float = 0.004, land: float = 0.003
) -> JointSection:
    h, w = gap / 2, root / 2
    a = [(-h, 0.0), (-0.2, 0.0), (-0.2, -depth), (-w, -depth), (-w, -depth + land)]
    b = [(h, 0.0), (w, -depth + land), (w, -depth), (0.2, -depth), (0.2, 0.0)]
    return section(a, b, [a[0], a[4], a[3]], [b[0], b[1], b[2]])


@dataclass(frozen=True)
class Truth:
    """One joint: common motion and each component's full motion, a row a station."""

    common: list[Pose2D]
    a: list[Pose2D]
    b: list[Pose2D]


def reference_truth(
    rng: np.random.Generator,
    sec: JointSection,
    n: int = 83,
    knots: int = 12,
    own: float = 0.006,
    own_angle: float = 3.0,
    common: float = 0.020,
    common_angle: float = 5.0,
) -> Truth:
    at = (
        np.sort(np.r_[0, n - 1, rng.choice(np.arange(1, n - 1), min(knots, n) - 2, replace=False)])
        if n > 2
        else np.arange(n)
    )

    def walk(half):
        return np.interp(np.arange(n), at, rng.uniform(-half, half, len(at)))

    c = np.stack([walk(common), walk(common), walk(np.radians(common_angle))], 1)
    parts = [np.stack([walk(own), walk(own), walk(np.radians(own_angle))], 1) for _ in range(2)]
    corners = sec.gap.mouth
    commons = [Pose2D(*row) for row in c]
    full = [[commons[i] @ Pose2D.about(corners[k], *parts[k][i]) for i in range(n)] for k in range(2)]
    return Truth(commons, full[0], full[1])


def ray_ranges(profiles, origins, directions):
    """First intersection of every ray with the profiles' edges; inf where there is none."""
    out = np.full(len(directions), np.inf)
    for profile in profiles:
        for a, b in profile.edges:
            e = b - a
            den = directions[:, 0] * e[1] - directions[:, 1] * e[0]
            w = a - origins
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (w[:, 0] * e[1] - w[:, 1] * e[0]) / den
                q = (w[:, 0] * directions[:, 1] - w[:, 1] * directions[:, 0]) / den
            ok = (t > 1e-9) & (q >= 0) & (q <= 1)
            out = np.where(ok & (t < out), t, out)
    return out


def scan(
    rng,
    profiles,
    *,
    eye=(0.0, 0.25),
    look=(0.0, -1.0),
    half=85,
    step=STEP,
    sigma=0.003,
    outliers=0.0,
    misses=0.0,
    rho=0.0,
    floor=None,
    max_range=5.6,
    s=0.0,
    sweeps=1,
) -> Slice:
    k = np.tile(np.arange(-half, half + 1), sweeps)
    angle = k * step
    c, sn = np.cos(angle), np.sin(angle)
    look = np.asarray(look, float)
    d = np.stack([c * look[0] - sn * look[1], sn * look[0] + c * look[1]], 1)
    o = np.broadcast_to(np.asarray(eye, float), d.shape).copy()
    r = ray_ranges(profiles, o, d)
    if floor is not None:
        with np.errstate(divide="ignore"):
            t = (floor - o[:, 1]) / d[:, 1]
        r = np.where(np.isfinite(r), r, np.where(t > 0, t, np.inf))
    noise = rng.normal(0, 1, len(r))
    if rho > 0:
        for i in range(1, len(noise)):
            noise[i] = rho * noise[i - 1] + np.sqrt(1 - rho**2) * noise[i]
    r = np.where(np.isfinite(r), r + sigma * noise, np.nan)
    if misses:
        r[rng.random(len(r)) < misses] = np.nan
    if outliers:
        bad = rng.random(len(r)) < outliers
        r[bad] = rng.uniform(0.02, max_range, bad.sum())
    beams = Beams(o, d, r)
    return Slice(s, beams.points, beams, np.asarray(eye, float), sweeps)


def search_like(rng, pose: Pose2D) -> Pose2D:
    """What a search on hits alone gives back for the common motion."""
    jump = rng.choice([0.0, 0.010, -0.010], p=[0.9, 0.05, 0.05])
    return (
        Pose2D.about(
            (pose.u, pose.v),
            rng.normal(0, 0.002) + jump,
            rng.normal(0, 0.001),
            rng.normal(0, np.radians(0.6)),
        )
        @ pose
    )


def gap_pose(sec: JointSection, a: Pose2D, b: Pose2D) -> np.ndarray:
    """Origin (2) and angle of the line through the mouth corners."""
    pa, pb = a.apply(sec.gap.mouth[0]), b.apply(sec.gap.mouth[1])
    w = pb - pa
    return np.array([*(0.5 * (pa + pb)), np.arctan2(w[1], w[0]), np.hypot(*w)])
