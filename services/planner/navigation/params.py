"""Parameters of the cost map, the path planner and the path follower."""

from dataclasses import dataclass

from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class CostmapParams(Params):
    """Traversability of the ground for the robot's centre; costs are additional costs per metre."""

    cell_m: float = ranged(0.05, 0.02, 0.2)  # [m] edge of a cell
    max_step_m: float = ranged(0.065, 0.005, 0.3)  # [m] maximum height difference of neighbouring cells for the legs
    seen_share: float = ranged(0.25, 0.0, 1.0)  # [1] minimum known share of a seen cell
    bare_share: float = ranged(0.8, 0.0, 1.0)  # [1] share of a cell without a foothold in reach, from which the cell is bare
    bare_width_cells: int = ranged(2, 1, 20)  # [cells] minimum width of bare ground or of a hole that stops feet
    bridged_cells: int = ranged(5, 1, 20)  # [cells] maximum width of low ground that is stepped over
    hole_looks: int = ranged(3, 1, 1000)  # looks at a place without a measurement, from which it is a hole
    blind_radius_m: float = ranged(0.55, 0.0, 2.0)  # [m] from the body, within which the camera sees nothing in any direction
    view_near_ratio: float = ranged(1.15, 1.0, 5.0)  # [1] visible ground begins at this multiple of the camera's minimum range
    view_far_m: float = ranged(1.10, 0.1, 5.0)  # [m] up to which ground counts as visible
    view_frame_share: float = ranged(0.84, 0.1, 1.0)  # [1] share of the image's width and height in which ground is visible
    shadow_m: float = ranged(0.01, 0.0, 0.2)  # [m] below the top of an obstacle, from which a place behind it is hidden
    rough_cost: float = ranged(1.5, 0.0, 1000.0)  # for a footprint in which no cell carries a foot; less if some do
    bare_cost: float = ranged(6.0, 0.0, 1000.0)  # if no foothold is in reach
    relief_cost: float = ranged(2.0, 0.0, 1000.0)  # if the ground changes by `max_step_m`
    near_cost: float = ranged(3.0, 0.0, 1000.0)  # at the required distance from an obstacle, zero at the preferred distance
    unseen_cost: float = ranged(1.0, 0.0, 1000.0)  # of unseen ground
    behind_cost: float = ranged(2.0, 0.0, 1000.0)  # of unseen ground directly behind; less for a smaller turn to see it
    beside_cost: float = ranged(40.0, 0.0, 1000.0)  # of unseen ground too close to be looked at


@dataclass(frozen=True, slots=True)
class PathFollowerParams(Params):
    """Following of a path: margins, speed of turning, and what the robot looks at before it walks on."""

    margin_m: float = ranged(0.045, 0.0, 0.5)  # [m] between the feet and an obstacle
    preferred_margin_m: float = ranged(0.20, 0.01, 2.0)  # [m] preferred additional margin
    detour_m: float = ranged(1.5, 0.1, 100.0)  # [m] maximum distance from the straight line between two waypoints
    replan_s: float = ranged(0.5, 0.0, 60.0)  # [s] minimum time between two path searches
    passed_m: float = ranged(0.10, 0.01, 1.0)  # [m] minimum radius within which an intermediate waypoint counts as passed
    look_ahead_m: float = ranged(0.25, 0.05, 2.0)  # [m] along the path, to the point that the robot walks to
    face_m: float = ranged(0.45, 0.05, 2.0)  # [m] along the path, to the point that it faces if the path is seen
    foresight_m: float = ranged(1.4, 0.1, 5.0)  # [m] along the path, within which it looks at unseen ground
    unseen_share: float = ranged(0.02, 0.0, 1.0)  # [1] share of unseen ground from which a place on the path counts as unseen
    halt_m: float = ranged(0.35, 0.0, 2.0)  # [m] distance to such a place, below which the robot turns before it walks
    turn_first_deg: float = ranged(50.0, 1.0, 180.0)  # [deg] heading error, above which the robot turns before it walks
    turn_gain: float = ranged(1.2, 0.05, 10.0)  # [1/s] yaw rate per heading error
    turn_rate_rad_s: float = ranged(0.21, 0.01, 2.0)  # [rad/s] maximum yaw rate
    switch_cost_ratio: float = ranged(0.85, 0.0, 1.0)  # [1] relative cost below which a new path replaces the current one
    off_path_m: float = ranged(0.20, 0.01, 5.0)  # [m] from the current path, beyond which a new one replaces it at any cost
    stuck_ahead_m: float = ranged(0.08, 0.0, 1.0)  # [m] from the feet along the path to the place that counts as impassable
    stuck_radius_m: float = ranged(0.08, 0.01, 1.0)  # [m] radius of an impassable place
    new_facing_deg: float = ranged(20.0, 1.0, 180.0)  # [deg] heading change, from which the robot faces another place
    faced_deg: float = ranged(6.0, 0.5, 90.0)  # [deg] heading error, below which the robot looks at a place
    turn_about_deg: float = ranged(90.0, 0.0, 180.0)  # [deg] to the first unseen place, from which it prefers a smaller turn
    in_sight_deg: float = ranged(25.0, 1.0, 90.0)  # [deg] heading error, up to which a place is in the image
    sight_m: float = ranged(1.3, 0.1, 5.0)  # [m] range at which ground is visible
    must_see_m: float = ranged(0.20, 0.0, 2.0)  # [m] beyond the blind radius: nearer places must be in the image to walk on


@dataclass(frozen=True, slots=True)
class StallParams(Params):
    """Stall detection: when the robot counts as making no progress on its path."""

    still_s: float = ranged(4.0, 0.5, 120.0)  # [s] without motion, from which the robot counts as stalled
    no_progress_s: float = ranged(16.0, 1.0, 600.0)  # [s] with motion but without progress, as where it steps back to look
    min_progress_m: float = ranged(0.05, 0.001, 1.0)  # [m] minimum motion or progress
    min_turn_deg: float = ranged(8.0, 0.5, 90.0)  # [deg] minimum turn or progress in heading
    max_resets: int = ranged(4, 0, 100)  # maximum number of new paths or places to look at that reset what was reached
    pause_s: float = ranged(2.5, 0.1, 60.0)  # [s] maximum time between two updates that counts; longer gaps are pauses
