"""Parameters of the roadmap planner; lengths scale with the robot's size."""

from dataclasses import dataclass, field, fields
from typing import Self

from sextant.shared.files import config
from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class BareGroundParams(Params):
    """Bare ground: rows of cells that carry a foot only in some places, too few for normal walking."""

    half_width_m: float = ranged(0.20, 0.02, 1.0)  # [m] half width of the band ahead that is checked, about that of the feet
    carrying_share: float = ranged(0.8, 0.0, 1.0)  # [1] share of the band across that must carry a foot for normal walking


@dataclass(frozen=True, slots=True)
class GapCrossingParams(Params):
    """Roadmap planner of Masri 2016, chapter 5, with his symbols; he gives no numbers.

    Lengths marked * are shares of the sum of femur and tibia.
    """

    body_moves: int = ranged(3, 1, 100)  # number of body motions per expansion, m
    footholds: int = ranged(3, 1, 100)  # number of footholds per body motion, n
    cycles: int = ranged(14, 1, 1000)  # number of gait cycles, each of six steps, l
    body_step: tuple[float, float] = (0.0, 0.26)  # shortest and longest body motion *, d_bmin and d_bmax
    body_angle_deg: float = ranged(45.0, 1.0, 180.0)  # [deg] angle of the cone of body motions, alpha
    foot_step: tuple[float, float] = (0.1, 1.0)  # from the rear end of the leg's stroke, as shares of it, d_lmin and d_lmax
    foot_back: float = ranged(0.50, 0.0, 2.0)  # * from the rear end of the stroke back to the tip of the cone of footholds
    foot_angle_deg: float = ranged(35.0, 1.0, 180.0)  # [deg] angle of the cone of footholds, beta
    drift_m: float = ranged(0.12, 0.0, 1.0)  # [m] maximum sideways motion of the body, Delta y
    turn_deg: float = ranged(12.0, 0.0, 45.0)  # [deg] maximum turn of the body in a step, in a crossing that turns
    most_turn_deg: float = ranged(45.0, 0.0, 90.0)  # [deg] maximum yaw of the body to the strip, in a crossing that turns
    turning_drift_m: float = ranged(0.45, 0.0, 1.0)  # [m] the same as drift_m, in a crossing that turns
    sway_m: float = ranged(0.02, 0.0, 0.1)  # [m] from the body's height to lower and higher ones, in turns and on uneven strips
    uneven_m: float = ranged(0.02, 0.0, 0.5)  # [m] between the lowest and the highest footholds, from which a strip is uneven
    uneven_body_moves: int = ranged(8, 1, 100)  # number of body motions per expansion on an uneven strip, m
    lattice_m: float = ranged(0.01, 0.001, 0.1)  # [m] lattice of body places
    strong_cells: int = ranged(-2, -100, -1)  # [cells] evaluation function, up to which a sampled foothold is used unchanged
    wide_cells: int = ranged(-4, -100, -1)  # [cells] local minimum of the evaluation function, up to which ground is wide
    central_cells: int = ranged(-5, -100, -1)  # [cells] evaluation function in the middle of ground, where feet are tried first
    weakest_cells: int = ranged(-1, -100, -1)  # [cells] highest local minimum to which a sampled foothold may move
    margin_m: float = ranged(0.03, 0.0, 0.2)  # [m] support margin: 2 cm, plus 1 cm for the error of the feet
    legs_apart_m: float = ranged(0.046, 0.0, 0.2)  # [m] between the centre lines of neighbouring legs
    body_clear_m: float = ranged(0.02, 0.0, 0.2)  # [m] between trunk and ground
    leg_clear_m: float = ranged(0.01, 0.0, 0.2)  # [m] between the shanks' centre lines and the ground
    swing_clear_m: float = ranged(0.023, 0.0, 0.2)  # [m] between a swinging foot and the ground: 2 cm, plus a reserve
    torque_share: float = ranged(0.6, 0.05, 1.0)  # [1] of stall torque during a step, for minutes; a third is for hours
    joint_margin_deg: float = ranged(1.0, 0.0, 30.0)  # [deg] distance kept from each joint limit
    reach_margin_m: float = ranged(0.003, 0.0, 0.1)  # [m] distance kept from both ends of each leg's reach
    max_swing_shift_m: float = ranged(0.08, 0.0, 0.5)  # [m] maximum shift of a swing point into reach
    max_repair_m: float = ranged(0.03, 0.0, 0.2)  # [m] maximum body shift to repair a start stance
    budget: int = ranged(24_000, 1, 100_000_000)  # maximum number of expansions for one section
    patience: int = ranged(1200, 1, 100_000_000)  # expansions of the first tree, after which a new tree replaces it
    nodes: int = ranged(100_000, 1, 10_000_000)  # maximum number of configurations
    eager: float = ranged(5.0, 0.01, 1000.0)  # [1] weight of the cost to go, as in weighted A*
    lag_price: float = ranged(1.0, 0.0, 1000.0)  # [steps] cost of a foot at the rear end of its stroke
    crowd_price: float = ranged(0.05, 0.0, 1000.0)  # [steps] cost per earlier expansion with the same progress of the body
    alike_cells: int = ranged(2, 1, 100)  # [cells] of body and feet, within which configurations count as the same
    rounds: int = ranged(2, 1, 100)  # number of times that a configuration tries each leg

    checks = (
        *(
            config.together(name, lambda ends: 0.0 <= ends[0] < ends[1] <= 10.0, "two numbers of 0 to 10 in rising order")
            for name in ("body_step", "foot_step")
        ),
        config.together(
            "central_cells wide_cells strong_cells weakest_cells",
            lambda central, wide, strong, weakest: central <= wide <= strong <= weakest,
            "central_cells <= wide_cells <= strong_cells <= weakest_cells",
        ),
    )


@dataclass(frozen=True, slots=True)
class PassageSettings(GapCrossingParams):
    """Parameters of the roadmap planner, and the body height of one crossing."""

    body_height: float = 0.0  # [m] over the floor; 0 for the profile's value
    bare_ground: BareGroundParams = field(default_factory=BareGroundParams)

    @classmethod
    def of(cls, params: GapCrossingParams, bare_ground: BareGroundParams, body_height: float) -> Self:
        """Return the settings of a crossing at a body height [m]."""
        values = {one.name: getattr(params, one.name) for one in fields(params)}
        return cls(**values, body_height=body_height, bare_ground=bare_ground)

    def __post_init__(self) -> None:
        config.verify(self)
        if not 0.0 <= self.body_height < float("inf"):
            raise ValueError(f"a body_height of at least 0 expected, found {self.body_height}")
