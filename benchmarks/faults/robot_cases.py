"""The faults that a robot can have, and what it can notice of them."""

from collections.abc import Iterable
from dataclasses import replace
from math import inf

from benchmarks.faults.cases import Case, OnBus
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.bus_fault import WITHOUT_FEEDBACK


def of_robot(cases: Iterable[Case], profile: RobotProfile) -> list[Case]:
    """Return those of the cases that a robot can have, with the limits that it can keep.

    Hobby servos report nothing: faults of readings and of the supply are impossible, and none of a servo is noticed. Wrong
    answers of their board may mean that all pulses are lost; then the robot stands until the operator has laid it down.
    """
    if profile.servo.pulses is None:
        return list(cases)
    return [_with_hobby_servos(case) for case in cases if all(fault in WITHOUT_FEEDBACK for fault in _on_bus(case))]


def _on_bus(case: Case) -> list[tuple[str, str]]:
    return [(deed.fault.target, deed.fault.kind) for deed in case.deeds if isinstance(deed, OnBus)]


def _with_hobby_servos(case: Case) -> Case:
    limits, faults = case.limits, _on_bus(case)
    if any(target == "servo" for target, _ in faults):
        limits = replace(limits, decided_s=inf, named="", again_s=inf, unnamed_margin_m=-inf)
    elif faults and limits.named:
        misleading = any(kind in ("stuck", "garbage") for _, kind in faults)
        limits = replace(limits, named=f"{limits.named}|board", again_s=inf if misleading else limits.again_s)
    return replace(case, limits=limits)
