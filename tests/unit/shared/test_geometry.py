"""Laws of rotations and rigid transforms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.shared import geometry as g

Array = NDArray[np.float64]

TIGHT = 1e-12
SCALES = (1e-12, 1e-9, 1e-8, 1e-5, 1e-4, 1e-2, 1.0, 2.0, np.pi - 1e-4, np.pi - 1e-7, np.pi - 1e-9)

unit_floats = st.floats(-1.0, 1.0)


@st.composite
def directions(draw: st.DrawFn) -> Array:
    v = np.array([draw(unit_floats) for _ in range(3)])
    norm = np.linalg.norm(v)
    return v / norm if norm > 1e-3 else np.array([0.0, 0.0, 1.0])


@st.composite
def rotation_vectors(draw: st.DrawFn) -> Array:
    """Draw rotation vectors of any length up to pi, also near both ends."""
    scale = draw(st.sampled_from(SCALES) | st.floats(0.0, np.pi - 1e-9))
    return np.asarray(scale * draw(directions()))


@st.composite
def rotations(draw: st.DrawFn) -> Array:
    return g.exp_so3(draw(rotation_vectors()))


@st.composite
def transforms(draw: st.DrawFn) -> Array:
    return g.transform(draw(rotations()), [draw(st.floats(-10.0, 10.0)) for _ in range(3)])


def assert_rotation(R: Array) -> None:
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=TIGHT)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=TIGHT)


@given(directions(), directions())
def test_skew_matrix_is_cross_product(v: Array, w: Array) -> None:
    np.testing.assert_allclose(g.skew(v) @ w, np.cross(v, w), atol=TIGHT)
    np.testing.assert_array_equal(g.skew(v), -g.skew(v).T)


@given(rotation_vectors())
def test_exp_gives_rotations_and_log_inverts_it(v: Array) -> None:
    R = g.exp_so3(v)
    assert_rotation(R)
    back = g.log_so3(R)
    np.testing.assert_allclose(g.exp_so3(back), R, atol=1e-9)
    np.testing.assert_allclose(back, v, atol=1e-7)


@given(directions())
def test_log_of_half_turn_has_length_pi(axis: Array) -> None:
    back = g.log_so3(g.exp_so3(np.pi * axis))
    assert np.linalg.norm(back) == pytest.approx(np.pi, abs=1e-9)
    assert abs(back @ axis) == pytest.approx(np.pi, abs=1e-7)  # both signs are the same rotation


@given(directions(), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
def test_rotations_about_one_axis_add(axis: Array, a: float, b: float) -> None:
    np.testing.assert_allclose(g.exp_so3(a * axis) @ g.exp_so3(b * axis), g.exp_so3((a + b) * axis), atol=1e-10)


@given(st.floats(-10.0, 10.0))
def test_rotation_about_z_agrees_with_exp(angle: float) -> None:
    np.testing.assert_allclose(g.rotation_z(angle), g.rotation_from_rpy([0.0, 0.0, angle]), atol=TIGHT)
    np.testing.assert_allclose(g.rotation_z(angle), g.exp_so3([0.0, 0.0, angle]), atol=1e-10)
    T = g.transform(g.rotation_z(angle), np.zeros(3))
    assert np.cos(g.yaw_of(T) - angle) == pytest.approx(1.0, abs=TIGHT)


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_roll_pitch_yaw_round_trip(roll: float, pitch: float, yaw: float) -> None:
    R = g.rotation_from_rpy([roll, pitch, yaw])
    assert_rotation(R)
    np.testing.assert_allclose(g.rpy_from_rotation(R), [roll, pitch, yaw], atol=1e-9)
    by_parts = g.exp_so3([0, 0, yaw]) @ g.exp_so3([0, pitch, 0]) @ g.exp_so3([roll, 0, 0])
    np.testing.assert_allclose(R, by_parts, atol=1e-9)


@given(rotations())
def test_quaternion_round_trip(R: Array) -> None:
    q = g.quaternion_from_rotation(R)
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=TIGHT)
    assert q[0] >= 0.0
    np.testing.assert_allclose(g.rotation_from_quaternion(q), R, atol=1e-10)
    np.testing.assert_allclose(g.rotation_from_quaternion(-3.0 * q), R, atol=1e-10)  # sign and length do not matter


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3)]))
def test_quaternions_of_half_turns_about_axes(axis: Array) -> None:
    R = 2.0 * np.outer(axis, axis) - np.eye(3)
    np.testing.assert_allclose(g.rotation_from_quaternion(g.quaternion_from_rotation(R)), R, atol=TIGHT)


@given(transforms(), transforms(), transforms())
def test_transforms_form_a_group(A: Array, B: Array, C: Array) -> None:
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-9)
    np.testing.assert_allclose(g.inverse(A) @ A, np.eye(4), atol=1e-10)
    np.testing.assert_allclose(g.inverse(A @ B), g.inverse(B) @ g.inverse(A), atol=1e-9)


@given(transforms(), st.floats(-5.0, 5.0))
def test_apply_equals_matrix_product(T: Array, x: float) -> None:
    points = np.array([[[x, 1.0, -2.0]], [[0.0, x, 3.0]]])
    by_matrix = (T @ np.concatenate([points, np.ones((2, 1, 1))], axis=-1)[..., None])[..., :3, 0]
    np.testing.assert_allclose(g.apply(T, points), by_matrix, atol=1e-10)
    np.testing.assert_allclose(g.apply(g.inverse(T), g.apply(T, points)), points, atol=1e-9)


@given(transforms(), transforms())
def test_apply_takes_many_transforms_of_the_same_or_of_different_points(A: Array, B: Array) -> None:
    points, both = np.array([[1.0, -2.0, 3.0], [0.5, 0.0, 4.0]]), np.stack([A, B])
    np.testing.assert_allclose(g.apply(both, points), [g.apply(A, points), g.apply(B, points)], atol=1e-10)
    different = np.stack([points, 2.0 * points])
    np.testing.assert_allclose(g.apply(both, different), [g.apply(A, points), g.apply(B, 2.0 * points)], atol=1e-10)


@given(transforms())
def test_screw_motion_round_trip(T: Array) -> None:
    np.testing.assert_allclose(g.exp_se3(g.log_se3(T)), T, atol=1e-6)


@given(rotation_vectors(), st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3))
def test_twist_round_trip(w: Array, v: list[float]) -> None:
    twist = np.concatenate([v, w])
    np.testing.assert_allclose(g.log_se3(g.exp_se3(twist)), twist, atol=1e-6)
    np.testing.assert_allclose(g.exp_se3(-twist), g.inverse(g.exp_se3(twist)), atol=1e-9)
    half = g.exp_se3(0.5 * twist)
    np.testing.assert_allclose(half @ half, g.exp_se3(twist), atol=1e-9)


def test_twist_without_rotation_is_translation() -> None:
    np.testing.assert_array_equal(g.exp_se3([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]), g.transform(np.eye(3), [1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(g.log_se3(np.eye(4)), np.zeros(6))


@given(transforms(), transforms(), st.floats(0.0, 1.0))
def test_interpolation_meets_ends_at_constant_rate(A: Array, B: Array, s: float) -> None:
    np.testing.assert_allclose(g.interpolate(A, B, 0.0), A, atol=1e-9)
    np.testing.assert_allclose(g.interpolate(A, B, 1.0), B, atol=1e-6)
    whole = np.linalg.norm(g.log_so3(A[:3, :3].T @ B[:3, :3]))
    part = np.linalg.norm(g.log_so3(A[:3, :3].T @ g.interpolate(A, B, s)[:3, :3]))
    assert part == pytest.approx(s * whole, abs=1e-6)


@given(transforms(), st.integers(0, 1000))
def test_orthonormalization_removes_rounding(T: Array, seed: int) -> None:
    drifted = T.copy()
    drifted[:3, :3] += np.random.default_rng(seed).normal(0.0, 1e-6, (3, 3))
    mended = g.orthonormal(drifted)
    assert_rotation(mended[:3, :3])
    np.testing.assert_allclose(mended, T, atol=1e-5)
    np.testing.assert_allclose(g.orthonormal(T), T, atol=TIGHT)


@given(transforms(), st.integers(3, 40), st.integers(0, 1000))
def test_kabsch_recovers_motion(T: Array, n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(0.0, 1.0, (n, 3))
    found = g.align_rigid(source, g.apply(T, source), rng.uniform(0.1, 1.0, n))
    np.testing.assert_allclose(g.apply(found, source), g.apply(T, source), atol=1e-8)
    assert_rotation(found[:3, :3])


def test_kabsch_never_mirrors() -> None:
    source = np.random.default_rng(1).normal(0.0, 1.0, (20, 3))
    assert_rotation(g.align_rigid(source, source * [1.0, 1.0, -1.0])[:3, :3])
    plane = source * [1.0, 1.0, 0.0]
    assert_rotation(g.align_rigid(plane, plane)[:3, :3])


def test_kabsch_minimizes_error() -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(0.0, 1.0, (30, 3))
    target = g.apply(g.from_xyz_rpy([0.1, -0.2, 0.3], [0.1, 0.2, 0.3]), source) + rng.normal(0.0, 0.05, (30, 3))
    weights = rng.uniform(0.1, 1.0, 30)

    def cost(T: Array) -> float:
        return float((weights[:, None] * (g.apply(T, source) - target) ** 2).sum())

    best = g.align_rigid(source, target, weights)
    for twist in 1e-3 * np.vstack([np.eye(6), -np.eye(6)]):
        assert cost(g.exp_se3(twist) @ best) > cost(best)


@pytest.mark.parametrize(("source", "target"), [((2, 3), (2, 3)), ((5, 3), (4, 3)), ((5, 2), (5, 2)), ((3,), (3,))])
def test_kabsch_refuses_degenerate_points(source: tuple[int, ...], target: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"n >= 3 expected, found"):
        g.align_rigid(np.zeros(source), np.zeros(target))


def test_functions_accept_batches() -> None:
    v = np.random.default_rng(3).uniform(-1.5, 1.5, (4, 5, 6))
    v[0, 0] = 0.0
    T = g.exp_se3(v)
    assert T.shape == (4, 5, 4, 4)
    np.testing.assert_allclose(g.log_se3(T), v, atol=1e-9)
    for i, j in np.ndindex(4, 5):
        np.testing.assert_allclose(T[i, j], g.exp_se3(v[i, j]), atol=TIGHT)
        np.testing.assert_allclose(g.inverse(T)[i, j], g.inverse(T[i, j]), atol=TIGHT)
        R = T[i, j, :3, :3]
        np.testing.assert_array_equal(g.quaternion_from_rotation(T[..., :3, :3])[i, j], g.quaternion_from_rotation(R))
        np.testing.assert_allclose(g.rpy_from_rotation(T[..., :3, :3])[i, j], g.rpy_from_rotation(R), atol=TIGHT)


def test_inner_frames_of_product_cancel() -> None:
    """Transform a point from {body} to {world} by T_world_body."""
    T_world_body = g.from_xyz_rpy([1.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2])
    np.testing.assert_allclose(g.apply(T_world_body, [[1.0, 0.0, 0.0]]), [[1.0, 1.0, 0.0]], atol=TIGHT)
