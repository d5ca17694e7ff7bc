"""Small worlds for tests: two prisms along y, moved by known poses, and scans of them."""

from __future__ import annotations

import numpy as np
import trimesh

from bimfit.bim.joints import joint_between
from bimfit.bim.model import element_from_mesh, model_from_elements
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.profile import Profile
from bimfit.simulation.rangefinder import cast


def box(low, high):
    low, high = np.asarray(low, float), np.asarray(high, float)
    solid = trimesh.creation.box(high - low)
    solid.apply_translation((low + high) / 2)
    return TriangleMesh.of(solid.vertices, solid.faces)


def boards(gap, thickness, widths, length):
    """A butt joint along y, its mouth at z = 0 and x = 0: model, joint, both cross-sections (x, z)."""
    low = ((-gap / 2 - widths[0], 0.0, -thickness), (gap / 2, 0.0, -thickness))
    high = ((-gap / 2, length, 0.0), (gap / 2 + widths[1], length, 0.0))
    model = model_from_elements(
        [element_from_mesh(box(*ends), name, name) for *ends, name in zip(low, high, "AB", strict=True)]
    )
    profiles = [
        Profile.polygon([(a[0], a[2]), (b[0], a[2]), (b[0], b[2]), (a[0], b[2])])
        for a, b in zip(low, high, strict=True)
    ]
    return model, joint_between(model, "A", "B"), profiles


def fans(profiles, poses, ys, eye, bearings, sigma, rng):
    """Sweeps at ``ys`` of the cross-sections moved by ``poses``, from ``eye`` (x, z).

    ``bearings`` are counted from straight into the mouth.
    """
    moved = [profile.moved(pose) for profile, pose in zip(profiles, poses, strict=True)]
    straight = np.arctan2(-eye[1], -eye[0])
    d = np.stack([np.cos(straight + bearings), np.sin(straight + bearings)], axis=1)
    ranges = cast(moved, np.broadcast_to(eye, d.shape), d).ranges
    count, n = len(ys), len(d)
    o = np.stack([np.full(count, eye[0]), ys, np.full(count, eye[1])], axis=1)
    return LineScan.of(
        np.repeat(np.arange(count), n),
        np.repeat(o, n, axis=0),
        np.tile(np.stack([d[:, 0], 0.0 * d[:, 0], d[:, 1]], axis=1), (count, 1)),
        np.tile(ranges, count) + rng.normal(0.0, sigma, count * n),
    )


def corner_errors(result, poses, corners):
    """Distance of every measured mouth corner from the truth, shape (stations, 2), NaN where there is none.

    ``poses`` are motions in the plane (x, z), and ``corners`` (x, z) of A and B.
    """
    out = np.full((len(result.stations), 2), np.nan)
    for row, station in zip(out, result.stations, strict=True):
        frame = station.section.frame
        for k, component in enumerate(station.components):
            if component.pose is None:
                continue
            which = 0 if component.element == "A" else 1
            x, z = corners[which]
            begin = frame.to_section(np.array([x, frame.origin[1], z]))[:2]
            x, z = poses[which].apply(corners[which])
            end = frame.to_section(np.array([x, frame.origin[1], z]))[:2]
            row[k] = np.hypot(*(component.pose.apply(begin) - end))
    return out
