"""A joint's mouth as a path, and the stations of its spine that lie under it."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from bimfit.geometry.path import JointPath
from bimfit.geometry.pose import Array

if TYPE_CHECKING:
    from bimfit.bim.joint import Joint

_SHARPEST = 0.4
_IN_PLANE = 1e-3
_APART = 5e-4


def mouth_paths(joint: Joint) -> tuple[JointPath, JointPath]:
    """The joint's path shifted from mid-gap to its mouth, and to its root, in case that is the side seen."""
    return _shifted(joint.path, 0.5 * joint.depth), _shifted(joint.path, -0.5 * joint.depth)


def spine_stations(path: JointPath, mouth: JointPath, along: Array) -> Array:
    """The stations of a spine whose section planes hold its mouth's points.

    Along a curve both have the same share of every facet. At a sharp corner they do not: towards its inside
    the mouth is shorter than the spine, and towards its outside there are points of the mouth that no
    section plane holds.

    Parameters
    ----------
    path, mouth : JointPath
        The spine, and the same shifted along v.
    along : ndarray, shape (k,)
        Distances along the mouth, m, ascending.

    Returns
    -------
    ndarray, shape (m,)
        Distances along the spine, m, ascending; m is less than k where a corner's outside has no plane.
    """
    if path.curved or len(path.u) == 1 or not len(along):
        return np.asarray(np.interp(along, mouth.stops, path.stops))
    leg = np.clip(np.searchsorted(mouth.stops, along, side="right") - 1, 0, len(path.u) - 1)
    points = mouth.points[leg] + (along - mouth.stops[leg])[:, None] * mouth.leg_directions[leg]
    way = np.einsum("ij,ij->i", points - path.points[leg], path.leg_directions[leg])
    inside = (way >= -_IN_PLANE) & (way <= path.leg_lengths[leg] + _IN_PLANE)
    s = path.stops[leg] + np.clip(way, 0.0, path.leg_lengths[leg])
    s = np.sort(s[inside])
    return np.asarray(s[np.diff(s, prepend=-np.inf) > _APART])


def _shifted(path: JointPath, distance: float) -> JointPath:
    """A path shifted along v; at its corners it goes on from one leg to the next."""
    before, after = path.v[:-1], path.v[1:]
    corner = _mitred(before, after)
    ends = _mitred(path.v[-1:], path.v[:1]) if path.closed else None
    first, last = (path.v[:1], path.v[-1:]) if ends is None else (ends, ends)
    v = np.concatenate([first, corner, last])
    try:
        return dataclasses.replace(path, points=path.points + distance * v)
    except ValueError:  # an arc tighter than the joint is deep
        return path


def _mitred(a: Array, b: Array) -> Array:
    """The vectors (m, 3) from a corner to where the legs shifted by unit vectors a and b meet."""
    cosine = np.einsum("ij,ij->i", a, b)
    return np.asarray((a + b) / np.maximum(1.0 + cosine, _SHARPEST)[:, None])
