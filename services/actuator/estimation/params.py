"""Parameters of touchdown detection and contact estimation."""

from dataclasses import dataclass

from sextant.shared.files import config
from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class TouchdownParams(Params):
    """Touchdown detection; forces are for a robot of 2.5 kg and scale with its mass."""

    touch_n: float = ranged(2.0, 0.1, 100.0)  # [N] touch limit of two readings in a row; one may be noise or a hopping foot
    hard_touch_n: float = ranged(4.5, 0.1, 100.0)  # [N] touch limit of a single reading
    bears_n: float = ranged(1.0, 0.1, 100.0)  # [N] least push of a standing foot in two readings in a row
    hard_bears_n: float = ranged(3.0, 0.1, 100.0)  # [N] the same in a single reading
    friction_ratio: float = ranged(2.5, 0.0, 20.0)  # [1] times the dry friction: the leg always decelerates at a reading
    friction_share: float = ranged(0.4, 0.0, 10.0)  # [1] of `touch_n`, by which that may exceed the friction of the servo
    doubt_share: float = ranged(0.4, 0.0, 2.0)  # [1] relative uncertainty of the torque that accelerates the leg
    inertia_ratio: float = ranged(1.6, 1.0, 5.0)  # [1] by which the inertia of a leg may differ, where servos measure no speed
    free_speed_share: float = ranged(0.75, 0.1, 1.0)  # [1] of the no-load speed: a faster femur has met nothing
    min_arm_m: float = ranged(0.06, 0.005, 0.5)  # [m] least lever arm of a foot over its femur axis; nearer, a push is noise


@dataclass(frozen=True, slots=True)
class ContactParams(Params):
    """Contact of standing feet by the torques of all joints of a leg, with hysteresis.

    The forces fall with the mass of a robot of less than 2.5 kg.
    """

    touch_n: float = ranged(1.5, 0.1, 100.0)  # [N] contact begins
    lift_n: float = ranged(0.8, 0.0, 100.0)  # [N] contact ends
    firm_n: float = ranged(3.0, 0.1, 100.0)  # [N] certain contact: above what friction and link weight cause in legs at rest
    stands_n: float = ranged(1.0, 0.1, 100.0)  # [N] push beyond friction that proves that a foot stands
    smoothing_s: float = ranged(0.08, 0.001, 2.0)  # [s] time constant
    lifted_m: float = ranged(0.006, 0.0, 0.1)  # [m] over the plane of the supporting feet, from which a foot is in the air

    checks = (config.together("lift_n touch_n", lambda lift, touch: lift <= touch, "at most touch_n"),)
