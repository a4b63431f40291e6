"""One servo turned alone, of each family: to its middle or a little, with no effect on the others."""

from collections.abc import Callable

import numpy as np
import pytest

from sextant.services.actuator.commissioning.single_servo import WIGGLE_DEG, NotReadyError, centre, identify, wiggle
from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.actuator.servo_bus.triage import Opener
from sextant.shared.servo.models import AX_12A, MODEL_NAMED, STS3215
from sextant.shared.servo.servo_model import ServoModel
from tests.support.builder import Answer, Builder
from tests.support.desk import Desk
from tests.support.families import FAMILIES, robot_with

ONE = 7
EACH = pytest.mark.parametrize("name", FAMILIES)


class Watched(Desk):
    """A desk that records joints and torques at each packet of the host."""

    def __init__(self, name: str, *, fresh: bool = False) -> None:
        super().__init__(robot_with(name), fresh=fresh)
        self.table = self.profile.servo_model.table
        self.q: list[np.ndarray] = []
        self.torque: list[np.ndarray] = []
        receive = self.bench.receive

        def noted(data: bytes, now_ns: int) -> list[object]:
            self.q.append(self.bench._q.copy())
            self.torque.append(self.column("torque_enable").astype(bool))
            return receive(data, now_ns)  # type: ignore[return-value]

        self.bench.receive = noted  # type: ignore[method-assign,assignment]

    def column(self, role: str) -> np.ndarray:
        return self.bench._servos.column(getattr(self.table, role)).copy()

    def one(self, model: ServoModel | None = None, servo_id: int = ONE) -> ServoBus:
        model = model or self.profile.servo_model
        return bus_of(model)(self.open(model.bus_rate), [servo_id], self.clock, model=model)

    def opener(self, servo_id: int = ONE) -> Opener:
        def opened(rate: int, model: ServoModel) -> ServoBus:
            return bus_of(model)(self.open(rate), [servo_id], self.clock, model=model)

        return Opener(opened, "bench", True)


def turned(
    desk: Watched, what: Callable[..., bool], answers: list[Answer], name: str = "", servo_id: int = ONE
) -> tuple[bool, Builder]:
    builder = Builder(answers)
    return what(desk.one(servo_id=servo_id), servo_id, builder, desk.clock), builder


@EACH
def test_centre_turns_one_servo_slowly_to_its_middle_and_leaves_it_without_torque(name: str) -> None:
    desk = Watched(name)
    row, held = desk.row(ONE), list[float]()
    desk.bench._q[row] = np.radians(-70.0)
    desk.settle()
    limits = ("goal_speed", "torque_limit") if desk.profile.servo_model.commands is None else ()
    before = {role: desk.column(role) for role in limits}
    reached, builder = turned(desk, centre, [True, lambda: held.append(float(desk.bench._q[row])) or ""])
    assert reached
    assert np.degrees(held[0]) == pytest.approx(0.0, abs=2.0)
    assert "-70 deg from its middle" in builder.asked[0]
    assert builder.told == ["torque is off"]
    q, torque = np.array(desk.q), np.array(desk.torque)
    assert torque.any(axis=0).tolist() == [k == row for k in range(len(desk.bench._servos))]
    assert np.ptp(np.delete(q, row, axis=1), axis=0).max() == 0.0
    desk.settle()
    assert not desk.column("torque_enable").any()
    for role, values in before.items():
        assert (desk.column(role) == values).all(), f"{role} is restored"


@EACH
def test_model_of_a_servo_is_found_without_a_profile(name: str) -> None:
    desk = Watched(name)
    assert identify(desk.opener(), ONE).model is MODEL_NAMED[name]
    assert identify(desk.opener(), ONE, MODEL_NAMED[name]).rate == MODEL_NAMED[name].bus_rate


@pytest.mark.parametrize("name", ["RX-64", "XL430-W250", "STS3215"])
def test_new_servo_is_found_at_the_rate_of_its_factory(name: str) -> None:
    desk = Watched(name, fresh=True)
    desk.bench.plug([0])
    found = identify(desk.opener(1), 1)
    assert found.model is MODEL_NAMED[name]
    assert found.rate == pytest.approx(found.model.rates[found.model.default(found.model.table.baud_rate)], rel=0.01)


@pytest.mark.parametrize(
    ("servo_id", "model", "words"),
    [
        (99, None, "no servo with id 99 answers on bench"),
        (ONE, STS3215, "servo 7 is AX-12A, STS3215 expected"),
        (ONE, MODEL_NAMED["LX-16A"], r"no servo with id 7 answers on bench \(LewanSoul\)"),
    ],
)
def test_servo_that_is_not_there_or_another_one_is_named(servo_id: int, model: ServoModel | None, words: str) -> None:
    with pytest.raises(NotReadyError, match=words):
        identify(Watched("AX-12A").opener(servo_id), servo_id, model)


@EACH
def test_wiggle_turns_to_and_fro_and_returns(name: str) -> None:
    desk = Watched(name)
    row = desk.row(ONE)
    start = float(desk.bench._q[row])
    moved, builder = turned(desk, wiggle, [True])
    assert moved
    way = np.degrees(np.array(desk.q)[:, row] - start)
    assert np.ptp(way) == pytest.approx(WIGGLE_DEG, abs=3.0)
    assert way[-1] == pytest.approx(0.0, abs=2.0)
    desk.settle()
    assert not desk.column("torque_enable").any()
    assert builder.told == ["torque is off"]


@pytest.mark.parametrize("what", [centre, wiggle])
def test_nothing_moves_without_confirmation(what: Callable[..., bool]) -> None:
    desk = Watched("AX-12A")
    assert turned(desk, what, [False])[0] is False
    assert not np.array(desk.torque).any()


def test_other_servos_keep_their_torque() -> None:
    desk = Watched("XL430-W250")
    others = [row for row in range(18) if row != desk.row(ONE)]
    desk.bench._servos.column(desk.table.torque_enable)[others] = 1
    assert turned(desk, wiggle, [True])[0]
    desk.settle()
    assert desk.column("torque_enable")[others].all()
    assert not desk.column("torque_enable")[desk.row(ONE)]


@EACH
def test_interrupted_hold_turns_torque_off(name: str) -> None:
    def interrupt() -> str:
        raise KeyboardInterrupt

    desk = Watched(name)
    with pytest.raises(KeyboardInterrupt):
        turned(desk, centre, [True, interrupt])
    desk.settle()
    assert np.array(desk.torque)[:, desk.row(ONE)].any()
    assert not desk.column("torque_enable").any()


def test_blocked_servo_is_reported_and_has_no_torque() -> None:
    desk = Watched("AX-12A")
    row = desk.row(ONE)
    desk.bench._q[row] = np.radians(40.0)
    desk.settle()
    receive = desk.bench.receive

    def blocked(data: bytes, now_ns: int) -> list[object]:
        desk.bench._q[row] = max(desk.bench._q[row], np.radians(30.0))
        return receive(data, now_ns)  # type: ignore[return-value]

    desk.bench.receive = blocked  # type: ignore[method-assign,assignment]
    reached, builder = turned(desk, centre, [True])
    assert not reached
    assert builder.told == ["servo 7 stopped +30 deg from its middle: something blocks it", "torque is off"]
    desk.settle()
    assert not desk.column("torque_enable").any()


@pytest.mark.parametrize(
    ("role", "value", "words"),
    [
        ("torque_enable", 1, "the torque of servo 7 is on: `sextant servos off`"),
        ("high_limit", 300, "servo 7 turns from tick 0 to 300 only, and its middle is 512: `sextant servos set-id`"),
        ("high_limit", 0, "servo 7 is in wheel mode"),
    ],
)
def test_servo_that_may_not_turn_is_refused_with_the_cause(role: str, value: int, words: str) -> None:
    desk = Watched("AX-12A")
    desk.change(ONE, getattr(AX_12A.table, role), value)
    with pytest.raises(NotReadyError, match=words):
        turned(desk, centre, [])


def test_two_servos_with_one_id_are_refused() -> None:
    desk = Watched("AX-12A", fresh=True)
    desk.bench.plug([0, 1])
    with pytest.raises(NotReadyError, match="two servos have this id"):
        turned(desk, centre, [], servo_id=1)
