"""State of body and feet, by joints and inertial sensor."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.estimation.contact import ContactEstimate
from sextant.services.actuator.estimation.gravity_alignment import GravityAlignment
from sextant.services.actuator.estimation.leg_odometry import LegOdometry
from sextant.services.actuator.estimation.params import ContactParams, TouchdownParams
from sextant.services.actuator.estimation.touchdown_detector import FootContact, TouchdownDetector
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.kinematics import body_forward
from sextant.shared.robot.profile import LEGS, RobotProfile

_SLIP_M = 0.01  # [m] motion against the other standing feet that counts as slip; rolling and play reach a few millimetres


class StateEstimator:
    """Body pose in {odom}, direction of gravity, and contact of the feet.

    Call `restart` before the first cycle.
    """

    odometry: LegOdometry

    def __init__(self, profile: RobotProfile, contact: ContactParams | None = None, touchdown: TouchdownParams | None = None):
        """Begin without a measurement."""
        self.contact = ContactEstimate(profile, contact)
        self.touchdown = TouchdownDetector(profile, touchdown)
        self.gravity = GravityAlignment()
        self._profile = profile

    def restart(self, q: Array, standing: NDArray[np.bool_] | None = None) -> Array:
        """Begin a new {odom} at joint angles q (6, 3) [rad].

        The ground is level at z = 0 under the standing feet (6,), by default all of them, and the body is over their middle.

        Returns:
            (6, 3) [m] {body} measured feet.
        """
        feet = body_forward(self._profile, q)
        standing = np.ones(6, dtype=np.bool_) if standing is None else standing
        height = self._profile.foot.radius - float(feet[standing, 2].mean())
        self.odometry = LegOdometry(self._profile, q, from_xyz_rpy((0.0, 0.0, height), np.zeros(3)))
        return feet

    def lifted(self, q: Array, load: Array) -> Array:
        """Return heights (6,) [m] of feet that hang in the air, else 0.

        Args:
            q: (6, 3) [rad] joint angles.
            load: (6, 3) [N m] motor torques; earlier ones are discarded.
        """
        self.contact.update(q, load, math.inf)
        return self.contact.lifted(body_forward(self._profile, q))

    def update(self, q: Array, load: Array, standing: NDArray[np.bool_], ground: Array, dt: float) -> None:
        """Update contact and body pose.

        Args:
            q: (6, 3) [rad] measured joint angles.
            load: (6, 3) [N m] motor torques.
            standing: (6,) legs that carry.
            ground: (6,) [m] {odom} heights at which the feet were set down.
            dt: [s] since the last cycle.
        """
        self.contact.update(q, load, dt)
        self.odometry.update(q, standing, ground)

    def turn(self, dt: float, now_ns: int, step: int | None) -> Array | None:
        """Turn {odom} towards gravity; return the turn (4, 4), or None without one.

        Args:
            dt: [s] since the last cycle.
            now_ns: [ns] the time.
            step: Number of the running step; None for a standing robot.
        """
        turn = self.gravity.turn(self.odometry.T_odom_body, now_ns, dt, step)
        if turn is not None:
            self.odometry.turn(turn)
        return turn

    def foot_contact(
        self,
        awaiting: NDArray[np.bool_],
        without_torque: NDArray[np.bool_],
        known: NDArray[np.bool_],
        goals: Array,
        now_ns: int,
        bus_ns: int,
    ) -> FootContact:
        """Return the contacts of this cycle.

        Args:
            awaiting: (6,) legs that may meet ground.
            without_torque: (6,) legs with a servo without torque.
            known: (6,) legs with known foot position.
            goals: (6, 3) [rad] servo goals.
            now_ns: [ns] time of the cycle.
            bus_ns: [ns] time of the servo port.
        """
        touchdown, T_odom_body, feet = self.touchdown, self.odometry.T_odom_body, self.odometry.feet
        # A leg whose servo is silent or without torque is assumed to stand as planned, because its contact is unknown.
        return FootContact(
            touches=touchdown.touches,
            bears=touchdown.bears | touchdown.silent(bus_ns) | without_torque,
            feet=apply(T_odom_body, feet),
            pushes=self.contact.firm,
            stands=self.contact.stands,
            lifts_body=self.gravity.lifts_body(T_odom_body, feet, awaiting, now_ns),
            may_bear=touchdown.may_bear,
            known=known,
            heard=touchdown.heard(bus_ns),
            goals=apply(T_odom_body, body_forward(self._profile, goals)),
        )

    @property
    def feet_odom(self) -> Array:
        """(6, 3) [m] {odom} measured foot centres."""
        return apply(self.odometry.T_odom_body, self.odometry.feet)

    @property
    def slip_warning(self) -> str:
        """Which feet slip, or an empty string.

        Slip is motion of standing feet against each other.
        """
        if self.odometry.slip.max() <= _SLIP_M:
            return ""
        feet = [LEGS[leg] for leg in np.flatnonzero(self.odometry.slip > _SLIP_M)]
        return f"slipping: {', '.join(feet)}"
