"""An independent generator of the reference scenario (METHOD, section 1), for this room's tests."""

import math

import numpy as np

from bimfit.geometry.pose import Pose2D
from bimfit.geometry.profile import Profile
from bimfit.geometry.slice import Slice
from bimfit.geometry.visibility import visible_edges

SENSOR = np.array([0.0, 0.25])
BOARDS = (
    Profile.polygon([(-0.2125, -0.025), (-0.0125, -0.025), (-0.0125, 0.0), (-0.2125, 0.0)]),
    Profile.polygon([(0.0125, -0.025), (0.2125, -0.025), (0.2125, 0.0), (0.0125, 0.0)]),
)
CORNERS = (np.array([-0.0125, 0.0]), np.array([0.0125, 0.0]))


def boards_edges(closed=False):
    """Visible edges of both boards from the sensor, or their closed outlines."""
    if closed:
        return np.concatenate([b.edges for b in BOARDS])
    return np.concatenate(visible_edges(BOARDS, SENSOR))


def component_edges(which):
    return visible_edges(BOARDS, SENSOR)[which]


def ranges(profiles, origin, directions):
    """Range of the first edge that each ray meets; inf where none does."""
    out = np.full(len(directions), np.inf)
    for profile in profiles:
        for a, b in profile.edges:
            e = b - a
            det = directions[:, 0] * -e[1] + directions[:, 1] * e[0]
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (-(a - origin)[0] * e[1] + (a - origin)[1] * e[0]) / det
                s = (directions[:, 0] * (a - origin)[1] - directions[:, 1] * (a - origin)[0]) / det
            hit = (np.abs(det) > 1e-12) & (s >= 0) & (s <= 1) & (t > 0)
            out = np.where(hit & (t < out), t, out)
    return out


TURN, TURN_EACH, HALF = math.radians(5), math.radians(3), 85 * math.radians(0.352)


def make_slice(
    rng, *, common=(0.02, 0.02, TURN), each=(0.006, 0.006, TURN_EACH), sigma=0.003, beams=171, half=HALF
):
    """One slice: (Slice, common pose, (pose A, pose B))."""
    lift = lambda scale: [float(x) for x in rng.uniform(-1.0, 1.0, 3) * scale]  # noqa: E731
    whole = Pose2D.about((0.0, 0.0), *lift(np.array(common)))
    parts = tuple(whole @ Pose2D.about(c, *lift(np.array(each))) for c in CORNERS)
    bearing = np.linspace(-half, half, beams)
    d = np.stack([np.sin(bearing), -np.cos(bearing)], axis=1)
    r = ranges([b.moved(p) for b, p in zip(BOARDS, parts, strict=True)], SENSOR, d)
    r = r + rng.normal(0.0, sigma, beams)
    keep = np.isfinite(r)
    return Slice(0.0, SENSOR + d[keep] * r[keep, None], viewpoint=SENSOR), whole, parts


def make_slices(n, seed=0, **options):
    rng = np.random.default_rng(seed)
    return [make_slice(rng, **options) for _ in range(n)]
