"""An attack with a role's certificate on the processes of a walking robot."""

import numpy as np
import pytest

from benchmarks.access import live_role_attack

pytestmark = [pytest.mark.live, pytest.mark.rare]


def test_robot_survives_extreme_messages_and_obeys_torque_off() -> None:
    said: list[str] = []
    (row,) = live_role_attack.measure(["robot"], 400, 1, said.append)
    assert row.messages == 400
    assert row.ended == ()
    assert len(row.off_ms) == 3
    assert np.isfinite(row.off_ms).all()
    assert said[0].startswith("robot: 400 messages")
