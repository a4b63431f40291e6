"""What to change in a profile so that the robot can do more: changes are tried, and those that help are named."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sextant.evaluation.robot_check.gait_cycle import walk_cycle
from sextant.evaluation.robot_check.ground_limits import Obstacle, refusal
from sextant.evaluation.robot_check.walking_pace import speed_up
from sextant.shared.files.config import ConfigError
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.reach import joint_room

_HIGHER_M = _NEARER_M = 0.01  # [m] changes of the body height and of the distance of the feet
_SHORTER, _WIDER = 0.8, 1.25  # factors of stride and search radius
_LONGER = (1.1, 1.2)  # factors of the links

_Change = tuple[str, RobotProfile]  # words, and the changed robot


def ground_remedy(profile: RobotProfile, obstacle: Obstacle, value: float) -> str:
    """Return the first change with which the step planner passes an obstacle that it refuses, as the end of a sentence."""
    for words, changed in (*_of_stance(profile), *_of_links(profile)):
        if not refusal(changed, obstacle, value):
            return f"it passes that with {words}"
    return f"no other stance passes that, and no legs that are {max(_LONGER) - 1.0:.0%} longer"


def room_remedy(profile: RobotProfile, room: float) -> str:
    """Return the change of the stance that moves standing legs farthest from their joint limits, as the end of a sentence.

    Args:
        profile: The robot.
        room: [rad] present distance.
    """
    rooms = {}
    for words, changed in _of_stance(profile):
        cycle = walk_cycle(changed, "tripod")
        rooms[words] = float(joint_room(changed, cycle.q, cycle.share).min())
    best = max(rooms, key=lambda words: rooms[words])
    if rooms[best] <= room:
        return "wider legs.servo_limits_deg add to it"
    return f"wider legs.servo_limits_deg add to it, and with {best} it is {np.degrees(rooms[best]):.0f} deg"


def speed_remedy(profile: RobotProfile) -> str:
    """Return the stance with which the robot walks faster, as far as its servos bear it, as the end of a sentence."""
    faster = speed_up(profile)
    if faster is None:
        return "its servos bear no more, by joint speed, heat or lag"
    stance, speed = faster.stance, walk_cycle(faster, "tripod").speed
    return (
        f"by joint speed, heat and lag its servos bear {100 * speed:.1f} cm/s, with a stance.step_s of {stance.step_s:g} s, "
        f"a foot_speed of {stance.foot_speed:g} m/s and a max_speed of {stance.max_speed:g} m/s"
    )


def _of_stance(profile: RobotProfile) -> Iterator[_Change]:
    """Yield robots with another stance, which a builder changes without tools."""
    stance, (low, high) = profile.stance, profile.stance.body_height_range
    radii = [round(radius - _NEARER_M, 3) for radius in stance.foot_radius_from_coxa]
    higher = round(stance.body_height + _HIGHER_M, 3)
    stride, search = round(_SHORTER * stance.stride, 3), round(_WIDER * stance.search_radius, 3)
    if stance.body_height - low > 1e-3:
        yield f"a stance.body_height of {low:g} m", replace(profile, stance=replace(stance, body_height=low))
    if higher <= high:
        yield f"a stance.body_height of {higher:g} m", replace(profile, stance=replace(stance, body_height=higher))
    try:
        for words, changes in (
            (f"a stance.stride of {stride:g} m", {"stride": stride}),
            (f"a stance.search_radius of {search:g} m", {"search_radius": search}),
            (f"a stance.foot_radius_from_coxa that is {100 * _NEARER_M:.0f} cm less", {"foot_radius_from_coxa": tuple(radii)}),
        ):
            yield words, replace(profile, stance=replace(stance, **changes))
    except ConfigError:  # feet that are too near
        return


def _of_links(profile: RobotProfile) -> Iterator[_Change]:
    """Yield robots with longer links."""
    links = profile.links
    for factor in _LONGER:
        femur, tibia = round(factor * links.femur, 3), round(factor * links.tibia, 3)
        yield f"a links.tibia of {tibia:g} m", replace(profile, links=replace(links, tibia=tibia))
        both = replace(links, femur=femur, tibia=tibia)
        yield f"a links.femur of {femur:g} m and a links.tibia of {tibia:g} m", replace(profile, links=both)
