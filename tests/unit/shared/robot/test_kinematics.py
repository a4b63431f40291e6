"""Laws of the leg geometry, and the corrected equations of both theses."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.shared.robot import kinematics
from sextant.shared.robot.body import LegLinks
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.robot.profiles import load_profile

Array = NDArray[np.float64]

PROFILE = load_profile("phantomx_mk2")
LINKS = PROFILE.links
FULL_TURN = 2.0 * np.pi

lengths = st.floats(0.02, 0.3)
all_links = st.builds(LegLinks, lengths, lengths, lengths)
angles = st.floats(-np.pi, np.pi)


@st.composite
def reachable(draw: st.DrawFn) -> tuple[LegLinks, Array]:
    """Draw links and a reachable foot, on the side to which the leg points.

    The side is that of the coxa axis.
    """
    links = draw(all_links)
    nearest, farthest = abs(links.femur - links.tibia), links.femur + links.tibia
    d_l = nearest + draw(st.floats(1e-6, 1.0 - 1e-6)) * (farthest - nearest)
    elevation, coxa = draw(angles), draw(angles)
    reach = links.coxa + d_l * np.cos(elevation)
    # A foot behind the coxa axis is the same point as one in front of a leg turned round.
    return links, np.array([reach * np.cos(coxa), reach * np.sin(coxa), d_l * np.sin(elevation)])


@st.composite
def knee_up(draw: st.DrawFn) -> tuple[LegLinks, Array]:
    """Draw links and joint angles with the knee up.

    The foot is in front of the coxa axis.
    """
    links = draw(all_links)
    q = np.array([draw(angles), draw(angles), draw(st.floats(-np.pi + 0.05, -0.05))])
    reach = links.coxa + links.femur * np.cos(q[1]) + links.tibia * np.cos(q[1] + q[2])
    return links, q if reach > 0.01 else np.array([q[0], 0.3, -0.6])


def random_stances(n: int, seed: int = 1, profile: RobotProfile = PROFILE) -> Array:
    """Return (n, 6, 3) joint angles within the limits, knee up."""
    limits = profile.joint_limits.copy()
    limits[:, 2, 1] = -0.1
    return np.random.default_rng(seed).uniform(limits[..., 0], limits[..., 1], (n, 6, 3))


def wrapped(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % FULL_TURN - np.pi)


# ------------------------------------------------------------------------------------------------------ one leg


@given(reachable())
def test_forward_of_inverse_returns_point(case: tuple[LegLinks, Array]) -> None:
    links, p = case
    d_l = np.hypot(np.hypot(p[0], p[1]) - links.coxa, p[2])
    if not abs(links.femur - links.tibia) + 1e-12 < d_l < links.femur + links.tibia - 1e-12:
        return  # behind the axis and, turned round, out of reach
    q = kinematics.leg_inverse(p, links)
    np.testing.assert_allclose(kinematics.leg_forward(q, links), p, rtol=0, atol=1e-9)
    assert -np.pi <= q[2] <= 0.0


@given(knee_up())
def test_inverse_of_forward_returns_joint_angles(case: tuple[LegLinks, Array]) -> None:
    links, q = case
    back = kinematics.leg_inverse(kinematics.leg_forward(q, links), links)
    np.testing.assert_allclose(wrapped(back - q), 0.0, atol=1e-7)


@given(all_links)
def test_zero_angles_give_straight_leg(links: LegLinks) -> None:
    straight = np.array([links.coxa + links.femur + links.tibia, 0.0, 0.0])
    np.testing.assert_allclose(kinematics.leg_forward(np.zeros(3), links), straight, atol=1e-15)


@pytest.mark.parametrize(
    ("joint", "rises"), [(0, [0, 1, 0]), (1, [0, 0, 1]), (2, [0, 0, 1])], ids=["coxa left", "femur up", "tibia up"]
)
def test_positive_angles_move_foot_as_documented(joint: int, rises: list[int]) -> None:
    q = np.zeros(3)
    q[joint] = 0.01
    moved = kinematics.leg_forward(q, LINKS) - kinematics.leg_forward(np.zeros(3), LINKS)
    assert moved @ rises > 5e-4


def test_knee_is_above_line_from_hip_to_foot() -> None:
    q = kinematics.leg_inverse(np.array([0.144, 0.0, -0.09]), LINKS)
    knee = np.array([LINKS.coxa + LINKS.femur * np.cos(q[1]), LINKS.femur * np.sin(q[1])])
    along = (knee[0] - LINKS.coxa) / (0.144 - LINKS.coxa)
    assert knee[1] > along * -0.09
    assert q[1] > 0
    assert np.radians(-130) < q[2] < np.radians(-80)


@given(st.floats(0.0, 2.0), angles, angles)
def test_only_unreachable_points_give_nan(d_l: float, elevation: float, coxa: float) -> None:
    reach = LINKS.coxa + d_l * np.cos(elevation)
    if reach <= 0.0:
        return
    p = np.array([reach * np.cos(coxa), reach * np.sin(coxa), d_l * np.sin(elevation)])
    q = kinematics.leg_inverse(p, LINKS)
    nearest, farthest = abs(LINKS.femur - LINKS.tibia), LINKS.femur + LINKS.tibia
    if d_l < nearest - 1e-9 or d_l > farthest + 1e-9:
        assert np.isnan(q).all()
    elif nearest + 1e-9 < d_l < farthest - 1e-9:
        assert np.isfinite(q).all()


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=3, max_size=3))
def test_any_input_gives_all_finite_or_all_nan_angles(p: list[float]) -> None:
    q = kinematics.leg_inverse(np.array(p), LINKS)  # warnings are errors
    assert np.isfinite(q).all() or np.isnan(q).all()


def test_unreachable_row_does_not_affect_others() -> None:
    p = np.array([[0.144, 0.0, -0.09], [1.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [0.1, 0.05, -0.12]])
    q = kinematics.leg_inverse(p, LINKS)
    assert np.isnan(q).all(axis=1).tolist() == [False, True, True, False]
    np.testing.assert_array_equal(q[3], kinematics.leg_inverse(p[3], LINKS))


@given(knee_up())
def test_jacobian_is_derivative_of_forward_kinematics(case: tuple[LegLinks, Array]) -> None:
    links, q = case
    h = 1e-6
    differences = np.stack(
        [(kinematics.leg_forward(q + h * e, links) - kinematics.leg_forward(q - h * e, links)) / (2 * h) for e in np.eye(3)],
        axis=-1,
    )
    np.testing.assert_allclose(kinematics.leg_jacobian(q, links), differences, rtol=0, atol=1e-8)


@given(knee_up(), st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3))
def test_joint_rates_solve_jacobian(case: tuple[LegLinks, Array], velocity: list[float]) -> None:
    links, q = case
    v = np.array(velocity)
    rates = kinematics.joint_rates(q, v, links)
    scale = 1.0 + np.abs(rates).max()
    np.testing.assert_allclose(kinematics.leg_jacobian(q, links) @ rates, v, rtol=0, atol=1e-12 * scale)


def test_joint_rates_are_derivative_of_inverse_kinematics() -> None:
    q = random_stances(200)
    p = kinematics.leg_forward(q, LINKS)
    near = np.hypot(p[..., 0], p[..., 1]) > 0.02
    in_front = np.cos(q[..., 0]) * p[..., 0] + np.sin(q[..., 0]) * p[..., 1] > 0.0
    q, p = q[near & in_front], p[near & in_front]
    v = np.random.default_rng(2).normal(0.0, 0.2, p.shape)
    h = 1e-6
    differences = wrapped(kinematics.leg_inverse(p + h * v, LINKS) - kinematics.leg_inverse(p - h * v, LINKS)) / (2 * h)
    np.testing.assert_allclose(kinematics.joint_rates(q, v, LINKS), differences, rtol=1e-5, atol=1e-5)
    assert len(q) > 300


def test_singular_postures_give_nan_rates() -> None:
    on_axis = kinematics.leg_inverse(np.array([0.0, 0.0, -0.1]), LINKS)
    q = np.array([[0.2, 0.3, 0.0], [0.2, 0.3, -np.pi], on_axis, [np.nan, 0.0, -1.0], [np.inf, 0.0, -1.0], [0.0, 0.6, -1.8]])
    rates = kinematics.joint_rates(q, np.full(3, 0.1), LINKS)
    assert np.isnan(rates).all(axis=1).tolist() == [True, True, True, True, True, False]
    assert np.isnan(kinematics.joint_rates(q[-1], np.array([np.inf, 0.0, 0.0]), LINKS)).all()
    assert np.isnan(kinematics.joint_rates(q[-1], np.array([0.0, np.nan, 0.0]), LINKS)).all()


@pytest.mark.parametrize(
    "call",
    [
        lambda: kinematics.leg_forward(np.zeros(2), LINKS),
        lambda: kinematics.leg_inverse(np.zeros((6, 4)), LINKS),
        lambda: kinematics.leg_jacobian(np.zeros(()), LINKS),
        lambda: kinematics.joint_rates(np.zeros(3), np.zeros(2), LINKS),
        lambda: kinematics.body_inverse(PROFILE, np.zeros((5, 3))),
        lambda: kinematics.body_forward(PROFILE, np.zeros(3)),
        lambda: kinematics.within_limits(PROFILE, np.zeros((3, 6))),
        lambda: kinematics.joint_torques(PROFILE, np.zeros((6, 3)), np.zeros(3)),
        lambda: kinematics.leg_points(PROFILE, np.zeros((6, 2))),
    ],
)
def test_wrong_shape_is_named(call: object) -> None:
    assert callable(call)
    with pytest.raises(ValueError, match=r"of shape \(\.\.\., .*\) expected, found \("):
        call()


# ------------------------------------------------------------------------------------------------------ six legs


def test_all_six_legs_survive_round_trip() -> None:
    q = random_stances(300)
    feet = kinematics.body_forward(PROFILE, q)
    again = kinematics.body_forward(PROFILE, kinematics.body_inverse(PROFILE, feet))
    reached = np.isfinite(again)
    np.testing.assert_allclose(again[reached], feet[reached], rtol=0, atol=1e-9)
    assert reached.mean() > 0.9  # the others have their foot behind the coxa axis


def test_batch_equals_single_robots() -> None:
    q = random_stances(12).reshape(3, 4, 6, 3)
    feet = kinematics.body_forward(PROFILE, q)
    again = kinematics.body_inverse(PROFILE, feet)
    points = kinematics.leg_points(PROFILE, q)
    for at in np.ndindex(3, 4):
        np.testing.assert_allclose(kinematics.body_forward(PROFILE, q[at]), feet[at], rtol=0, atol=1e-12)
        np.testing.assert_allclose(kinematics.body_inverse(PROFILE, feet[at]), again[at], rtol=0, atol=1e-9)
        foot, shank = map(np.array, kinematics.feet_and_shanks(PROFILE, q[at]))
        np.testing.assert_allclose(foot, feet[at], rtol=0, atol=1e-12)
        np.testing.assert_allclose(foot + PROFILE.links.tibia * shank, points[at][:, 2], rtol=0, atol=1e-12)
    assert points.shape == (3, 4, 6, 4, 3)
    assert kinematics.joint_torques(PROFILE, q, np.ones((6, 3))).shape == (3, 4, 6, 3)
    assert kinematics.within_limits(PROFILE, q).all()


@given(st.lists(st.one_of(st.floats(-0.4, 0.4), st.sampled_from([np.nan, np.inf, -np.inf, 1e300])), min_size=18, max_size=18))
def test_inverse_of_one_robot_is_nan_where_that_of_a_batch_is(values: list[float]) -> None:
    feet = np.array(values).reshape(6, 3)
    with np.errstate(invalid="ignore", over="ignore"):
        batch = kinematics.body_inverse(PROFILE, feet[None])[0]
    one = kinematics.body_inverse(PROFILE, feet)
    np.testing.assert_allclose(one, batch, rtol=0, atol=1e-6)  # NaN equals NaN


def test_arguments_are_not_modified() -> None:
    q, f = random_stances(1)[0], np.ones((6, 3))
    q.flags.writeable = f.flags.writeable = False
    kinematics.body_inverse(PROFILE, kinematics.body_forward(PROFILE, q))
    kinematics.joint_torques(PROFILE, q, f)
    kinematics.joint_rates(q, f, LINKS)
    kinematics.leg_points(PROFILE, q)


def test_leg_points_are_separated_by_link_lengths() -> None:
    q = random_stances(100)
    points = kinematics.leg_points(PROFILE, q)
    lengths = np.linalg.norm(np.diff(points, axis=-2), axis=-1)
    np.testing.assert_allclose(lengths, np.broadcast_to([LINKS.coxa, LINKS.femur, LINKS.tibia], lengths.shape), rtol=1e-12)
    np.testing.assert_allclose(points[..., 3, :], kinematics.body_forward(PROFILE, q), atol=1e-15)
    mounts = np.array([leg.mount_xyz for leg in PROFILE.legs])
    np.testing.assert_allclose(points[..., 0, :], np.broadcast_to(mounts, (100, 6, 3)), atol=1e-15)
    np.testing.assert_allclose(points[..., 1, 2], 0.0, atol=1e-15)  # the coxa link stays level


@pytest.mark.parametrize("height", [*PROFILE.stance.body_height_range, 0.1, 0.12])
def test_rest_stance_is_within_joint_limits(height: float) -> None:
    q = kinematics.body_inverse(PROFILE, PROFILE.rest_feet(height))
    assert kinematics.within_limits(PROFILE, q).all()
    np.testing.assert_allclose(q[:, 0], 0.0, atol=1e-12)  # each leg in its neutral direction


def test_kinematics_are_mirror_symmetric() -> None:
    mirror_leg = [1, 0, 5, 4, 3, 2]
    assert [LEGS[i].replace("left", "?").replace("right", "left").replace("?", "right") for i in range(6)] == [
        LEGS[i] for i in mirror_leg
    ]
    q = random_stances(50)
    mirrored = q[:, mirror_leg] * [-1.0, 1.0, 1.0]
    expected = kinematics.body_forward(PROFILE, q)[:, mirror_leg] * [1.0, -1.0, 1.0]
    np.testing.assert_allclose(kinematics.body_forward(PROFILE, mirrored), expected, atol=1e-12)
    limits = PROFILE.joint_limits
    np.testing.assert_allclose(-limits[mirror_leg, 0, ::-1], limits[:, 0], atol=1e-12)  # the coxas' limits too


def test_joint_torques_satisfy_virtual_work() -> None:
    """Check the principle of virtual work.

    Motors and ground together do no work on any small motion.
    """
    q = random_stances(1)[0]
    rng = np.random.default_rng(3)
    forces, dq = rng.normal(0.0, 5.0, (6, 3)), 1e-6 * rng.normal(size=(6, 3))
    moved = kinematics.body_forward(PROFILE, q + dq) - kinematics.body_forward(PROFILE, q - dq)
    work = (kinematics.joint_torques(PROFILE, q, forces) * 2 * dq).sum(axis=1) + (forces * moved).sum(axis=1)
    np.testing.assert_allclose(work, 0.0, atol=1e-14)


def test_standing_torques_load_femurs_only() -> None:
    q = kinematics.body_inverse(PROFILE, PROFILE.rest_feet())
    lift = np.zeros((6, 3))
    lift[:, 2] = 2.5 * 9.81 / 6.0
    torque = kinematics.joint_torques(PROFILE, q, lift)
    arm = PROFILE.foot_radii - LINKS.coxa
    np.testing.assert_allclose(torque[:, 1], -lift[:, 2] * arm, rtol=1e-9)
    np.testing.assert_allclose(torque[:, 0], 0.0, atol=1e-12)


# -------------------------------------------------------------------------------- Masri 2016, Tables 3.1 and 3.2

PHI, PSI, OMEGA, PI = 45.0, -3.5, 46.3, 180.0  # [deg] offsets of the thesis; phi is the neutral yaw of the outer legs
TABLE_3_1 = {  # leg: (o_C, a_C), (o_F, a_F), (o_T, a_T), in degrees of alpha, beta, gamma
    "f1": ((PHI, -1), (-PSI, -1), (-OMEGA + PI, -1)),
    "f2": ((-PHI, 1), (PSI, 1), (OMEGA - PI, 1)),
    "f3": ((0.0, 1), (PSI, 1), (OMEGA - PI, 1)),
    "f4": ((PHI, -1), (PSI, 1), (OMEGA - PI, 1)),
    "f5": ((-PHI, 1), (-PSI, -1), (-OMEGA + PI, -1)),
    "f6": ((0.0, -1), (-PSI, -1), (-OMEGA + PI, -1)),
}
TABLE_3_2 = {  # leg: coxa, femur, tibia limits [deg]
    "f1": ((-80, 42), (-105, 101), (-55, 101)),
    "f2": ((-42, 80), (-102, 103), (-104, 55)),
    "f3": ((-80, 80), (-104, 102), (-104, 55)),
    "f4": ((-80, 42), (-104, 101), (-105, 55)),
    "f5": ((-42, 80), (-104, 102), (-55, 99)),
    "f6": ((-80, 80), (-104, 102), (-55, 99)),
}
ROWS = list(TABLE_3_1)
IN_THE_TABLE = {"f1": 0, "f2": 1, "f3": 2, "f4": 3, "f5": 4, "f6": 5}


def masri_alpha_beta_gamma(f: Array, leg: int) -> tuple[float, float, float]:
    """Eq. (3.2)-(3.10) with their corrections [deg].

    `f` is the foot relative to the coxa axis, along the body's axes.
    """
    outward = abs(f[1])
    ahead = abs(f[0]) if leg in (3, 4) else f[0]  # the rear legs count backwards
    alpha = np.arctan2(ahead, outward)  # (3.2)
    d_p = np.hypot(f[0], f[1]) - LINKS.coxa  # (3.3)
    d_l = np.hypot(d_p, f[2])  # (3.4)
    delta = np.arctan(f[2] / d_p)  # (3.5): d_p instead of d_l; without the minus, since z points up here
    epsilon = np.arccos((d_l**2 + LINKS.femur**2 - LINKS.tibia**2) / (2 * d_l * LINKS.femur))  # (3.7)
    gamma = np.arccos((LINKS.femur**2 + LINKS.tibia**2 - d_l**2) / (2 * LINKS.femur * LINKS.tibia))  # (3.10)
    return float(np.degrees(alpha)), float(np.degrees(delta + epsilon)), float(np.degrees(gamma))


def feet_around_rest(n: int) -> Array:
    """Return (n, 6, 3) feet within a step of the resting stance."""
    rng = np.random.default_rng(4)
    return PROFILE.rest_feet() + rng.uniform([-0.03, -0.03, -0.03], [0.03, 0.03, 0.02], (n, 6, 3))


@pytest.mark.parametrize("row", ROWS)
def test_servo_map_equals_table_3_1(row: str) -> None:
    leg = IN_THE_TABLE[row]
    for feet in feet_around_rest(50):
        ours = 150.0 + np.degrees(PROFILE.servo_angles(kinematics.body_inverse(PROFILE, feet)))[leg]
        angles = masri_alpha_beta_gamma(feet[leg] - np.array(PROFILE.legs[leg].mount_xyz), leg)
        his = [150.0 + o + a * angle for (o, a), angle in zip(TABLE_3_1[row], angles, strict=True)]  # (3.11)-(3.13)
        np.testing.assert_allclose(ours, his, atol=1e-9)


@pytest.mark.parametrize("row", ROWS)
def test_joint_limits_equal_table_3_2(row: str) -> None:
    leg = IN_THE_TABLE[row]
    corners = np.sort(np.degrees(PROFILE.servo_angles(np.moveaxis(PROFILE.joint_limits, -1, 0))), axis=0)[:, leg]
    np.testing.assert_allclose(corners.T, TABLE_3_2[row], atol=1e-9)
    for joint, limits in enumerate(TABLE_3_2[row]):
        for limit, inwards in zip(limits, (1.0, -1.0), strict=True):
            servo = np.zeros((6, 3))
            servo[leg, joint] = np.radians(limit + inwards * 1e-6)
            assert kinematics.within_limits(PROFILE, PROFILE.joint_angles(servo))[leg, joint]
            servo[leg, joint] = np.radians(limit - inwards * 1e-6)
            assert not kinematics.within_limits(PROFILE, PROFILE.joint_angles(servo))[leg, joint]


def test_nan_is_not_within_limits() -> None:
    assert not kinematics.within_limits(PROFILE, np.full((6, 3), np.nan)).any()


def test_masri_3_5_needs_the_horizontal_reach() -> None:
    f = np.array([0.144, 0.0, -0.09])
    d_p = f[0] - LINKS.coxa
    d_l = np.hypot(d_p, f[2])
    q = kinematics.leg_inverse(f, LINKS)
    epsilon = np.arccos((d_l**2 + LINKS.femur**2 - LINKS.tibia**2) / (2 * d_l * LINKS.femur))
    as_corrected = np.array([0.0, np.arctan(f[2] / d_p) + epsilon, q[2]])
    as_printed = np.array([0.0, np.arctan(f[2] / d_l) + epsilon, q[2]])
    np.testing.assert_allclose(kinematics.leg_forward(as_corrected, LINKS), f, atol=1e-12)
    assert np.linalg.norm(kinematics.leg_forward(as_printed, LINKS) - f) > 0.01


# ------------------------------------------------------------------------------------- Lotriet 2024, (5.2)-(5.13)


def lotriet_inverse(p: Array, links: LegLinks) -> tuple[Array, dict[str, Array]]:
    """Eq. (5.2)-(5.6) with their corrections, without the mounting angles pi/4, pi/2.

    x points outward as in (5.7).
    """
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    d = np.hypot(x, y)  # (5.6)
    c = np.hypot(d - links.coxa, z)  # (5.5)
    beta = np.arccos((links.femur**2 + links.tibia**2 - c**2) / (2 * links.femur * links.tibia))  # (5.4)
    alpha = np.arcsin(links.tibia * np.sin(beta) / c)  # (5.3)
    theta = np.stack([np.arctan(y / x), -alpha - np.arctan(z / (d - links.coxa)), np.pi - beta], axis=-1)  # (5.2)
    return theta, {"d": d, "c": c, "alpha": alpha, "beta": beta}


def acute_feet(n: int) -> Array:
    """Return (n, 3) feet far enough out for an acute angle at the femur.

    (5.3) assumes an acute angle.
    """
    rng = np.random.default_rng(5)
    p = rng.uniform([0.13, -0.08, -0.12], [0.22, 0.08, 0.02], (8 * n, 3))
    c = np.hypot(np.hypot(p[:, 0], p[:, 1]) - LINKS.coxa, p[:, 2])
    fits = (c**2 > LINKS.tibia**2 - LINKS.femur**2 + 1e-4) & (c < 0.95 * (LINKS.femur + LINKS.tibia))
    return p[fits][:n]


def test_corrected_lotriet_5_2_equals_inverse_kinematics() -> None:
    p = acute_feet(200)
    theta, _ = lotriet_inverse(p, LINKS)
    np.testing.assert_allclose(kinematics.leg_inverse(p, LINKS), theta * [1.0, -1.0, -1.0], atol=1e-9)
    assert len(p) == 200


def test_printed_lotriet_angles_convert_to_profile_angles() -> None:
    """Use the thesis's mounting angles, and its coxa angle.

    (5.2) prints the coxa angle as measured from y.
    """
    p = acute_feet(50)
    _, terms = lotriet_inverse(p, LINKS)
    elevation = np.arctan(p[:, 2] / (terms["d"] - LINKS.coxa))
    theta = np.stack([np.arctan2(p[:, 0], p[:, 1]), np.pi / 4 - terms["alpha"] - elevation, np.pi / 2 - terms["beta"]], axis=-1)
    q = kinematics.leg_inverse(p, LINKS)
    np.testing.assert_allclose(theta, [np.pi / 2, np.pi / 4, -np.pi / 2] - q, atol=1e-9)


def test_lotriet_5_3_takes_the_wrong_branch_near_the_body() -> None:
    p = np.array([0.12, 0.0, -0.08])  # c = 0.105 m, below sqrt(tibia^2 - femur^2) = 0.115 m: the angle is obtuse
    theta, terms = lotriet_inverse(p, LINKS)
    q = kinematics.leg_inverse(p, LINKS)
    np.testing.assert_allclose(kinematics.leg_forward(q, LINKS), p, atol=1e-12)
    assert np.linalg.norm(kinematics.leg_forward(theta * [1.0, -1.0, -1.0], LINKS) - p) > 0.01
    blunt = np.pi - terms["alpha"]
    assert q[1] == pytest.approx(blunt + np.arctan(p[2] / (p[0] - LINKS.coxa)), abs=1e-12)


def test_lotriet_5_4_as_printed_misses_the_foot() -> None:
    p = np.array([0.16, 0.0, -0.08])
    _, terms = lotriet_inverse(p, LINKS)
    q = kinematics.leg_inverse(p, LINKS)
    assert np.pi + q[2] == pytest.approx(terms["beta"], abs=1e-12)
    with_l1_l2 = (LINKS.coxa**2 + LINKS.femur**2 - terms["c"] ** 2) / (2 * LINKS.coxa * LINKS.femur)
    assert with_l1_l2 < -1.0  # the coxa and femur lengths do not even make a triangle


def test_lotriet_5_8_needs_cosines() -> None:
    q = np.array([0.0, 0.0, 0.0])
    p = kinematics.leg_forward(q, LINKS)
    as_printed = LINKS.coxa + LINKS.femur * np.sin(q[1]) + LINKS.tibia * np.sin(q[1] + q[2])
    as_corrected = LINKS.coxa + LINKS.femur * np.cos(q[1]) + LINKS.tibia * np.cos(q[1] + q[2])
    assert as_corrected == pytest.approx(p[0])
    assert as_printed == pytest.approx(LINKS.coxa)  # a straight leg would end at its own femur axis


def test_corrected_lotriet_5_9_equals_joint_rates() -> None:
    p = acute_feet(200)
    v = np.random.default_rng(6).normal(0.0, 0.1, p.shape)
    _, terms = lotriet_inverse(p, LINKS)
    d, c, beta = terms["d"], terms["c"], terms["beta"]
    l1, l2, l3 = LINKS.coxa, LINKS.femur, LINKS.tibia
    d_dot = (p[:, 0] * v[:, 0] + p[:, 1] * v[:, 1]) / d  # (5.13)
    c_dot = (-(l1 - d) * d_dot + p[:, 2] * v[:, 2]) / np.sqrt((l1 - d) ** 2 + p[:, 2] ** 2)  # (5.12)
    beta_dot = 2 * c * c_dot / (l2 * l3 * np.sqrt(4 - (l2**2 + l3**2 - c**2) ** 2 / (l2**2 * l3**2)))  # (5.11)
    alpha_dot = (  # (5.10)
        l3 * (c * np.cos(beta) * beta_dot - np.sin(beta) * c_dot) / (c**2 * np.sqrt(1 - l3**2 * np.sin(beta) ** 2 / c**2))
    )
    elevation_dot = ((d - l1) * v[:, 2] - p[:, 2] * d_dot) / ((l1 - d) ** 2 + p[:, 2] ** 2)
    omega = np.stack([(p[:, 0] * v[:, 1] - p[:, 1] * v[:, 0]) / d**2, -alpha_dot - elevation_dot, -beta_dot], axis=-1)
    rates = kinematics.joint_rates(kinematics.leg_inverse(p, LINKS), v, LINKS)
    np.testing.assert_allclose(rates, omega * [1.0, -1.0, -1.0], rtol=1e-7, atol=1e-9)

    alpha = terms["alpha"]  # the second row as printed: the derivative of a product
    printed = (((l1 - d) * v[:, 2] + p[:, 2] * d_dot) * alpha) / c**2 + np.arctan((l1 - d) / p[:, 2]) * alpha_dot
    assert np.abs(printed + rates[:, 1]).max() > 0.1
    assert np.abs(printed - rates[:, 1]).max() > 0.1


def test_other_link_lengths_survive_round_trip() -> None:
    other = replace(PROFILE, links=LegLinks(0.1, 0.1, 0.1))
    q = random_stances(50)
    feet = kinematics.body_forward(other, q)
    again = kinematics.body_forward(other, kinematics.body_inverse(other, feet))
    reached = np.isfinite(again)
    np.testing.assert_allclose(again[reached], feet[reached], rtol=0, atol=1e-9)


@given(st.integers(0, 10_000))
def test_nearest_reachable_foot_is_reachable_and_keeps_reachable_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rest = PROFILE.rest_feet()
    feet = rest + rng.normal(0.0, 0.08, (6, 3))
    moved = kinematics.nearest_reachable(PROFILE, feet)
    before, after = kinematics.body_inverse(PROFILE, feet), kinematics.body_inverse(PROFILE, moved)
    tibia = PROFILE.joint_limits[:, 2]
    above_or_below = np.isnan(after).any(axis=1)  # no nearest point exists straight above or below the femur axis
    p_coxa = (PROFILE.T_coxa_body @ np.column_stack([feet, np.ones(6)])[:, :, None])[:, :3, 0]
    high = np.abs(p_coxa[:, 2]) > 0.08
    assert (~above_or_below | high | (np.hypot(p_coxa[:, 0], p_coxa[:, 1]) < 0.06)).all()
    inside = ~above_or_below
    assert (after[inside, 2] >= tibia[inside, 0] - 1e-6).all()
    assert (after[inside, 2] <= np.minimum(tibia[inside, 1], 0.0) + 1e-6).all()
    within = np.isfinite(before).all(axis=1) & (before[:, 2] > tibia[:, 0] + 0.01) & (before[:, 2] < -0.2)
    np.testing.assert_array_equal(moved[within], feet[within])


@pytest.mark.parametrize("leg", range(6))
def test_leg_out_of_reach_is_the_one_that_does_not_reach(leg: int) -> None:
    rest = PROFILE.rest_feet()
    assert kinematics.reaches(PROFILE, rest).tolist() == [True] * 6
    for way in ([0.0, 0.0, -0.3], [0.0, 0.0, 0.3], 2.0 * rest[leg]):
        far = rest.copy()
        far[leg] += way
        assert kinematics.reaches(PROFILE, np.array([rest, far]))[1].tolist() == [k != leg for k in range(6)]
