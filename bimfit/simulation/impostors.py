"""Components that are not the designed ones, or not quite: what is to be refused (METHOD, section 5)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.profile import Profile

Random = np.random.Generator
NOTHING = Profile(())
_WALL = 0.6
"""Half the width of a wall, m."""


Pair = tuple[Profile, Profile]
Maker = Callable[[JointSection], Pair]


def missing(rng: Random) -> Maker:
    """One of the components, drawn once, is not there."""
    which = int(rng.integers(2))

    def make(section: JointSection) -> Pair:
        a, b = section.components
        return (NOTHING, b) if which == 0 else (a, NOTHING)

    return make


def plain_wall(rng: Random) -> Maker:
    """A flat wall in place of both."""
    return lambda section: (box(-0.5, 0.5, -0.03, 0.0), NOTHING)


def pipe(rng: Random) -> Maker:
    """A pipe of 30 to 100 mm radius."""
    radius, centre = rng.uniform(0.03, 0.10), rng.uniform(-0.02, 0.02)
    t = np.linspace(0.0, 2.0 * np.pi, 96, endpoint=False)
    ring = Profile.polygon(np.stack([radius * np.cos(t) + centre, radius * (np.sin(t) - 1.0)], axis=1))
    return lambda section: (ring, NOTHING)


def clutter(rng: Random) -> Maker:
    """Eight boxes anywhere, drawn anew at each station."""

    def make(section: JointSection) -> Pair:
        left, wide, top = rng.uniform(-0.15, 0.12, 8), rng.uniform(0.01, 0.04, 8), rng.uniform(-0.1, 0.06, 8)
        boxes = [box(x, x + w, z - 0.03, z) for x, w, z in zip(left, wide, top, strict=True)]
        return Profile(tuple(b.loops[0] for b in boxes)), NOTHING

    return make


def bevel(rng: Random) -> Maker:
    """A V-groove of the designed mouth's width, 4 mm open at its root, where the design is square."""
    land, root = 0.003, 0.002

    def make(section: JointSection) -> Pair:
        parts = []
        for component, sign in zip(section.components, (-1.0, 1.0), strict=True):
            (u0, v0), (u1, v1) = component.bounds
            outer = u0 if sign < 0.0 else u1
            mouth = section.gap.mouth[0 if sign < 0.0 else 1][0]
            parts.append(
                Profile.polygon(
                    [(mouth, v1), (outer, v1), (outer, v0), (sign * root, v0), (sign * root, v0 + land)]
                )
            )
        return parts[0], parts[1]

    return make


def chamfered(size: float) -> Callable[[Random], Maker]:
    """Boards whose edges at the mouth are cut off at 45 degrees."""

    def of(rng: Random) -> Maker:
        def make(section: JointSection) -> Pair:
            parts = []
            for component, side in zip(
                section.components, (section.gap.side_a, section.gap.side_b), strict=True
            ):
                (u0, v0), (u1, v1) = component.bounds
                mouth = float(side[0][0])
                outer, sign = (u0, -1.0) if u0 + u1 < 2.0 * mouth else (u1, 1.0)
                ring = [(mouth + sign * size, v1), (outer, v1), (outer, v0), (mouth, v0), (mouth, v1 - size)]
                parts.append(Profile.polygon(ring))
            return parts[0], parts[1]

        return make

    return of


def thick(thickness: float) -> Callable[[Random], Maker]:
    """Boards of another thickness, their upper faces where they should be."""

    def of(rng: Random) -> Maker:
        def make(section: JointSection) -> Pair:
            parts = []
            for component in section.components:
                (u0, _), (u1, v1) = component.bounds
                parts.append(box(u0, u1, v1 - thickness, v1))
            return parts[0], parts[1]

        return make

    return of


def backed(distance: float) -> Callable[[Random], Maker]:
    """The joint itself, and a wall so far behind its boards."""

    def of(rng: Random) -> Maker:
        def make(section: JointSection) -> Pair:
            a, b = section.components
            low = float(min(a.bounds[0][1], b.bounds[0][1])) - distance
            wall = box(-_WALL, _WALL, low - 0.05, low)
            return Profile((*a.loops, *wall.loops)), b

        return make

    return of


def too_wide(rng: Random) -> Maker:
    """A gap that is 40 mm wider than designed."""

    def make(section: JointSection) -> Pair:
        a, b = section.components
        return a.moved(Pose2D(-0.020)), b.moved(Pose2D(0.020))

    return make


def nothing(rng: Random) -> Maker:
    """No component at all."""
    return lambda section: (NOTHING, NOTHING)


def arched(rise: float) -> Callable[[Random], Maker]:
    """Boards whose upper faces are arched (or hollow, at random) by ``rise`` in their middle."""

    def of(rng: Random) -> Maker:
        signs = rng.choice([-1.0, 1.0], 2)

        def make(section: JointSection) -> Pair:
            a, b = (bowed(c, rise * s) for c, s in zip(section.components, signs, strict=True))
            return a, b

        return make

    return of


def beside(count: int, width: float) -> Callable[[Random], Maker]:
    """So many equal boards in a row with equal gaps; the joint is between two of the inner ones."""

    def of(rng: Random) -> Maker:
        before = int(rng.integers(0, count - 1))

        def make(section: JointSection) -> Pair:
            gap = float(np.hypot(*(section.gap.mouth[1] - section.gap.mouth[0])))
            low, high = section.components[0].bounds[:, 1]
            loops: tuple[list[Array], list[Array]] = ([], [])
            for k in range(-before - 1, count - before - 1):
                left = 0.5 * gap + k * (gap + width)
                du, dv, turn = (rng.uniform(-1.0, 1.0, 3) * (0.002, 0.002, 0.02)).tolist()
                tilt = Pose2D.about((left, high), du, dv, turn)
                own = k in (-1, 0)
                board = box(left, left + width, low, high)
                loops[0 if k < 0 else 1].append((board if own else board.moved(tilt)).loops[0])
            return Profile(tuple(loops[0])), Profile(tuple(loops[1]))

        return make

    return of


def box(u0: float, u1: float, v0: float, v1: float) -> Profile:
    """An upright rectangle."""
    return Profile.polygon([(u0, v0), (u1, v0), (u1, v1), (u0, v1)])


def bowed(profile: Profile, rise: float, pieces: int = 40) -> Profile:
    """A board whose upper face is a parabola ``rise`` above its ends in the middle (m; negative: hollow)."""
    (u0, v0), (u1, v1) = profile.bounds
    u = np.linspace(u1, u0, pieces + 1)
    top = v1 + rise * (1.0 - ((2.0 * u - u0 - u1) / (u1 - u0)) ** 2)
    return Profile.polygon(np.concatenate([[(u0, v0), (u1, v0)], np.column_stack([u, top])]))
