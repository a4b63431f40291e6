"""Torque limits of servos that limit their current: XM430 and XM540."""

import pytest

from sextant.services.actuator.commissioning.limited_motion import TORQUE_SHARE, ServoNotRespondingError, limited_motion
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.servo.servo_model import Register
from tests.support.families import Bench

CURRENT = pytest.mark.parametrize("name", ["XM430-W350", "XM540-W270"])


def current_bench(name: str) -> Bench:
    """Return a bench of two servos that are set up, with torque."""
    bench = Bench(name, 2)
    bench.bus.setup()
    bench.bus.set_torque(True)
    bench.pass_time(0.02)
    return bench


@CURRENT
def test_setup_chooses_the_mode_that_limits_the_current(name: str) -> None:
    bench = Bench(name, 1)
    table = bench.model.table
    mode = table.operating_mode
    assert mode is not None
    assert bench.bus.read(1, mode) == 3, "as the factory sets it"
    bench.servos.column(table.goal_speed)[:] = 9
    bench.servos.column(table.torque_limit)[:] = 5
    bench.bus.setup()
    bench.pass_time(0.02)
    assert bench.bus.read(1, mode) == 5
    assert bench.bus.read(1, table.goal_speed) == 0, "another mode resets the profile and the limits"
    assert bench.bus.read(1, table.torque_limit) == bench.model.default(table.max_torque)


@CURRENT
@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_goal_current_limits_the_torque(name: str, share: float) -> None:
    bench = current_bench(name)
    table, stall = bench.model.table, bench.servos.motor.stall_torque
    assert bench.command.torque_limit == pytest.approx([stall] * 2), "the stall current is below the factory's limit"
    assert bench.bus.write(1, table.torque_limit, round(share * bench.model.full_torque))
    bench.pass_time(0.02)
    assert bench.command.torque_limit == pytest.approx([share * stall, stall], abs=stall / bench.model.full_torque)


@CURRENT
def test_goal_current_beyond_the_current_limit_is_refused(name: str) -> None:
    bench = current_bench(name)
    table = bench.model.table
    most = bench.model.default(table.max_torque)
    assert bench.bus.write(1, table.torque_limit, most)
    bench.bus.set_torque(False)
    assert bench.bus.write(1, table.max_torque, most - 100)
    assert not bench.bus.write(1, table.torque_limit, most - 99)
    assert bench.bus.write(1, table.torque_limit, most - 100)


@pytest.mark.parametrize(("mode", "share"), [(3, 1.0), (5, 0.5)])
def test_goal_current_has_no_effect_in_position_mode(mode: int, share: float) -> None:
    bench = current_bench("XM430-W350")
    table = bench.model.table
    assert table.operating_mode is not None
    bench.bus.set_torque(False)
    assert bench.bus.write(1, table.operating_mode, mode)
    assert bench.bus.write(1, table.torque_limit, round(0.5 * bench.model.full_torque))
    bench.bus.set_torque(True)
    bench.pass_time(0.02)
    assert bench.command.torque_limit[0] == pytest.approx(share * bench.servos.motor.stall_torque, rel=5e-3)


@pytest.mark.parametrize(("mode", "accepted"), [(3, False), (5, True)])
def test_position_limits_have_an_effect_in_position_mode_only(mode: int, accepted: bool) -> None:
    bench = Bench("XM430-W350", 1)
    table = bench.model.table
    assert table.operating_mode is not None
    assert bench.bus.write(1, table.high_limit, 3000)
    assert bench.bus.write(1, table.operating_mode, mode)
    assert bench.bus.write(1, table.goal_position, 3100) is accepted


@CURRENT
def test_gentle_motion_limits_the_current_before_torque(name: str) -> None:
    bench = Bench(name, 2)
    bench.bus.setup()
    table = bench.model.table
    wanted = round(TORQUE_SHARE / bench.model.units.torque)
    with limited_motion(bench.bus, bench.ids):
        for i in bench.ids:
            assert bench.bus.read(i, table.torque_limit) == wanted
            assert bench.bus.read(i, table.torque_enable) == 0
        bench.bus.set_torque(True)
        bench.pass_time(0.02)
        assert bench.command.torque_limit == pytest.approx([TORQUE_SHARE * bench.servos.motor.stall_torque] * 2, rel=5e-3)
    bench.pass_time(0.02)
    seen = [(bench.bus.read(i, table.torque_limit), bench.bus.read(i, table.torque_enable)) for i in bench.ids]
    assert seen == [(bench.model.default(table.max_torque), 0)] * 2


def test_gentle_motion_does_not_begin_with_an_unconfirmed_limit() -> None:
    bench = Bench("XM430-W350", 1)
    bench.bus.setup()
    write, table = bench.bus.write, bench.model.table

    def lose(servo_id: int, register: Register, value: int) -> bool:
        return register is table.torque_limit or write(servo_id, register, value)

    bench.bus.write = lose  # type: ignore[method-assign]
    with pytest.raises(ServoNotRespondingError, match="goal current was being set"), limited_motion(bench.bus, bench.ids):
        pytest.fail("the servo has acknowledged the limit, but has another one")


def test_mixed_servos_have_their_own_torque_limit() -> None:
    models = [MODEL_NAMED[name] for name in ("XL430-W250", "XM430-W350")]
    assert models[0].table.of_bus == models[1].table.of_bus
    assert models[0].table.of_bus != MODEL_NAMED["XL-320"].table.of_bus
    assert [model.table.torque_limit.address for model in models] == [100, 102]
