"""How the roadmap is grown; lengths go with the robot's size."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class PassageSettings:
    """Masri 2016, chapter 5, where it has a letter; he gives no numbers.

    Lengths marked * are shares of femur and tibia together.
    """

    body_height: float = 0.0  # [m] over the floor; 0 for the profile's own
    body_moves: int = 3  # m
    footholds: int = 3  # n
    cycles: int = 14  # l, of six steps each
    body_step: tuple[float, float] = (0.0, 0.26)  # d_bmin and d_bmax *
    body_angle_deg: float = 45.0  # alpha
    foot_step: tuple[float, float] = (0.1, 1.0)  # d_lmin and d_lmax, shares of the leg's stroke; the cone's tip is
    foot_back: float = 0.50  # * behind its end
    foot_angle_deg: float = 35.0  # beta
    drift: float = 0.12  # [m] Delta y
    lattice: float = 0.01  # [m] of the body's places
    strong: int = -2  # [cells] of the evaluation function from which a sample is taken as it is
    wide: int = -4  # [cells] that a local minimum has from which ground is wide
    weakest: int = -1  # [cells] that its local minimum must have
    margin: float = 0.03  # [m] of support: 2 cm, the feet being believed off by 1 cm
    legs_apart: float = 0.046  # [m] between the middle lines of neighbouring legs
    body_clear: float = 0.02  # [m] of the trunk over the ground
    leg_clear: float = 0.01  # [m] of the shanks' middle lines over the ground
    swing_clear: float = 0.023  # [m] of a swinging foot over the ground: 2 cm, its way being sampled
    torque: float = 0.6  # of stall that a servo may give during a step, which it bears for minutes; a third it bears for hours
    spare_deg: float = 1.0  # [deg] kept from each joint's limits, and
    spare: float = 0.003  # [m] from the ends of each leg's reach
    moved_most: float = 0.08  # [m] by which a point of a swing may be moved into reach
    repair: float = 0.03  # [m] by which a start stance may be wrong
    budget: int = 24_000  # expansions for one section
    patience: int = 1200  # expansions of the first tree, before another one is tried
    nodes: int = 100_000  # most configurations kept
    eager: float = 5.0  # weight of the cost to go
    lag_price: float = 1.0  # [steps] of a foot that has its whole stroke behind it
    crowd_price: float = 0.05  # [steps] of each expansion that came as far before
    alike: int = 2  # [cells] of body and feet within which configurations count as one
    rounds: int = 2  # of all legs that a configuration may have

    def __post_init__(self) -> None:
        for name in ("body_moves", "footholds", "cycles", "budget", "patience", "nodes", "rounds"):
            if not 0 < getattr(self, name) < 2**31:
                raise ValueError(f"a positive {name} expected, found {getattr(self, name)}")
        for name in ("body_step", "foot_step"):
            low, high = getattr(self, name)
            if not 0.0 <= low < high < np.inf:
                raise ValueError(f"{name} from at least 0 upwards expected, found {low} to {high}")
        for name in ("lattice", "torque", "eager", "alike"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"a positive {name} expected, found {getattr(self, name)}")
        for name in (
            "body_height", "foot_back", "drift", "margin", "legs_apart", "body_clear", "leg_clear", "swing_clear",
            "spare_deg", "spare", "moved_most", "repair", "lag_price", "crowd_price",
        ):  # fmt: skip
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"a {name} of at least 0 expected, found {getattr(self, name)}")
        if not self.strong <= self.weakest < 0:
            raise ValueError(f"strong at most weakest, weakest below 0, expected, found {self.strong} and {self.weakest}")
