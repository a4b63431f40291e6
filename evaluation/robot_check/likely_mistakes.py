"""Likely mistakes of a profile: numbers in another unit than the profile's, and legs that are not where their names say.

A known servo model is compared with its data sheet. The other limits are far beyond what servos, materials and legs reach.
"""

import itertools
import math
from collections.abc import Iterator
from types import MappingProxyType
from typing import NamedTuple

from sextant.shared.robot.profile import LEGS, Leg, RobotProfile
from sextant.shared.robot.servo import Servo
from sextant.shared.robot.servo_proposal import AT_VOLTS, STALL_TORQUES
from sextant.shared.servo.models import MODEL_NAMED

# [1] of each unit in one of the profile
_TORQUE_UNITS = MappingProxyType({"kg cm": 10.2, "N cm": 100.0, "oz in": 141.6, "mN m": 1000.0})
_SPEED_UNITS = MappingProxyType({"rpm": 9.549, "deg/s": 57.3})
_STIFFNESS_UNITS = MappingProxyType({"N m/deg": 1.0 / 57.3, "kg cm/rad": 10.2})
_SIXTY_DEG = math.pi / 3  # [rad] that hobby servos state a time for
_NEAR = 1.7  # [1] most factor by which a number in the right unit differs from what is usual
_OTHER = 2.5  # [1] factor from which a number differs from the data sheet of its servo; voltages differ by less
_SPEEDS = (1.5, 30.0)  # [rad/s] no-load speeds of servos
_TORQUE_PER_KG = (3.0, 150.0)  # [N m/kg] stall torque over the mass of a servo; 100 is the most that is sold
_FULL_TORQUE_RAD = (0.01, 0.7)  # [rad] position error at which a servo gives its stall torque
_MOST_FRICTION = 0.15  # [1] of the stall torque
_MOST_INERTIA_S = 0.15  # [s] time constant of rotor inertia and stiffness; 0.04 is much
_MOST_DENSITY = 2e4  # [kg/m^3] of osmium
_LEAST_EDGE_M = 0.05  # [m] size of a link with its servo
_MOST_LENGTH_M = 1.0  # [m] of a part of the robot
_MOST_SPEED, _MOST_FOOT_SPEED = 2.0, 5.0  # [m/s]
_AWAY = -0.26  # [1] sine of the angle by which a leg may point to the other side, front or rear
_APART_M = 0.005  # [m] between the coxa axes of two legs


class Doubt(NamedTuple):
    """A number that is probably wrong."""

    key: str  # in the profile
    sentence: str


def doubtful_numbers(profile: RobotProfile) -> list[Doubt]:
    """Return numbers that are probably in another unit."""
    mass = max(profile.body.leg_link_masses[:2])  # [kg] of a link that carries a servo
    tables = [("servo", profile.servo), *((f"servo_groups[{k}]", servo) for k, servo in enumerate(profile.servo_groups))]
    servos = [Doubt(f"{table}.{key}", words) for table, servo in tables for key, words in doubts_of_servo(servo, mass)]
    return [*servos, *_masses(profile), *_lengths(profile), *_speeds(profile), *_angles(profile)]


def doubts_of_servo(servo: Servo, mass: float) -> Iterator[Doubt]:
    """Yield doubtful numbers of a servo of at most a mass [kg]; stiffness and friction are judged if the torque is likely."""
    torques, speeds = _data_sheet(servo)
    torque, speed = _doubtful_torque(servo, torques, mass), _doubtful_speed(servo.no_load_speed, servo.model, speeds)
    if torque:
        yield Doubt("stall_torque", torque)
    if speed:
        yield Doubt("no_load_speed", speed)
    if torque:
        return
    low, high = _FULL_TORQUE_RAD
    ratio, usual = servo.stiffness / servo.nominal_stiffness, servo.stall_torque / servo.stiffness
    if not low <= usual <= high:
        guess = _unit(ratio, _STIFFNESS_UNITS)
        words = f"{servo.stiffness:g} N m/rad, with which the stall torque needs an error of {math.degrees(usual):.3g} deg"
        yield Doubt("stiffness", f"{words}{guess}")
    if servo.friction > _MOST_FRICTION * servo.stall_torque:
        guess = _unit(servo.friction / (0.02 * servo.stall_torque), _TORQUE_UNITS)
        yield Doubt("friction", f"{servo.friction:g} N m, {servo.friction / servo.stall_torque:.0%} of the stall torque{guess}")
    inertia_s = math.sqrt(servo.armature / servo.stiffness)
    if inertia_s > _MOST_INERTIA_S:
        words = f"{servo.armature:g} kg m^2, with which a joint swings for {2 * math.pi * inertia_s:.1f} s"
        yield Doubt("armature", f"{words}: is it in kg cm^2 or g cm^2?")


def _data_sheet(servo: Servo) -> tuple[list[float], list[float]]:
    """Return the stall torques [N m] and no-load speeds [rad/s] that are known of a servo's model, at its voltages."""
    at_volts = AT_VOLTS.get(servo.model, {}).values()
    torques = [STALL_TORQUES[servo.model], *(torque for torque, _ in at_volts)] if servo.model in STALL_TORQUES else []
    speeds = [MODEL_NAMED[servo.model].no_load_speed] if servo.model in MODEL_NAMED else []
    return torques, [*speeds, *(rpm * 2.0 * math.pi / 60.0 for _, rpm in at_volts)]


def _doubtful_torque(servo: Servo, known: list[float], mass: float) -> str:
    torque, words = servo.stall_torque, f"{servo.stall_torque:g} N m"
    if known:
        usual = _nearest(torque, known)
        is_likely = 1.0 / _OTHER <= torque / usual <= _OTHER
        return "" if is_likely else f"{words}, an {servo.model} has {usual:g}{_unit(torque / usual, _TORQUE_UNITS)}"
    low, high = _TORQUE_PER_KG
    if torque > high * mass:
        unit = next((name for name, size in _TORQUE_UNITS.items() if low <= torque / size / mass <= high), "")
        return f"{words}, of a servo in a link of {mass:g} kg{f': is it in {unit}?' if unit else ''}"
    return ""


def _doubtful_speed(speed: float, model: str, known: list[float]) -> str:
    words, (low, high) = f"{speed:g} rad/s", _SPEEDS
    if known:
        usual = _nearest(speed, known)
        if 1.0 / _OTHER <= speed / usual <= _OTHER:
            return ""
        words += f", an {model} turns {usual:.3g} rad/s unloaded"
        if 1.0 / _NEAR <= _SIXTY_DEG / speed / usual <= _NEAR:
            return f"{words}: is it in seconds per 60 deg?"
        return words + _unit(speed / usual, _SPEED_UNITS)
    if low <= speed <= high:
        return ""
    words += f", servos turn {low:g} to {high:g} rad/s unloaded"
    if low <= _SIXTY_DEG / speed <= high:
        return f"{words}: is it in seconds per 60 deg?"
    guess = next((name for name, size in _SPEED_UNITS.items() if low <= speed / size <= high), "")
    return f"{words}: is it in {guess}?" if guess else words


def _masses(profile: RobotProfile) -> Iterator[Doubt]:
    body, links = profile.body, profile.links
    parts = [("body.mass", body.mass, math.prod(max(edge, _LEAST_EDGE_M) for edge in body.size), "a trunk of this size")]
    lengths = zip(body.leg_link_masses, (links.coxa, links.femur, links.tibia), strict=True)
    for k, (mass, length) in enumerate(lengths):
        parts.append((f"body.leg_link_masses[{k}]", mass, max(length, _LEAST_EDGE_M) ** 3, f"a link of {length:g} m"))
    for key, mass, volume, what in parts:
        if mass > _MOST_DENSITY * volume:
            yield Doubt(key, f"{mass:g} kg, more than {what} of metal weighs: is it in g?")


def _lengths(profile: RobotProfile) -> Iterator[Doubt]:
    links, body, stance = profile.links, profile.body, profile.stance
    of_parts = {"links.coxa": links.coxa, "links.femur": links.femur, "links.tibia": links.tibia}
    of_parts |= {f"body.size[{k}]": edge for k, edge in enumerate(body.size)}
    of_parts |= {f"legs[{i}].mount_xyz[{k}]": at for i, leg in enumerate(profile.legs) for k, at in enumerate(leg.mount_xyz)}
    of_parts |= {f"camera.mount_xyz[{k}]": at for k, at in enumerate(profile.camera.mount_xyz)}
    of_parts["camera.sensor.min_range"] = profile.camera.sensor.min_range / 3.0
    large = [Doubt(key, f"{length:g} m: is it in cm?") for key, length in of_parts.items() if abs(length) > _MOST_LENGTH_M]
    yield from large
    if large:
        return  # the length of a leg is in doubt
    leg = links.coxa + links.femur + links.tibia
    of_stance = {f"stance.foot_radius_from_coxa[{k}]": radius for k, radius in enumerate(stance.foot_radius_from_coxa)}
    of_stance |= {f"stance.body_height_range[{k}]": height for k, height in enumerate(stance.body_height_range)}
    for name in ("body_height", "search_radius", "foot_distance", "support_margin", "max_climb", "rough_lift"):
        of_stance[f"stance.{name}"] = getattr(stance, name)
    for key, length in of_stance.items():
        if length > 2.0 * leg:
            yield Doubt(key, f"{length:g} m, for legs of {leg:.2g} m: is it in cm?")
    if profile.foot.radius > links.tibia / 2:
        yield Doubt("foot.radius", f"{profile.foot.radius:g} m, at a tibia of {links.tibia:g} m: is it in cm or mm?")


def _speeds(profile: RobotProfile) -> Iterator[Doubt]:
    for key, most in (("max_speed", _MOST_SPEED), ("foot_speed", _MOST_FOOT_SPEED)):
        speed = getattr(profile.stance, key)
        if speed > most:
            yield Doubt(f"stance.{key}", f"{speed:g} m/s: is it in cm/s or mm/s?")


def _angles(profile: RobotProfile) -> Iterator[Doubt]:
    yaws = [leg.neutral_yaw_deg for leg in profile.legs]
    if 0.0 < max(map(abs, yaws)) <= math.pi + 0.01:
        yield Doubt("legs.neutral_yaw_deg", f"at most {max(map(abs, yaws)):g} deg in all legs: are they in rad?")
    pitch = profile.camera.pitch_down_deg
    if 0.0 < abs(pitch) <= math.pi / 2:
        yield Doubt("camera.pitch_down_deg", f"{pitch:g} deg: is it in rad?")


def misplaced_legs(profile: RobotProfile) -> list[str]:
    """Return sentences about legs that are on another side than their names say, point inward, or share a place."""
    found = []
    for one, other in itertools.combinations(profile.legs, 2):
        if math.dist(one.mount_xyz, other.mount_xyz) < _APART_M:
            found.append(f"{one.name} and {other.name} have one mount_xyz")
    wrong = [sentence for leg in profile.legs for sentence in _misplaced(leg)]
    if found or wrong:
        return found + wrong
    bearings = [math.atan2(y, x) for x, y, _ in profile.rest_feet().tolist()]
    for here in range(6):
        there = (here + 1) % 6
        if not 0.0 < (bearings[here] - bearings[there]) % (2.0 * math.pi) < math.pi:
            found.append(f"the resting feet of {LEGS[here]} and {LEGS[there]} are not in this order around the body")
    return found


def _misplaced(leg: Leg) -> Iterator[str]:
    """Yield what of a leg's place and direction contradicts its name."""
    side, end = leg.name.split()
    left = 1.0 if side == "left" else -1.0
    ahead = {"front": 1.0, "middle": 0.0, "rear": -1.0}[end]
    x, y, _ = leg.mount_xyz
    other_side = "right" if side == "left" else "left"
    if left * y < -_APART_M:
        yield f"the {leg.name} leg is mounted on the {other_side}: its mount_xyz[1] is {y:g}, the left is positive"
    if ahead * x < -_APART_M:
        where = "behind" if ahead > 0 else "ahead of"
        yield f"the {leg.name} leg is mounted {where} the body's middle: its mount_xyz[0] is {x:g}, the front is positive"
    yaw = math.radians(leg.neutral_yaw_deg)
    if left * math.sin(yaw) < _AWAY:
        expected = f"{-leg.neutral_yaw_deg:g}"
        yield f"the {leg.name} leg points inward: its neutral_yaw_deg is {leg.neutral_yaw_deg:g}; should it be {expected}?"
    elif ahead * math.cos(yaw) < _AWAY:
        where = "backward" if ahead > 0 else "forward"
        yield f"the {leg.name} leg points {where}: its neutral_yaw_deg is {leg.neutral_yaw_deg:g}"


def _nearest(value: float, known: list[float]) -> float:
    return min(known, key=lambda one: abs(math.log(value / one)))


def _unit(ratio: float, units: MappingProxyType[str, float]) -> str:
    """Return the question whether a number is in another unit, by its ratio to what is usual; "" if none explains it."""
    name = min(units, key=lambda one: abs(math.log(ratio / units[one])))
    return f": is it in {name}?" if 1.0 / _NEAR <= ratio / units[name] <= _NEAR else ""
