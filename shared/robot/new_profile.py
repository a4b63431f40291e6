"""Robot profile from a few measures: a symmetric hexapod whose other values are proposed."""

import math
from dataclasses import dataclass, replace

import numpy as np

from sextant.shared.files import config
from sextant.shared.robot.body import Body, Foot, LegLinks
from sextant.shared.robot.profile import LEGS, Leg, RobotProfile
from sextant.shared.robot.profile_proposal import PLACEHOLDER_STANCE, proposed_camera, proposed_stance
from sextant.shared.robot.servo import Battery, Servo
from sextant.shared.robot.servo_proposal import proposed_battery, proposed_servo
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.servo.servo_model import ServoModel

_SHARES_OF_LEG = (
    0.028,
    0.028,
    0.016,
)  # as in a PhantomX, of the robot's mass, in coxa, femur and tibia link of one leg, with their servos
_FOOT_SHARE = 0.07  # foot radius relative to the tibia
_TRUNK_HEIGHT_M = 0.04
_YAW_DEG = {"front": 45.0, "middle": 90.0, "rear": 135.0}  # of the left legs
_COXA_INWARD_DEG, _COXA_OUTWARD_DEG = 45.0, 75.0  # limits towards the middle leg, and away from it
_MIDDLE_COXA_DEG = 60.0
_FEMUR_DEG, _TIBIA_DEG = (-100.0, 100.0), (-145.0, 30.0)  # servo limits with straight brackets


@dataclass(frozen=True, slots=True)
class Measures:
    """What has to be measured at a robot, or is known of it; lengths in metres, mass in kilograms."""

    coxa: float  # [m] from coxa axis to femur axis
    femur: float  # [m] from femur axis to tibia axis
    tibia: float  # [m] from tibia axis to the foot's centre
    front: float  # [m] from the middle of the body forward to the coxa axes of the front legs
    side: float  # [m] from the middle of the body sideways to these axes
    middle: float  # [m] from the middle of the body sideways to the coxa axes of the middle legs
    mass: float  # [kg] of the whole robot
    servo: str = "AX-12A"  # model of the servos

    checks = (
        *config.each("coxa femur tibia front side middle", lambda length: 0.005 <= length <= 0.5, "a length of 0.005 to 0.5 m"),
        *config.each("mass", lambda mass: 0.1 <= mass <= 30, "a mass of 0.1 to 30 kg"),
        *config.each("servo", lambda model: model in MODEL_NAMED, f"one of {', '.join(MODEL_NAMED)}"),
    )

    def __post_init__(self) -> None:
        config.verify(self)


def new_profile(name: str, measures: Measures, drive: tuple[Servo, Battery] | None = None) -> RobotProfile:
    """Return the profile of a robot that is symmetric to both of its horizontal axes, with straight brackets.

    Servo ids are 1 to 18 in the order of the legs; channels of hobby servos are 0 to 17.

    Args:
        name: Of the robot.
        measures: Its measures.
        drive: Its servos and battery; None proposes them by the model in `measures`.
    """
    servo, battery = drive or (proposed_servo(measures.servo), proposed_battery(measures.servo))
    horn = _tibia_horn_deg(servo.servo_model)
    links = LegLinks(measures.coxa, measures.femur, measures.tibia)
    coxa, femur, tibia = (round(share * measures.mass, 4) for share in _SHARES_OF_LEG)
    trunk = round(measures.mass - 6.0 * (coxa + femur + tibia), 4)
    size = np.array([2.0 * measures.front, 2.0 * min(measures.side, measures.middle), _TRUNK_HEIGHT_M])
    length, width, height = size.tolist()
    profile = RobotProfile(
        name=name,
        servo=servo,
        horn_offsets_deg=(0.0, 0.0, horn),
        links=links,
        body=Body((length, width, height), trunk, (coxa, femur, tibia)),
        foot=Foot(round(_FOOT_SHARE * measures.tibia, 4)),
        stance=PLACEHOLDER_STANCE,
        legs=tuple(_leg(k, measures, horn, 0 if servo.pulses else 1) for k in range(len(LEGS))),  # type: ignore[arg-type]
        camera=proposed_camera(size),
        battery=battery,
    )
    return replace(profile, stance=proposed_stance(profile))


def _tibia_horn_deg(model: ServoModel) -> float:
    """Return the horn offset [deg] of the tibia: a servo with a short range is mounted in the middle of the tibia's."""
    middle = sum(_TIBIA_DEG) / 2.0
    return 0.0 if math.degrees(model.units.range_rad) >= max(map(abs, _TIBIA_DEG)) else -middle


def _leg(k: int, measures: Measures, horn: float, first: int) -> Leg:
    """Return a leg, with servo limits that keep its neighbours apart.

    Args:
        k: Its number.
        measures: Of the robot.
        horn: [deg] offset of its tibia's horn.
        first: Lowest servo id of the robot.
    """
    side, place = LEGS[k].split()
    left = 1.0 if side == "left" else -1.0
    x = {"front": measures.front, "middle": 0.0, "rear": -measures.front}[place]
    y = left * (measures.middle if place == "middle" else measures.side)
    inward, outward = _COXA_INWARD_DEG, _COXA_OUTWARD_DEG
    limits = {
        "front": (-outward, inward),
        "middle": (-_MIDDLE_COXA_DEG, _MIDDLE_COXA_DEG),
        "rear": (-inward, outward),
    }[place]
    coxa = limits if left > 0 else (-limits[1], -limits[0])
    return Leg(
        name=LEGS[k],
        mount_xyz=(x, y, 0.0),
        neutral_yaw_deg=left * _YAW_DEG[place],
        servo_ids=(3 * k + first, 3 * k + first + 1, 3 * k + first + 2),
        servo_signs=(1, 1, 1),
        servo_limits_deg=(coxa, _FEMUR_DEG, (_TIBIA_DEG[0] + horn, _TIBIA_DEG[1] + horn)),
    )
