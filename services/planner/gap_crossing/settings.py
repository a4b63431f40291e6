"""Settings of the roadmap planner; lengths scale with the robot's size."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class PassageSettings:
    """Parameters of Masri 2016, chapter 5, with his symbols; he gives no numbers.

    Lengths marked * are shares of the sum of femur and tibia.
    """

    body_height: float = 0.0  # [m] over the floor; 0 for the profile's value
    body_moves: int = 3  # m
    footholds: int = 3  # n
    cycles: int = 14  # l, each of six steps
    body_step: tuple[float, float] = (0.0, 0.26)  # d_bmin and d_bmax *
    body_angle_deg: float = 45.0  # alpha
    foot_step: tuple[float, float] = (0.1, 1.0)  # d_lmin and d_lmax, shares of the leg's stroke, from its rear end
    foot_back: float = 0.50  # * from the rear end of the stroke back to the tip of the cone of footholds
    foot_angle_deg: float = 35.0  # beta
    drift: float = 0.12  # [m] Delta y
    lattice: float = 0.01  # [m] lattice of body places
    strong: int = -2  # [cells] evaluation function, up to which a sample is taken unchanged
    wide: int = -4  # [cells] local minimum, up to which ground is wide
    weakest: int = -1  # [cells] weakest permitted local minimum of a sample
    margin: float = 0.03  # [m] support margin: 2 cm, plus 1 cm for the error of the feet
    legs_apart: float = 0.046  # [m] between the centre lines of neighbouring legs
    body_clear: float = 0.02  # [m] between trunk and ground
    leg_clear: float = 0.01  # [m] between the shanks' centre lines and the ground
    swing_clear: float = 0.023  # [m] between a swinging foot and the ground: 2 cm, plus a reserve for sampling
    torque: float = 0.6  # share of stall torque during a step, sustainable for minutes; a third is sustainable for hours
    spare_deg: float = 1.0  # [deg] distance kept from each joint limit
    spare: float = 0.003  # [m] distance kept from both ends of each leg's reach
    moved_most: float = 0.08  # [m] maximum shift of a swing point into reach
    repair: float = 0.03  # [m] maximum body shift to repair a start stance
    budget: int = 24_000  # expansions for one section
    patience: int = 1200  # expansions of the first tree before another one replaces it
    nodes: int = 100_000  # maximum number of configurations
    eager: float = 5.0  # weight of the cost to go
    lag_price: float = 1.0  # [steps] price of a foot that has its whole stroke behind it
    crowd_price: float = 0.05  # [steps] price of each earlier expansion at the same progress
    alike: int = 2  # [cells] of body and feet, within which configurations count as the same
    rounds: int = 2  # of all legs that a configuration may take

    def __post_init__(self) -> None:
        for name in ("body_moves", "footholds", "cycles", "budget", "patience", "nodes", "rounds"):
            if not 0 < getattr(self, name) < 2**31:
                raise ValueError(f"a positive {name} expected, found {getattr(self, name)}")
        for name in ("body_step", "foot_step"):
            low, high = getattr(self, name)
            if not 0.0 <= low < high < np.inf:
                raise ValueError(f"{name} of at least 0 in rising order expected, found {low} to {high}")
        for name in ("lattice", "torque", "eager", "alike"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"a positive {name} expected, found {getattr(self, name)}")
        for name in (
            "body_height", "foot_back", "drift", "margin", "legs_apart", "body_clear", "leg_clear", "swing_clear",
            "spare_deg", "spare", "moved_most", "repair", "lag_price", "crowd_price",
        ):  # fmt: skip
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"a {name} of at least 0 expected, found {getattr(self, name)}")
        for name in ("body_angle_deg", "foot_angle_deg"):
            if not 0.0 < getattr(self, name) <= 180.0:
                raise ValueError(f"a {name} above 0 and up to 180 deg expected, found {getattr(self, name)}")
        if not self.wide <= self.strong <= self.weakest < 0:
            found = f"{self.wide}, {self.strong} and {self.weakest}"
            raise ValueError(f"wide <= strong <= weakest < 0 expected, found {found}")
