"""Client of a calibration: the progress and the result that the operator's page receives."""

from typing import Any

import pytest

from sextant.services.perception.calibration import calibration_client
from sextant.services.perception.calibration.calibrated_robot import CalibrationError
from sextant.services.perception.calibration.calibration_client import CalibrationClient
from sextant.services.perception.calibration.survey import POSTURES
from sextant.shared.wire.messages import CalibrationState, Message, ModeCommand
from tests.unit.perception.calibration.measurements import PROFILE
from tests.unit.perception.calibration.test_survey import Rig


def states(said: list[Message]) -> list[CalibrationState]:
    return [message for message in said if isinstance(message, CalibrationState)]


def test_progress_and_refusal_are_published() -> None:
    client = CalibrationClient(PROFILE, "me")
    rig = Rig(client)
    begun = states(rig.run(1.0))
    assert {(state.running, state.status, state.posture) for state in begun} == {(True, "standing up", 0)}
    assert 2 <= len(begun) <= 3, "at 2 Hz"
    told = states(rig.run(100.0))
    assert client.finished
    numbers = [state.posture for state in told]
    assert numbers == sorted(numbers)
    assert {*range(1, POSTURES + 2)} <= {*numbers}
    assert any(state.status == "all postures measured; computing" for state in told)
    last = told[-1]
    assert (last.running, last.result, last.postures) == (False, (), POSTURES + 1)
    assert "the camera sees enough floor in 0% of the images" in last.refusal, "the images of this robot show nothing"
    with pytest.raises(CalibrationError, match="sees enough floor"):
        client.result()


def test_result_is_published_with_its_uncertainties(monkeypatch: pytest.MonkeyPatch) -> None:
    class Found:
        refusals = ("the floor in view is not flat",)

        def lines(self, _: Any) -> list[str]:
            return ["roll_deg  0.10 +- 0.05 deg (profile 0.00)"]

    monkeypatch.setattr(calibration_client, "calibrate", lambda *_: Found())
    client = CalibrationClient(PROFILE, "me")
    last = states(Rig(client).run(100.0))[-1]
    assert last.result == ("roll_deg  0.10 +- 0.05 deg (profile 0.00)",)
    assert last.refusal == "the floor in view is not flat"
    assert isinstance(client.result(), Found)


def test_interrupted_client_stops_the_robot_and_says_so() -> None:
    client = CalibrationClient(PROFILE, "me")
    Rig(client).run(10.0)
    stop, state = client.withdraw()
    assert isinstance(stop, ModeCommand)
    assert stop.mode == "stop"
    assert isinstance(state, CalibrationState)
    assert (state.running, state.refusal) == (False, "stopped by the operator")
