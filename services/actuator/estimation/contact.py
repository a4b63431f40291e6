"""Foot contact from the load of the servos, without force sensors."""

import math
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.estimation.params import ContactParams
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import link_torques
from sextant.shared.robot.profile import RobotProfile

_MIN_LEGS = 3  # minimum number of carrying feet that can support the body
_MIDDLE = np.array([[0.0], [0.0], [1.0]])  # middle of the body, as a row x, y, 1
_LEG_TRIPLES = np.array(list(combinations(range(6), 3)))  # (20, 3) all choices of three legs
_OUTSIDE_SHARE = 0.05  # share of the body weight by which its middle may lie outside of three feet
_MIN_DETERMINANT_M2 = 1e-4  # [m^2] of a leg's Jacobian in its plane: that of a PhantomX leg stretched to within 0.7 deg
_REFERENCE_MASS_KG = 2.5  # [kg] mass of the robot from which the limits of the parameters hold
_MIN_AREA_M2 = 1e-3  # [m^2] smallest triangle of feet that determines a plane


class ContactEstimate:
    """Vertical ground force per foot from motor torques, with contact hysteresis.

    The hysteresis suppresses the effect of servo friction.
    """

    def __init__(self, profile: RobotProfile, params: ContactParams | None = None):
        """Begin with no contact."""
        self._profile, self._params = profile, params or ContactParams()
        self._mass_ratio = min(1.0, profile.body.total_mass / _REFERENCE_MASS_KG)
        self._force = np.zeros(6)  # (6,) [N] smoothed upward ground forces
        self._bearing = np.zeros(6)  # (6,) [N] the same without what moves and holds the leg, and what friction may be of it
        self._q_last: Array | None = None  # (6, 3) [rad] of the last update
        self.legs: NDArray[np.bool_] = np.zeros(6, dtype=bool)  # (6,) in contact

    def update(self, q: Array, torque: Array, dt: float) -> NDArray[np.bool_]:
        """Update contact (6,) with angles [rad] and motor torques [N m], both (6, 3).

        `dt` [s] is the time since the last update; an infinite one discards all earlier updates.
        """
        legs = zip(q.tolist(), torque.tolist(), strict=True)
        force = np.array([self._ground_force(*angles[1:], *torques[1:]) for angles, torques in legs])
        share = 1.0 - math.exp(-dt / self._params.smoothing_s)
        self._force += share * (force - self._force)
        self._bearing += share * (self._borne(q, torque, dt) - self._bearing)
        touch_n, lift_n = self._mass_ratio * self._params.touch_n, self._mass_ratio * self._params.lift_n
        self.legs = np.where(self.legs, self._force > lift_n, self._force > touch_n)
        return self.legs

    def _ground_force(self, femur: float, tibia: float, femur_torque: float, tibia_torque: float) -> float:
        """Return the upward ground force [N] on a foot, from angles [rad] and motor torques [N m] of its leg.

        The motors balance the ground force f with tau = -J^T f; the femur and the tibia alone balance its part in the plane of
        the leg. The determinant of that part of J is the product of both links and the sine of the knee angle.
        """
        links, shank = self._profile.links, femur + tibia
        tibia_z = links.tibia * math.sin(shank)
        knee = links.femur * links.tibia * math.sin(tibia)
        knee = math.copysign(max(abs(knee), _MIN_DETERMINANT_M2), knee)
        return ((links.femur * math.sin(femur) + tibia_z) * tibia_torque - tibia_z * femur_torque) / knee

    def _borne(self, q: Array, torque: Array, dt: float) -> Array:
        """Return the least upward ground forces (6,) [N] that damping, dry friction and the weight of the links leave."""
        servos, last = self._profile.servos, q if self._q_last is None else self._q_last
        self._q_last = q.copy()
        left = torque - servos.damping * (q - last) / dt - link_torques(self._profile, q)
        legs = zip(q.tolist(), left.tolist(), servos.friction.tolist(), strict=True)
        return np.array([self._least_force(*angles[1:], *torques[1:], *friction[1:]) for angles, torques, friction in legs])

    def _least_force(self, femur: float, tibia: float, femur_torque: float, tibia_torque: float, *friction: float) -> float:
        """Return the upward ground force [N] less that which the dry friction [N m] of femur and tibia may feign."""
        by_femur, by_tibia = (self._ground_force(femur, tibia, *one) for one in ((1.0, 0.0), (0.0, 1.0)))  # [1/m]
        feigned = abs(by_femur) * friction[0] + abs(by_tibia) * friction[1]
        return by_femur * femur_torque + by_tibia * tibia_torque - feigned

    @property
    def stands(self) -> NDArray[np.bool_]:
        """(6,) legs that push the ground by femur and tibia, less what may be friction; horizontal forces do not hide it.

        The femur alone does not show that a foot stands if the ground also pushes it towards the body.
        """
        return np.asarray(self._bearing > self._mass_ratio * self._params.stands_n)

    @property
    def firm(self) -> NDArray[np.bool_]:
        """(6,) legs that certainly push the ground, by all their joints.

        It is valid while they move slowly or stand.
        """
        return np.asarray(self._force > self._mass_ratio * self._params.firm_n)

    def lifted(self, feet: Array) -> Array:
        """Return heights (6,) [m] of feet (6, 3) [m] {body} in the air, else 0.

        Use it for a robot whose legs were uncontrolled for a while. Friction holds a leg in the air as the ground would, so
        load alone is not sufficient. The body rests on three carrying feet around its middle, with no carrying foot below
        their plane. A foot above this plane is in the air, unless it has firm contact. Without three such feet, all carrying
        feet stand. With fewer than three carrying feet, all feet stand.
        """
        rows = np.concatenate([feet[:, :2], np.ones((6, 1))], axis=1)  # x, y, 1
        corners = rows[_LEG_TRIPLES]
        plane = np.abs(np.linalg.det(corners)) > 2.0 * _MIN_AREA_M2
        corners = np.where(plane[:, None, None], corners, np.eye(3))
        shares = np.linalg.solve(corners.swapaxes(1, 2), _MIDDLE)[..., 0]  # of the body weight
        around = (shares >= -_OUTSIDE_SHARE).all(axis=1) & self.legs[_LEG_TRIPLES].all(axis=1) & plane
        if not around.any():
            carrying = self.legs if self.legs.sum() >= _MIN_LEGS else np.ones(6, dtype=np.bool_)
            over = feet[:, 2] - feet[carrying, 2].mean()
            return np.where((over < self._params.lifted_m) | carrying, 0.0, over)
        planes = np.linalg.solve(corners, feet[_LEG_TRIPLES, 2:])[..., 0]
        over = feet[:, 2] - planes @ rows.T  # (20, 6) [m] each foot over each plane
        below = np.maximum(-over.min(axis=1, where=self.legs, initial=0.0), 0.0)
        lifted_m = self._params.lifted_m
        bearing = np.argmin(np.where(around, below - lifted_m * shares.min(axis=1), np.inf))  # ties: the widest one
        return np.where((over[bearing] < lifted_m) | self.firm, 0.0, over[bearing])
