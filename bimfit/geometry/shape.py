"""Named freedoms of a component's shape: what may differ besides its pose (METHOD, section 8).

``bevel-angle``
    The face that runs from the mouth corner into the gap turns about that corner; positive opens the gap
    towards its mouth (the root comes nearer to the other component). Rad.
``face-angle``
    The outer face beside the mouth corner turns about it; positive rises away from the mouth. Rad.
``thickness``
    The back face beyond the root corner shifts outwards; positive is thicker. Metres.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.profile import Profile

FREEDOMS = ("bevel-angle", "face-angle", "thickness")
_SAME = 1e-6
_STRAIGHT = math.radians(0.5)
_PARALLEL = 0.05


def deformed(section: JointSection, which: int, values: Mapping[str, float]) -> JointSection:
    """A section whose component ``which`` (0 for A, 1 for B) has another shape, its side of the gap with it.

    Parameters
    ----------
    values : mapping of str to float
        Freedoms and how far they are from the design, rad or m; those that are not named are 0.

    Raises
    ------
    ValueError
        Where the component has no such face, see :func:`has_freedom`.
    """
    wanted = {name: value for name, value in values.items() if value != 0.0}
    if not wanted:
        return section
    profile, chain = section.components[which], (section.gap.side_a, section.gap.side_b)[which]
    place = _corner(profile, chain)
    if place is None:
        raise ValueError("the gap's side does not begin at a corner of the component")
    index, corner, step = place
    loop = profile.loops[index]
    new = loop.copy()
    if "bevel-angle" in wanted:
        _turn(new, _run(loop, corner, step), step, -step * wanted["bevel-angle"])
    if "face-angle" in wanted:
        _turn(new, _run(loop, corner, -step), -step, step * wanted["face-angle"])
    if "thickness" in wanted:
        root = _vertex(loop, chain[-1])
        if root is None:
            raise ValueError("the gap's side does not end at a corner of the component")
        _shift(new, _run(loop, root, step), step, wanted["thickness"])
    side = _carried(chain, loop, new)
    loops = tuple(new if k == index else old for k, old in enumerate(profile.loops))
    parts = list(section.components)
    parts[which] = dataclasses.replace(profile, loops=loops)
    gap = dataclasses.replace(section.gap, **{("side_a", "side_b")[which]: side})
    return dataclasses.replace(section, components=(parts[0], parts[1]), gap=gap)


def has_freedom(section: JointSection, which: int, name: str) -> bool:
    """Whether a component has the face that a freedom is about."""
    profile, chain = section.components[which], (section.gap.side_a, section.gap.side_b)[which]
    place = None if profile.empty else _corner(profile, chain)
    if place is None or name not in FREEDOMS:
        return False
    return name != "thickness" or _vertex(profile.loops[place[0]], chain[-1]) is not None


def _corner(profile: Profile, chain: Array) -> tuple[int, int, int] | None:
    """Loop and vertex of the mouth corner, and which way (1 or -1) the gap's side follows the loop."""
    for index, loop in enumerate(profile.loops):
        corner = _vertex(loop, chain[0])
        if corner is None:
            continue
        along = chain[1] - chain[0]
        ways = [loop[(corner + step) % len(loop)] - loop[corner] for step in (1, -1)]
        fit = [float(way @ along) / max(float(np.hypot(*way)), 1e-12) for way in ways]
        return index, corner, 1 if fit[0] >= fit[1] else -1
    return None


def _vertex(loop: Array, point: Array) -> int | None:
    away = np.hypot(*(loop - point).T)
    best = int(np.argmin(away))
    return best if away[best] < _SAME else None


def _run(loop: Array, first: int, step: int) -> list[int]:
    """Vertices of the straight face that begins at ``first``, in order, its end included."""
    n = len(loop)
    out = [first, (first + step) % n]
    way = loop[out[1]] - loop[first]
    while len(out) < n - 1:
        k = (out[-1] + step) % n
        new = loop[k] - loop[out[-1]]
        sine = way[0] * new[1] - way[1] * new[0]
        if abs(math.atan2(sine, float(way @ new))) > _STRAIGHT:
            break
        out.append(k)
    return out


def _turn(loop: Array, run: list[int], step: int, angle: float) -> None:
    """Turn a face about its first vertex; its end slides along the next face."""
    pivot, end = loop[run[0]].copy(), loop[run[-1]].copy()
    way = Pose2D(theta=angle).turn(end - pivot)
    new = _meeting(pivot, way, end, loop[(run[-1] + step) % len(loop)] - end)
    _place_run(loop, run, pivot, pivot + way if new is None else new)


def _shift(loop: Array, run: list[int], step: int, distance: float) -> None:
    """Shift a face outwards; both its ends slide along the faces beside it."""
    first, end = loop[run[0]].copy(), loop[run[-1]].copy()
    way = end - first
    # material lies to the left of a loop, so the outside is to the right of the way it runs
    out = step * np.array([way[1], -way[0]]) / max(float(np.hypot(*way)), 1e-12) * distance
    before = loop[(run[0] - step) % len(loop)]
    after = loop[(run[-1] + step) % len(loop)]
    a = _meeting(first + out, way, first, before - first)
    b = _meeting(first + out, way, end, after - end)
    _place_run(loop, run, first + out if a is None else a, end + out if b is None else b)


def _place_run(loop: Array, run: list[int], first: Array, end: Array) -> None:
    old = loop[run].copy()
    size = np.hypot(*(old - old[0]).T)
    loop[run] = first + (size / max(float(size[-1]), 1e-12))[:, None] * (end - first)


def _meeting(p: Array, d: Array, q: Array, e: Array) -> Array | None:
    """Where the lines p + t d and q + s e meet; None where they are nearly parallel."""
    cross = float(d[0] * e[1] - d[1] * e[0])
    if abs(cross) < _PARALLEL * float(np.hypot(*d)) * float(np.hypot(*e)):
        return None
    t = float((q - p)[0] * e[1] - (q - p)[1] * e[0]) / cross
    return np.asarray(p + t * d)


def _carried(chain: Array, old: Array, new: Array) -> Array:
    """A chain along a loop after the loop has changed: each point stays at its place on its edge."""
    a, b = old, np.roll(old, -1, axis=0)
    c, d = new, np.roll(new, -1, axis=0)
    way = b - a
    t = ((chain[:, None] - a) * way).sum(axis=2) / np.maximum((way * way).sum(axis=1), 1e-300)
    t = np.clip(t, 0.0, 1.0)
    near = a + t[:, :, None] * way
    best = np.argmin(np.linalg.norm(chain[:, None] - near, axis=2), axis=1)
    rows = np.arange(len(chain))
    share = t[rows, best][:, None]
    return np.asarray((1.0 - share) * c[best] + share * d[best])
