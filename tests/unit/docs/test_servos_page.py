"""The page about servos lists every model with the numbers of its data."""

from pathlib import Path

import pytest

from sextant.shared.servo import dynamixel, dynamixel2
from sextant.shared.servo.models import MODELS
from sextant.shared.servo.servo_model import Recovery, ServoModel

PAGE = Path(__file__).parents[3].joinpath("docs/servos.md").read_text(encoding="utf-8")
ENDS = {
    Recovery.TORQUE_LIMIT: "the torque limit",
    Recovery.TORQUE_ENABLE: "torque off, then on",
    Recovery.REBOOT: "a reboot",
}


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_row_states_the_model(model: ServoModel) -> None:
    bus = {dynamixel: "Dynamixel Protocol 1.0", dynamixel2: "Dynamixel Protocol 2.0"}.get(model.protocol, "Feetech STS")
    ticks = model.units.max_position + 1
    whole = "300" if ticks == 1024 else "360"
    gain = "compliance slope" if model.table.compliance else "position gain"
    row = [
        model.name,
        f"{model.number}",
        bus,
        f"{ticks} in {whole} deg",
        f"{model.no_load_rpm:.0f} rpm",
        gain,
        ENDS[model.recovery],
    ]
    assert f"| {' | '.join(row)} |" in PAGE


def test_full_torque_angles_are_those_of_the_gains() -> None:
    def degrees(name: str) -> float:
        (model,) = (one for one in MODELS if one.name == name)
        gain = model.table.position_gain
        assert gain is not None
        return 180.0 / 3.141592653589793 / (model.default(gain) * model.gain_stiffness)

    found = {name: f"{degrees(name):.0f}" for name in ("MX-28", "XL430-W250", "XM430-W350")}
    assert found == {"MX-28": "22", "XL430-W250": "16", "XM430-W350": "12"}
    assert "MX-28 give its full torque at 22 deg of error, an XL430-W250 at 16 deg, an XM430-W350 at 12 deg" in PAGE
