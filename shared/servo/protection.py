"""Heat and overload protection of a servo: the conditions under which it shuts down."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Protection:
    """Conditions under which a servo shuts down.

    Duty is |motor torque| / stall torque. The values are assumed, because no public measurement exists. They make one third of
    the stall torque the continuous limit.
    """

    stall_duty: float = 0.95  # [1] overload latches after `stall_time` at this duty
    stall_time: float = 1.5  # [s]
    mean_duty: float = 0.8  # [1] overload latches when the mean duty over `mean_time` exceeds this
    mean_time: float = 10.0  # [s]
    ambient: float = 25.0  # [deg C]
    cooling_time: float = 400.0  # [s] time constant of cooling to ambient
    heating: float = 1.01  # [K/s] at a duty of 1, proportional to the square of the duty

    def final_temperature(self, duty: float) -> float:
        """Return the temperature [deg C] that a servo approaches at a root mean square duty."""
        return self.ambient + self.heating * self.cooling_time * duty**2

    def time_to_reach(self, temperature: float, duty: float) -> float:
        """Return the time [s] in which a servo heats from ambient to a temperature [deg C], infinite if it never does.

        `duty` is the root mean square over a time that is short against the cooling time.
        """
        rise = self.final_temperature(duty) - self.ambient
        wanted = temperature - self.ambient
        return math.inf if rise <= wanted else -self.cooling_time * math.log(1.0 - wanted / rise)
