"""SE(2) and SE(3): group axioms, and matrices as the oracle."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bimfit.geometry.pose import Pose2D, rigid_inverse, transform_points, wrap_angle

shift = st.floats(-1e3, 1e3)
angle = st.floats(-math.pi, math.pi, exclude_min=True)
poses = st.builds(Pose2D, shift, shift, angle)
points = st.tuples(shift, shift)


def same(a, b):
    np.testing.assert_allclose(a.matrix, b.matrix, atol=1e-8)


@given(poses, poses, poses)
def test_composition_is_associative(a, b, c):
    same((a @ b) @ c, a @ (b @ c))


@given(poses)
def test_identity_and_inverse(a):
    same(a @ Pose2D(), a)
    same(Pose2D() @ a, a)
    same(a @ a.inverse(), Pose2D())
    same(a.inverse() @ a, Pose2D())


@given(poses, poses, points)
def test_composition_is_the_product_of_matrices(a, b, p):
    np.testing.assert_allclose((a @ b).matrix, a.matrix @ b.matrix, atol=1e-8)
    homogeneous = a.matrix @ b.matrix @ [*p, 1.0]
    np.testing.assert_allclose((a @ b).apply(p), homogeneous[:2], atol=1e-7)


@given(poses, points, points)
def test_motions_keep_distances_and_turn_vectors(a, p, q):
    before = np.subtract(q, p)
    after = a.apply(q) - a.apply(p)
    assert np.hypot(*after) == pytest.approx(np.hypot(*before), abs=1e-8)
    np.testing.assert_allclose(after, a.turn(before), atol=1e-8)


@given(st.floats(-1e3, 1e3))
def test_wrapped_angles_are_the_same_direction(a):
    wrapped = wrap_angle(a)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - a) == pytest.approx(1.0, abs=1e-9)


@given(points, shift, shift, angle)
def test_about_keeps_its_pivot(pivot, u, v, theta):
    moved = Pose2D.about(pivot, u, v, theta).apply(pivot)
    np.testing.assert_allclose(moved, np.add(pivot, (u, v)), atol=1e-8)


@given(poses)
def test_array_round_trip(a):
    assert Pose2D.from_array(a.as_array()) == a


@given(st.integers(0, 2**31))
def test_rigid_inverse(seed):
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3] = q * np.sign(np.linalg.det(q))
    T[:3, 3] = rng.normal(size=3)
    np.testing.assert_allclose(rigid_inverse(T), np.linalg.inv(T), atol=1e-12)
    p = rng.normal(size=(5, 3))
    np.testing.assert_allclose(transform_points(rigid_inverse(T), transform_points(T, p)), p, atol=1e-12)
