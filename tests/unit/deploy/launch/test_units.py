import grp
import re
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.deploy.launch import units
from sextant.deploy.launch.process_table import ROUTER_ENDPOINT, Choices, Command, commands, router_command, rows
from sextant.deploy.launch.units import TARGET, Manager, UnitError
from sextant.services.actuator.safety.torque_off_latch import SHARED
from sextant.shared.wire.transport import Endpoints
from tests.support.unit_files import read_unit, words_of

MINE, MACHINE = Manager("/opt/sextant/bin/python"), Manager("/opt/sextant/bin/python", user="root")
ONBOARD = commands(rows("onboard", simulated=False), Choices(), Endpoints((ROUTER_ENDPOINT,)))


def generated_units(manager: Manager, processes: tuple[Command, ...] = ONBOARD) -> Mapping[str, str]:
    return units.units(router_command(ROUTER_ENDPOINT), processes, manager)


@pytest.mark.parametrize("manager", [MINE, MACHINE], ids=["user", "system"])
def test_each_process_has_unit_with_its_command_and_watchdog(manager: Manager) -> None:
    texts = dict(generated_units(manager))
    target = read_unit(texts.pop(TARGET))
    assert set(texts) == {"sextant-router.service", *(f"sextant-{c.name}.service" for c in ONBOARD)}
    assert set(" ".join(target["Unit"]["Wants"]).split()) == set(texts)
    for command in ONBOARD:
        unit = read_unit(texts[f"sextant-{command.name}.service"])
        assert words_of(unit["Service"]["ExecStart"][0]) == [manager.python, *command.arguments]
        assert set(unit["Service"]["Environment"]) >= {f"{key}={value}" for key, value in command.environment.items()}
        assert unit["Service"]["Type"] == ["notify"]
        assert unit["Service"]["WatchdogSec"] == [f"{command.watchdog_s * 1e3:.0f}ms"]
        assert unit["Service"]["MemoryMax"] == [f"{command.memory_mb}M"]
        assert unit["Service"]["Restart"] == ["on-failure"]
        assert unit["Unit"]["StartLimitBurst"] == [str(command.restarts + 1)]
        assert unit["Unit"]["After"] == ["sextant-router.service"]
        assert ("LimitRTPRIO" in unit["Service"]) == ("--urgent" in command.arguments)
        assert not {"PrivateDevices", "ProtectClock", "MemoryDenyWriteExecute"} & set(unit["Service"])


def test_latch_folder_is_shared_and_preserved_by_units() -> None:
    for name, text in generated_units(MACHINE).items():
        if name != TARGET:
            service = read_unit(text)["Service"]
            assert service["RuntimeDirectory"] == ["sextant"]
            assert service["RuntimeDirectoryPreserve"] == ["yes"]
            assert service["RuntimeDirectoryMode"] == ["1777"]
            assert Path("/run/sextant") == SHARED, "where the latch is, for all who may close it"


@pytest.mark.parametrize("word", ["a b", "100%", "$HOME", 'say "x"', "back\\slash", "ß", "camera=/a/b c/%t", "'"])
def test_unit_quoting_preserves_arguments(word: str) -> None:
    text = generated_units(MINE, (Command("odd", ("-m", "odd", word), {}),))["sextant-odd.service"]
    assert words_of(read_unit(text)["Service"]["ExecStart"][0]) == [MINE.python, "-m", "odd", word]


@pytest.mark.parametrize("manager", [MINE, MACHINE], ids=["user", "system"])
def test_systemd_analyze_verifies_units(manager: Manager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("systemd-analyze is not here, so nothing verifies the units")
    (tmp_path / "python").touch(mode=0o755)
    here = Manager(str(tmp_path / "python"), manager.user)
    written = units.install(generated_units(here), tmp_path / "units")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    side = [] if manager.system else ["--user"]
    words = [analyze, "verify", *side, *(str(path) for path in written)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert str(tmp_path) not in done.stderr, done.stderr


def test_uninstall_removes_only_unmodified_installed_units(tmp_path: Path) -> None:
    (tmp_path / "sextant-mine.service").write_text("[Service]\nExecStart=/bin/true\n")
    written = units.install(generated_units(MINE), tmp_path)
    assert units.install(generated_units(MINE), tmp_path) == written, "again changes nothing"
    router = tmp_path / "sextant-router.service"
    router.write_text(router.read_text() + "Nice=1\n")
    removed, left = units.uninstall(tmp_path, "systemctl --user")
    assert set(removed) == set(written) - {router}
    assert left == [tmp_path / "sextant-mine.service", router]
    assert sorted(tmp_path.iterdir()) == left


def test_install_removes_units_of_earlier_role(tmp_path: Path) -> None:
    units.install(generated_units(MINE), tmp_path)
    units.install(generated_units(MINE, ONBOARD[:1]), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        TARGET,
        "sextant-router.service",
        f"sextant-{ONBOARD[0].name}.service",
    }


def test_install_refuses_to_overwrite_foreign_unit(tmp_path: Path) -> None:
    foreign = tmp_path / "sextant-stop.service"
    foreign.write_text("[Service]\nExecStart=/bin/true\n")
    with pytest.raises(UnitError, match=r"sextant-stop\.service: changed since .* move it away"):
        units.install(generated_units(MINE), tmp_path)
    assert list(tmp_path.iterdir()) == [foreign]


def test_uninstall_refuses_enabled_target(tmp_path: Path) -> None:
    units.install(generated_units(MINE), tmp_path)
    (tmp_path / "default.target.wants").mkdir()
    (tmp_path / "default.target.wants" / TARGET).symlink_to(tmp_path / TARGET)
    with pytest.raises(UnitError, match=r"systemctl --user disable --now sextant\.target"):
        units.uninstall(tmp_path, "systemctl --user")
    assert (tmp_path / TARGET).exists()


def test_service_command_installs_prints_next_step_and_uninstalls(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["service", "install", "onboard", "--camera", "none", "--folder", str(tmp_path)]
    assert cli.main([*asked, "--dry-run"]) == 0
    assert "ExecStart=" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []
    assert cli.main(asked) == 0
    said = capsys.readouterr().out
    assert all(str(path) in said for path in tmp_path.iterdir())
    assert said.splitlines()[-1] == ("next: systemctl --user daemon-reload && systemctl --user enable --now sextant.target")
    assert cli.main(["service", "uninstall", "--folder", str(tmp_path)]) == 0
    assert list(tmp_path.iterdir()) == []


def test_system_units_have_existing_device_groups(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["service", "install", "onboard", "--camera", "none", "--system", "--as", "root", "--dry-run"]) == 0
    found = re.findall(r"^SupplementaryGroups=(.+)$", capsys.readouterr().out, re.MULTILINE)
    there = {group.gr_name for group in grp.getgrall()}
    assert all(set(groups.split()) == set(units.DEVICE_GROUPS) & there for groups in found)
    assert len(found) == (4 if there & set(units.DEVICE_GROUPS) else 0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--system", "--as", "no such user"], "--as: a user of this machine expected, found 'no such user'"),
        (["--as", "root"], "--as is for --system units"),
    ],
)
def test_install_refuses_a_user_that_cannot_run_the_units(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["service", "install", "onboard", "--camera", "none", "--folder", str(tmp_path), *words]) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_install_reports_problems_before_writing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = ["--folder", str(tmp_path)]
    assert cli.main(["service", "install", "onboard", "--keys", "/nowhere", *folder]) == 2
    assert "`sextant keys new DIR` creates keys" in capsys.readouterr().err
    assert cli.main(["service", "install", "onboard", "--listen", "tcp/0.0.0.0:7447", *folder]) == 2
    assert "give --keys DIR" in capsys.readouterr().err
    (tmp_path / TARGET).write_text("")
    assert cli.main(["service", "install", "onboard", "--camera", "none", *folder]) == 2
    assert "move it away" in capsys.readouterr().err
