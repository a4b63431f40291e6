"""The faults that a robot can have, and the limits that its servos let it keep."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import inf

import numpy as np

from benchmarks.faults.cases import Away, Case, Limits, OnBus
from sextant.services.actuator.locomotion.step_executor import set_down_s
from sextant.services.simulator.servo_bus.motors import motor_and_supply, powered_by
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo.bus_fault import WITHOUT_FEEDBACK
from sextant.shared.servo.servo_model import Recovery, ServoError

_DEFAULT = "phantomx_mk2"  # the robot of the limits in `cases`
_SLOWER_S = 0.4  # [s] that a robot may take longer to notice a silent servo with commands: each is read within that time
_PULSES_S = 0.06  # [s] that hobby servos may take longer to come to rest: three of their pulses
_START_S = 0.8  # [s] that the actuator may take longer to start with such servos, which need a command for each value


def of_robot(cases: Iterable[Case], profile: RobotProfile) -> list[Case]:
    """Return those of the cases that a robot can have, with the limits that it can keep.

    - Goals are at most as fast as its servos, which have 354 deg/s in the table; goals of servos with commands are sent
      in every second cycle, so that two cycles' change is seen in one.
    - Servos with heavy rotors set their feet down more slowly, and overshoot a commanded speed.
    - Hobby servos report nothing: faults of readings and of the supply are impossible, and none of a servo is noticed. The
      answers of their board are not needed to walk, so the robot may walk on while some of them are lost. Wrong ones may mean
      that all pulses are lost; then the robot stands until the operator has laid it down.
    - A constant supply, as of the RX-64 robot, does not run empty. The voltage of a battery falls with the current, so a nearly
      empty one is fuller for motors that take more than those of the table.
    - Servos with commands report no errors: a shutdown has no effect on them.
    - A servo that must reboot after a shutdown has torque again only by an operator's orders.
    """
    model, pulses = profile.servo_model, profile.servo.pulses
    supply = powered_by(motor_and_supply(profile.servo)[1], profile.battery)
    found = []
    for case in cases:
        on_bus = [(deed.fault.target, deed.fault.kind) for deed in case.deeds if isinstance(deed, OnBus)]
        if pulses and not all(fault in WITHOUT_FEEDBACK for fault in on_bus):
            continue
        if ("supply", "drain") in on_bus and supply.full_voltage == supply.empty_voltage:
            continue
        if model.errors is ServoError.NONE and ("servo", "overload") in on_bus:
            continue
        limits = _of_servos(case.limits, profile)
        if case.charge < 1.0:
            case = _fuller(case, profile)
        if model.commands:
            starts = any(isinstance(deed, Away) and deed.service == "actuator" and deed.kill for deed in case.deeds)
            limits = _with_commands(limits, on_bus, starts)
        if model.recovery is Recovery.REBOOT and ("servo", "overload") in on_bus:
            limits = replace(limits, again_s=inf)
        if pulses:
            limits = _with_hobby_servos(limits, on_bus)
        found.append(replace(case, limits=limits))
    return found


def _fuller(case: Case, profile: RobotProfile) -> Case:
    taken, of_table = (motor_and_supply(one.servo)[0].stall_current for one in (profile, load_profile(_DEFAULT)))
    return replace(case, charge=min(case.charge * max(1.0, taken / of_table), 1.0))


def _of_servos(limits: Limits, profile: RobotProfile) -> Limits:
    slower = set_down_s(profile.servos.inertia_s) / set_down_s(0.0)
    fastest = math.ceil(math.degrees(profile.servos.no_load_speed.max())) if limits.goal_dps < inf else inf
    lunge_dps = limits.lunge_dps * max(1.0, _overshoot(profile) / _overshoot(load_profile(_DEFAULT)))
    return replace(limits, rest_s=limits.rest_s * slower, goal_dps=fastest, lunge_dps=lunge_dps)


def _overshoot(profile: RobotProfile) -> float:
    """Return the highest speed of a rotor by that of its goal, which begins to move suddenly: a damped oscillator's."""
    servos = profile.servos
    ratio = min(float((servos.damping / (2.0 * np.sqrt(servos.stiffness * servos.armature))).min()), 1.0)
    return 1.0 + (math.exp(-math.pi * ratio / math.sqrt(1.0 - ratio**2)) if ratio < 1.0 else 0.0)


def _with_commands(limits: Limits, on_bus: Sequence[tuple[str, str]], starts: bool) -> Limits:
    later_s = _START_S if starts else _SLOWER_S if any(target == "servo" for target, _ in on_bus) else 0.0
    return replace(limits, decided_s=limits.decided_s + later_s, goal_dps=2.0 * limits.goal_dps)


def _with_hobby_servos(limits: Limits, on_bus: Sequence[tuple[str, str]]) -> Limits:
    limits = replace(limits, rest_s=limits.rest_s + _PULSES_S)
    if ("packets", "silent") in on_bus or any(target == "servo" for target, _ in on_bus):
        return replace(limits, decided_s=inf, named="", again_s=inf, unnamed_margin_m=-inf)
    if not on_bus or not limits.named:
        return limits
    misleading = any(kind in ("stuck", "garbage") for _, kind in on_bus)
    return replace(limits, named=f"{limits.named}|board", again_s=inf if misleading else limits.again_s)
