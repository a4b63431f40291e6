"""The recorder on the wire of a Maestro, with given bytes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.faults.bus_log import Role
from benchmarks.faults.pulse_log import PulseRecorder
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import maestro
from sextant.shared.servo.pwm import TICKS_PER_US

PROFILE = load_profile("printed_ds3218")
PULSES = PROFILE.servo.pulses
assert PULSES is not None
CHANNELS = PROFILE.servo_ids.ravel().tolist()
UNITS = PROFILE.servo_model.units
MIDDLE = np.rint(UNITS.centre + PROFILE.servo_angles(PROFILE.joint_limits.mean(axis=-1)).ravel() / UNITS.tick_rad).astype(int)


def command(ticks: "np.ndarray | list[int]") -> bytes:
    """Return the commands that set all channels, one by one; negative ticks end the pulses."""
    widths = [round(PULSES.width_us(int(one)) * TICKS_PER_US) if one >= 0 else maestro.OFF for one in ticks]
    return b"".join(maestro.set_target(channel, width) for channel, width in zip(CHANNELS, widths, strict=True))


@given(st.integers(0, 17), st.integers(0, UNITS.max_position))
def test_goal_outside_joint_limits_is_detected_exactly(index: int, ticks: int) -> None:
    recorder, wanted = PulseRecorder(PROFILE), MIDDLE.copy()
    wanted[index] = ticks
    recorder.sent(command(wanted), 1_000_000_000)
    ends = PROFILE.servo_angles(np.moveaxis(PROFILE.joint_limits, -1, 0)).reshape(2, 18)[:, index]
    low, high = np.rint(UNITS.centre + np.sort(ends) / UNITS.tick_rad)
    found = {(out.servo, out.ticks) for out in recorder.outside}
    assert found == (set() if low <= ticks <= high else {(CHANNELS[index], ticks)})
    assert (recorder.goals[-1].ticks == wanted).all()
    assert recorder.goals[-1].t_s == 1.0


def test_end_and_return_of_pulses_are_switches_of_torque() -> None:
    recorder = PulseRecorder(PROFILE)
    recorder.heard(command(MIDDLE), 0)
    assert not recorder.switches
    recorder.heard(maestro.set_multiple_targets(min(CHANNELS), [maestro.OFF] * (max(CHANNELS) - min(CHANNELS) + 1)), 5)
    (off,) = recorder.switches
    assert (off.heard, off.role, off.values) == (True, Role.TORQUE, dict.fromkeys(sorted(CHANNELS), 0))
    recorder.heard(command(MIDDLE), 6)
    assert {servo: value for one in recorder.switches[1:] for servo, value in one.values.items()} == dict.fromkeys(CHANNELS, 1)
    assert not recorder.goals  # those that the host has sent


def test_lost_byte_is_no_goal_and_other_boards_are_refused() -> None:
    recorder = PulseRecorder(PROFILE)
    recorder.sent(maestro.set_target(CHANNELS[0], 6000)[:-1], 0)
    assert not recorder.goals
    other = replace(PROFILE, servo=replace(PROFILE.servo, pulses=replace(PULSES, board="pca9685")))
    with pytest.raises(ValueError, match="Maestro expected, found PCA9685"):
        PulseRecorder(other)
