"""The page about servos lists every model with the numbers of its data."""

from pathlib import Path

import pytest

from sextant.shared.servo.models import MODELS
from sextant.shared.servo.servo_model import Recovery, ServoModel

PAGE = Path(__file__).parents[3].joinpath("docs/servos.md").read_text(encoding="utf-8")
ENDS = {
    Recovery.TORQUE_LIMIT: "the torque limit",
    Recovery.TORQUE_ENABLE: "torque off, then on",
    Recovery.REBOOT: "a reboot",
    Recovery.ITSELF: "its cause",
}


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_row_states_the_model(model: ServoModel) -> None:
    ticks = model.units.max_position + 1
    whole = {1024: "300", 4096: "360", 1001: "240"}[ticks]
    gain = "compliance slope" if model.table.compliance else "position gain" if model.table.position_gain else "not published"
    row = [
        model.name,
        f"{model.number}" if model.has(model.table.model_number) else "-",
        model.protocol.NAME,
        f"{ticks} in {whole} deg",
        f"{model.no_load_rpm:.0f} rpm",
        gain,
        ENDS[model.recovery],
    ]
    line = f"| {' | '.join(row)} |"
    assert line in PAGE, f"add this row to docs/servos.md: {line}"


def test_full_torque_angles_are_those_of_the_gains() -> None:
    def degrees(name: str) -> float:
        (model,) = (one for one in MODELS if one.name == name)
        gain = model.table.position_gain
        assert gain is not None
        return 180.0 / 3.141592653589793 / (model.default(gain) * model.gain_stiffness)

    found = {name: f"{degrees(name):.0f}" for name in ("MX-28", "XL430-W250", "XM430-W350")}
    assert found == {"MX-28": "22", "XL430-W250": "16", "XM430-W350": "12"}
    assert "MX-28 give its full torque at 22 deg of error, an XL430-W250 at 16 deg, an XM430-W350 at 12 deg" in PAGE
