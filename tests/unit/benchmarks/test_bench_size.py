import json
from pathlib import Path

import pytest

from benchmarks import cli
from benchmarks.robot import size


@pytest.mark.parametrize("role", size.LIMITS_MB)
def test_robot_role_install_size_is_within_limit(role: str) -> None:
    (found,) = size.measure([role])
    assert not found.missing
    assert 50.0 < found.size_mb < size.LIMITS_MB[role], size.in_words([found])


@pytest.mark.slow
def test_role_installs_only_required_packages() -> None:
    roles = {role.name: role for role in size.measure()}
    assert {"sextant", "numpy", "eclipse-zenoh", "pyserial"} <= set(roles["actuator"].packages_mb)
    assert not {"numba", "opencv-python-headless", "mujoco", "mcap"} & set(roles["actuator"].packages_mb)
    assert "mujoco" not in roles["onboard"].packages_mb
    assert set(roles["onboard"].packages_mb) == {*roles["actuator"].packages_mb, *roles["perception"].packages_mb}


@pytest.mark.slow
def test_size_command_prints_and_writes_roles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["size", "--out", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((tmp_path / "size.json").read_text())
    assert cli.main(["size", "--out", str(tmp_path)]) == 0
    assert "| `actuator` |" in capsys.readouterr().out


def test_missing_packages_are_named() -> None:
    role = size.Role("actuator", {"numpy": 60.0, "sextant": 4.0}, ("pyserial",))
    assert "| `actuator` | 64 | 150 | numpy 60, sextant 4; without pyserial, which are not installed |" in size.in_words([role])
