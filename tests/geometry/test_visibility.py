"""Visible edges against a brute-force ray caster."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from bimfit.geometry.profile import Profile
from bimfit.geometry.visibility import clip_edges, visible_edges


def box(u0, v0, u1, v1):
    return Profile.polygon([(u0, v0), (u1, v0), (u1, v1), (u0, v1)])


def nearest_hit(edges, eye, bearing):
    """Distance to the first edge on a bearing and that edge's index, one edge after the other."""
    ray = np.array([math.cos(bearing), math.sin(bearing)])
    best, which = math.inf, -1
    for k, (p, q) in enumerate(edges):
        d = q - p
        det = d[0] * ray[1] - d[1] * ray[0]
        if abs(det) < 1e-15:
            continue
        w = eye - p
        along = (w[0] * ray[1] - w[1] * ray[0]) / det
        distance = (w[0] * d[1] - w[1] * d[0]) / det
        if 0.0 <= along <= 1.0 and 0.0 < distance < best:
            best, which = distance, k
    return best, which


def random_scene(rng):
    profiles = []
    for k in range(rng.integers(1, 4)):
        count = rng.integers(3, 7)
        bearing = np.sort(rng.uniform(0, 2 * math.pi, count))
        steps = np.diff(bearing, append=bearing[0] + 2 * math.pi)
        if steps.min() < 0.2 or steps.max() > 3.0:  # beyond half a turn the loop may cross itself
            continue
        loop = 0.3 * np.column_stack([np.cos(bearing), np.sin(bearing)]) * rng.uniform(0.4, 1, (count, 1))
        profiles.append(Profile.polygon(loop + np.array([0.7 * k, rng.uniform(-0.3, 0.3)])))
    return profiles


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31))
def test_every_ray_meets_what_is_called_visible_and_nothing_else(seed):
    rng = np.random.default_rng(seed)
    profiles = random_scene(rng)
    if not profiles:
        return
    eye = np.array([rng.uniform(-0.5, 2.0), 1.5])
    edges = np.concatenate([p.edges for p in profiles])
    owner = np.repeat(np.arange(len(profiles)), [len(p.edges) for p in profiles])
    seen = visible_edges(profiles, eye)
    pieces = np.concatenate(seen)
    piece_owner = np.repeat(np.arange(len(seen)), [len(s) for s in seen])
    for bearing in rng.uniform(-math.pi, 0.0, 60):
        distance, edge = nearest_hit(edges, eye, bearing)
        found, piece = nearest_hit(pieces, eye, bearing)
        if edge < 0:
            assert piece < 0
        elif piece < 0:  # only within a hair of a corner
            ray = eye + distance * np.array([math.cos(bearing), math.sin(bearing)])
            assert np.min(np.linalg.norm(edges.reshape(-1, 2) - ray, axis=1)) < 1e-6
        else:
            assert found == pytest.approx(distance, abs=1e-9)
            assert piece_owner[piece] == owner[edge]


def test_reference_scene_shows_top_and_inner_faces():
    left, right = box(-0.2125, -0.025, -0.0125, 0), box(0.0125, -0.025, 0.2125, 0)
    seen = visible_edges([left, right], (0.0, 0.25))
    for pieces in seen:
        length = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1).sum()
        assert length == pytest.approx(0.225, abs=1e-9)  # from straight above the gap's middle
    seen = visible_edges([left, right], (-0.1, 0.25))
    right_wall = seen[1][np.isclose(seen[1][:, :, 0], 0.0125).all(axis=1)]
    # sight line over A's corner: it meets u = 0.0125 at v = -0.025 * 0.25 / 0.0875, below the root
    assert np.linalg.norm(right_wall[:, 1] - right_wall[:, 0], axis=1).sum() == pytest.approx(0.025, abs=1e-9)


def test_clipped_edges_are_what_shapely_clips():
    rng = np.random.default_rng(4)
    edges = rng.uniform(-1, 1, (300, 2, 2))
    edges[:40, 1, 0] = edges[:40, 0, 0]  # upright, level and inside ones too
    edges[40:80, 1, 1] = edges[40:80, 0, 1]
    edges[80:120] *= 0.2
    low, high = np.array([-0.4, -0.3]), np.array([0.5, 0.35])
    window = shapely.box(*low, *high)
    expected = [shapely.intersection(shapely.LineString(e), window) for e in edges]
    expected = [np.array(piece.coords) for piece in expected if piece.length > 0]
    found = clip_edges(edges, low, high)
    assert len(found) == len(expected)
    for ours, theirs in zip(found, expected, strict=True):
        assert np.allclose(ours, theirs) or np.allclose(ours, theirs[::-1])
    inside = edges[80:120]
    assert np.array_equal(clip_edges(inside, -np.ones(2), np.ones(2)), inside)


def test_what_is_no_surface_hides_and_is_not_seen():
    screen = box(-1, 1, 1, 1.1)
    behind = box(-0.2, 0, 0.2, 0.1)
    open_ = Profile(screen.loops, 0.0, (np.array([False, False, True, False]),))
    assert len(visible_edges([screen, behind], (0, 3))[0])
    hidden = visible_edges([open_, behind], (0, 3))
    assert [len(pieces) for pieces in hidden] == [0, 0]


def test_nothing_to_see():
    assert visible_edges([], (0, 1)) == ()
    assert visible_edges([Profile(())], (0, 1))[0].shape == (0, 2, 2)
