"""Scenes that are not the designed joint, or not quite: what is to be refused (METHOD, section 5)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.profile import Profile

Random = np.random.Generator
NOTHING = Profile(())


def impostor(kind: str, sections: Sequence[JointSection], seed: int) -> tuple[JointSection, ...]:
    """The sections with other components in them: what is really there when the design is not.

    Parameters
    ----------
    kind : str
        A name of :data:`IMPOSTORS`.
    sections : sequence of JointSection
        The design of a butt joint between two boards.
    seed : int
        What is drawn (sizes, places) is drawn once for the joint, clutter anew at each station.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
    make = IMPOSTORS[kind](rng)
    return tuple(dataclasses.replace(section, components=make(section)) for section in sections)


Pair = tuple[Profile, Profile]
Maker = Callable[[JointSection], Pair]


def _missing(rng: Random) -> Maker:
    which = int(rng.integers(2))

    def make(section: JointSection) -> Pair:
        a, b = section.components
        return (NOTHING, b) if which == 0 else (a, NOTHING)

    return make


def _wall(rng: Random) -> Maker:
    return lambda section: (box(-0.5, 0.5, -0.03, 0.0), NOTHING)


def _pipe(rng: Random) -> Maker:
    radius, centre = rng.uniform(0.03, 0.10), rng.uniform(-0.02, 0.02)
    t = np.linspace(0.0, 2.0 * np.pi, 96, endpoint=False)
    ring = Profile.polygon(np.stack([radius * np.cos(t) + centre, radius * (np.sin(t) - 1.0)], axis=1))
    return lambda section: (ring, NOTHING)


def _clutter(rng: Random) -> Maker:
    def make(section: JointSection) -> Pair:
        left, wide, top = rng.uniform(-0.15, 0.12, 8), rng.uniform(0.01, 0.04, 8), rng.uniform(-0.1, 0.06, 8)
        boxes = [box(x, x + w, z - 0.03, z) for x, w, z in zip(left, wide, top, strict=True)]
        return Profile(tuple(b.loops[0] for b in boxes)), NOTHING

    return make


def _bevel(rng: Random) -> Maker:
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


def _wide(rng: Random) -> Maker:
    def make(section: JointSection) -> Pair:
        a, b = section.components
        return a.moved(Pose2D(-0.020)), b.moved(Pose2D(0.020))

    return make


def _empty(rng: Random) -> Maker:
    return lambda section: (NOTHING, NOTHING)


def _bowed(rise: float) -> Callable[[Random], Maker]:
    """Boards whose upper faces are arched (or hollow, at random) by ``rise`` in their middle."""

    def of(rng: Random) -> Maker:
        signs = rng.choice([-1.0, 1.0], 2)

        def make(section: JointSection) -> Pair:
            a, b = (bowed(c, rise * s) for c, s in zip(section.components, signs, strict=True))
            return a, b

        return make

    return of


def _beside(count: int, width: float) -> Callable[[Random], Maker]:
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


IMPOSTORS: dict[str, Callable[[Random], Maker]] = {
    "missing component": _missing,
    "plain wall": _wall,
    "pipe": _pipe,
    "clutter": _clutter,
    "bevel for square": _bevel,
    "gap 40 mm too wide": _wide,
    "empty slice": _empty,
    "bow 1 mm": _bowed(0.001),
    "bow 2 mm": _bowed(0.002),
    "bow 5 mm": _bowed(0.005),
    "three boards": _beside(3, 0.070),
    "four boards": _beside(4, 0.060),
    "four boards, far off": _beside(4, 0.060),
}
"""Every scene: a maker of components, once drawn."""

FAR_OFF = 0.060
"""How far the joint as a whole may be shifted across in the scenes named so, m."""
BESIDE = {"three boards": 0.070, "four boards": 0.060, "four boards, far off": 0.060}
"""Scenes in which the joint's own boards have this width (m), as designed and as built."""


def narrowed(sections: Sequence[JointSection], width: float) -> tuple[JointSection, ...]:
    """A butt joint's design with boards of another width, m."""
    out = []
    for section in sections:
        parts = []
        for component, mouth, sign in zip(section.components, section.gap.mouth, (-1.0, 1.0), strict=True):
            (_, v0), (_, v1) = component.bounds
            inner = float(mouth[0])
            parts.append(box(min(inner, inner + sign * width), max(inner, inner + sign * width), v0, v1))
        out.append(dataclasses.replace(section, components=(parts[0], parts[1])))
    return tuple(out)
