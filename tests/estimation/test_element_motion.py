"""One rigid motion from many cross-sections: known motions are found again, and what is not seen stays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bimfit.estimation.element_motion import Seen, element_motion
from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.pose import Pose2D

FAR = np.array([458657.25, 5438232.5, 112.0])


def frames(start, along, u, count=12, length=1.0, at=FAR):
    n = np.asarray(along, float)
    return [
        SectionFrame.from_axes(at + start + n * length * k / (count - 1), u, np.cross(n, u))
        for k in range(count)
    ]


def motion(shift, turn, pivot=FAR):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    T[:3, 3] = pivot + shift - T[:3, :3] @ pivot
    return T


AROUND = [
    *frames((0, 0, 0), (1, 0, 0), (0, 1, 0)),
    *frames((1, 0, 0), (0, 0, 1), (1, 0, 0)),
    *frames((0, 0, 1), (1, 0, 0), (0, 1, 0)),
]

small = st.tuples(*[st.floats(-0.02, 0.02)] * 3)


@settings(max_examples=10, deadline=None)
@given(small, small)
def test_a_motion_seen_all_around_is_found(shift, turn):
    T = motion(np.array(shift), np.array(turn))
    found = element_motion([Seen(frame, frame.drop(T)) for frame in AROUND])
    corners = FAR + np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0.2, 1]])
    want = corners @ T[:3, :3].T + T[:3, 3]
    got = corners @ found.T_world[:3, :3].T + found.T_world[:3, 3]
    # tilts leave a section's plane, which drop() knows to first order only: 0.02 rad squared on 1 m
    np.testing.assert_allclose(got, want, atol=3e-4)
    assert (found.stations, found.undetermined) == (36, 0)
    assert found.rms < 3e-4


def test_along_one_straight_joint_sliding_is_not_made_up():
    line = frames((0, 0, 0), (1, 0, 0), (0, 1, 0))
    T = motion(np.array([0.015, 0.004, -0.003]), np.array([0.002, 0.001, -0.001]))
    found = element_motion([Seen(frame, frame.drop(T)) for frame in line])
    assert found.undetermined == 1
    middle = np.append(np.mean([frame.origin for frame in line], axis=0), 1.0)
    shift = (found.T_world @ middle - middle)[:3]
    assert abs(shift[0]) < 1e-4
    np.testing.assert_allclose(shift[1:], (T @ middle - middle)[1:3], atol=2e-5)


def test_one_station_says_three_things():
    (frame,) = frames((0, 0, 0), (1, 0, 0), (0, 1, 0), count=2)[:1]
    found = element_motion([Seen(frame, Pose2D(0.004, -0.002, 0.01), np.diag([1e-8, 1e-8, 1e-6]))])
    assert (found.undetermined, found.stations) == (3, 1)
    np.testing.assert_allclose(frame.drop(found.T_world).as_array(), (0.004, -0.002, 0.01), atol=2e-5)


def test_noise_averages_out_and_shows_as_residual():
    rng = np.random.default_rng(3)
    T = motion(np.array([0.003, 0.004, -0.003]), np.array([0.004, 0.002, -0.003]))
    sigma = np.array([5e-4, 5e-4, 4e-3])
    seen = [
        Seen(f, Pose2D.from_array(f.drop(T).as_array() + rng.normal(0, sigma)), np.diag(sigma**2))
        for f in AROUND
    ]
    found = element_motion(seen)
    error = FAR @ (found.T_world - T)[:3, :3].T + (found.T_world - T)[:3, 3]
    assert np.linalg.norm(error) < 5e-4
    assert found.rms == pytest.approx(np.sqrt(2) * 5e-4, rel=0.3)


def test_nothing_seen_is_refused():
    with pytest.raises(ValueError, match="at least one station"):
        element_motion([])
