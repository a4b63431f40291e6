"""Fleet files, and the commands of a fleet."""

from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.deploy.launch import fleet
from sextant.deploy.launch.fleet import Base, FleetError
from sextant.services.console.fleet_proxy.config import Settings
from sextant.shared.files.config import ConfigError
from sextant.shared.runtime.process import load_settings

TWO = """
[robots.alpha-1]
connect = ["tcp/127.0.0.1:7001"]
[robots.beta]
connect = ["tcp/127.0.0.1:7002"]
robot = "lotriet_rx64"
namespace = "old"
without = ["recorder"]
set = ["planner.blind=true"]
[page]
port = 8123
token = "a-long-secret-word"
"""


def write_fleet_file(folder: Path, text: str) -> Path:
    path = folder / "fleet.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_each_robot_has_separate_processes_router_and_keys(tmp_path: Path) -> None:
    base = Base(fleet.load(write_fleet_file(tmp_path, TWO)), False, print)
    alpha, beta = base.planned["alpha-1"], base.planned["beta"]
    assert alpha.names == ["mapper", "planner", "console", "recorder"]
    assert beta.names == ["mapper", "planner", "console"]
    said = {name: [" ".join(command.arguments) for command in half.commands] for name, half in base.planned.items()}
    assert all("--namespace alpha-1" in words and "--elsewhere" in words for words in said["alpha-1"])
    assert all("--namespace old" in words and "--robot lotriet_rx64" in words for words in said["beta"])
    assert [("blind=true" in words) for words in said["beta"]] == [False, True, False]
    assert "recordings/alpha-1" in said["alpha-1"][3]
    routers = {words.partition("--connect ")[2].split()[0] for words in (said["alpha-1"][0], said["beta"][0])}
    ports = {words.rpartition("port=")[2].split()[0] for words in (said["alpha-1"][2], said["beta"][2])}
    assert len(routers) == len(ports) == 2
    (proxy,) = base.fleet_proxy
    told = load_settings(Settings, None, [word for word in proxy.arguments if "=" in word])
    assert told == Settings(port=8123, token="a-long-secret-word", robots=base.pages)
    assert {int(port) for port in ports} == set(told.robots.values())
    for console in (said["alpha-1"][2], said["beta"][2]):
        assert "token=a-long-secret-word" in console, "who knows one page's address knows none of the others"


def test_fleet_without_consoles_has_no_page(tmp_path: Path) -> None:
    made = fleet.load(write_fleet_file(tmp_path, '[robots.a]\nconnect = ["tcp/127.0.0.1:1"]\nwithout = ["console"]\n'))
    assert Base(made, False, print).fleet_proxy == ()


def test_paths_are_relative_to_fleet_file(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_bytes((Path("shared/robot/profiles") / "phantomx_mk2.toml").read_bytes())
    text = '[robots.a]\nconnect = ["tcp/127.0.0.1:1"]\nkeys = "keys/base"\nrobot = "mine.toml"\n'
    (member,) = fleet.load(write_fleet_file(tmp_path, text)).robots.values()
    assert member.keys == str(tmp_path / "keys" / "base")
    assert member.robot == str(tmp_path / "mine.toml")


@pytest.mark.parametrize(
    ("text", "hints"),
    [
        ("", ("robots: missing",)),
        ("[robots]", ("at least one table [robots.NAME]",)),
        ("[robots.a]\n[robots.b]\nconnect = []", ("robots.a.connect: missing", "robots.b.connect: at least one endpoint")),
        ('[robots."a b"]\nconnect = ["tcp/1:1"]', ("a name of at most 32 letters",)),
        ('[robots.a]\nconnect = ["alpha.local"]', ("robots.a.connect[0]: an endpoint",)),
        ('[robots.a]\nconnect = ["tcp/1:1"]\nkey = "x"', ("robots.a.key: unknown key; did you mean 'keys'?",)),
        ('[robots.a]\nconnect = ["tcp/1:1"]\nrobot = "unknown"', ("robots.a.robot", "unknown")),
        ('[robots.a]\nconnect = ["tcp/1:1"]\n[page]\nhost = "0.0.0.0"', ("token",)),
    ],
)
def test_all_fleet_file_problems_are_listed_together(tmp_path: Path, text: str, hints: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as caught:
        fleet.load(write_fleet_file(tmp_path, text))
    for hint in hints:
        assert hint in str(caught.value)


@pytest.mark.parametrize(
    ("lines", "hint"),
    [
        ('connect = ["tcp/192.0.2.1:7447"]', "another machine without certificates"),
        ('connect = ["tls/192.0.2.1:7448"]', "needs certificates"),
        ('connect = ["tls/192.0.2.1:7448"]\nkeys = "nowhere"', "`sextant keys new DIR` creates keys"),
        ('connect = ["tcp/127.0.0.1:1"]\nwithout = ["maper"]', "did you mean 'mapper'?"),
        ('connect = ["tcp/127.0.0.1:1"]\nset = ["mapper"]', "SERVICE.KEY=VALUE expected"),
        ('connect = ["tcp/127.0.0.1:1"]\nset = ["camera.device=none"]', "no service 'camera' is started"),
    ],
)
def test_unreachable_robot_configuration_is_refused_before_start(
    tmp_path: Path, lines: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_fleet_file(tmp_path, f"[robots.alpha]\n{lines}\n")
    with pytest.raises(FleetError, match=r"robots\.alpha: ") as caught:
        Base(fleet.load(path), False, print)
    assert hint in str(caught.value)
    assert cli.main(["fleet", str(path)]) == 2
    assert f"sextant fleet: robots.alpha: {caught.value}".replace("robots.alpha: robots.alpha: ", "robots.alpha: ") in (
        capsys.readouterr().err
    )


def test_open_connection_requires_explicit_option(tmp_path: Path) -> None:
    path = write_fleet_file(tmp_path, '[robots.alpha]\nconnect = ["tcp/192.0.2.1:7447"]\n')
    assert set(Base(fleet.load(path), True, print).planned) == {"alpha"}


def test_missing_fleet_file_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fleet", str(tmp_path / "none.toml")]) == 2
    assert "no such file" in capsys.readouterr().err
