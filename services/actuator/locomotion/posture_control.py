"""Control of body height, roll and pitch by the heights of the standing feet. Pure."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.locomotion.params import PostureParams
from sextant.shared.geometry import Array


class PostureControl:
    """Integrator that commands each standing foot lower where the body sags.

    The offset of the other feet decays. A foot that touched down with the offset of the others would miss its foothold by it,
    and be overloaded or hang.
    """

    def __init__(self, params: PostureParams):
        """Begin without an offset."""
        self._params = params
        self._pressed = np.zeros(6)  # [m] by which each foot is commanded lower

    def update(self, dt: float, error: tuple[float, float, float], feet: Array, share: Array) -> None:
        """Integrate one cycle.

        Args:
            dt: [s] since the last cycle.
            error: Commanded minus measured height [m], roll and pitch [rad] of the body.
            feet: (6, 3) [m] {body} commanded feet.
            share: (6,) share of its load that each leg may carry, 0 to 1.
        """
        height, roll, pitch = error
        low = height + roll * feet[:, 1] - pitch * feet[:, 0]
        params = self._params
        self._pressed += dt * (share * params.gain * low - (1.0 - share) / params.release_s * self._pressed)
        self._pressed = np.minimum(np.maximum(self._pressed, -params.limit_m), params.limit_m)

    def lowered(self, feet: Array) -> Array:
        """Return feet (6, 3) [m] {cmd}, lower by their offsets."""
        lower = feet.copy()
        lower[:, 2] -= self._pressed
        return lower

    def reset(self, legs: NDArray[np.bool_]) -> None:
        """Discard the offsets of legs (6,)."""
        self._pressed[legs] = 0.0
