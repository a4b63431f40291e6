"""Base station for several robots, with one operator page for all of them.

Each robot has its own router, mapper, planner and further base processes, and its own key prefix. Messages or failures of one
robot do not delay another one.
"""

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

from sextant.deploy.launch import process_table
from sextant.deploy.launch.host_launcher import HostLauncher
from sextant.deploy.launch.launcher import Launcher
from sextant.deploy.launch.process_table import ENVIRONMENT, Choices, Command, Process
from sextant.deploy.security.router_security import Gate
from sextant.services.console.config import Settings
from sextant.services.console.fleet_proxy.config import is_name
from sextant.shared.errors import SextantError
from sextant.shared.files import config
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.ports import free_port

_PROXY_SILENT_S = 10.0
_PROXY_MB = 128


class FleetError(SextantError, ValueError):
    """A fleet that cannot be started; the message names the robot."""


@dataclass(frozen=True, slots=True)
class Member:
    """A robot of the fleet, as the base station sees it."""

    connect: tuple[str, ...]  # endpoints of its router, or of a router chained to it
    keys: str = ""  # folder of this machine's certificate for this robot
    robot: str = "phantomx_mk2"  # robot profile
    namespace: str = ""  # key prefix; empty: the robot's name
    without: tuple[str, ...] = ()  # base processes that do not run here
    set: tuple[str, ...] = ()  # SERVICE.KEY=VALUE, as for `sextant up --set`

    checks = (
        config.together("connect", lambda connect: len(connect) > 0, "at least one endpoint, e.g. tls/hexapod.local:7448,"),
        *config.each("connect", lambda endpoint: "/" in endpoint, "an endpoint, e.g. tls/hexapod.local:7448,"),
    )

    def __post_init__(self) -> None:
        config.verify(self)


@dataclass(frozen=True, slots=True)
class Page:
    """Address of the page for all robots."""

    host: str = "127.0.0.1"
    port: int = 8080
    token: str = ""

    def __post_init__(self) -> None:
        self.settings()

    @property
    def url(self) -> str:
        """URL of the page for a browser."""
        return self.settings().url(self.port)

    def settings(self) -> Settings:
        """Return the address as settings of a console."""
        return Settings(host=self.host, port=self.port, token=self.token)


@dataclass(frozen=True, slots=True)
class Fleet:
    """The robots by name, and the address of their common page."""

    robots: dict[str, Member]
    page: Page = field(default_factory=Page)

    checks = (
        config.Check(("robots",), lambda robots: _misnamed(robots)),
        config.together("robots", lambda robots: len(robots) > 0, "at least one table [robots.NAME]"),
    )

    def __post_init__(self) -> None:
        config.verify(self)


def _misnamed(names: Iterable[str]) -> Iterator[config.Misfit]:
    for name in names:
        if not is_name(name):
            yield config.Misfit(f"robots.{name}", "a name of at most 32 letters, digits, - and _", repr(name))


def load(path: Path) -> Fleet:
    """Read a fleet from a TOML file; paths in it are relative to the file.

    Raises:
        ConfigError: All problems of the file.
    """
    fleet = config.load(path, Fleet)

    def seen(text: str) -> str:
        return str((path.parent / text).resolve())

    members = {
        name: replace(
            member,
            keys=seen(member.keys) if member.keys else "",
            robot=seen(member.robot) if member.robot.endswith(".toml") else member.robot,
        )
        for name, member in fleet.robots.items()
    }
    problems = []
    for name, member in members.items():
        try:
            load_profile(member.robot)
        except config.ConfigError as error:
            problems.append(f"robots.{name}.robot: {error}")
    if problems:
        raise config.ConfigError(str(path), problems)
    return replace(fleet, robots=members)


class Base:
    """All processes of a fleet on this machine; a context manager.

    Its methods belong to one thread.
    """

    def __init__(self, fleet: Fleet, open_: bool, say: Callable[[str], object]):
        """Check that the fleet can be started.

        Args:
            fleet: The robots.
            open_: Whether robots without certificates are allowed.
            say: Receives log lines that begin with the robot's name, from several threads.

        Raises:
            FleetError: A robot has no certificate, its keys are wrong, or a process or setting is unknown.
        """
        self._say = say
        self._halves: dict[str, tuple[HostLauncher, contextlib.ExitStack]] = {}
        self.pages: dict[str, int] = {}  # TCP port of each robot's own page
        self.planned = {name: self._half(name, member, fleet.page, open_) for name, member in fleet.robots.items()}
        self.fleet_proxy = _proxy_command(fleet.page, self.pages) if self.pages else ()
        self._fleet_proxy = Launcher(self.fleet_proxy, self._pass_on)

    def _half(self, name: str, member: Member, page: Page, open_: bool) -> HostLauncher:
        try:
            usual = process_table.rows("offboard", simulated=False, page=True)
            rows = process_table.rearranged(usual, (), member.without, "offboard")
            keys = Path(member.keys) if member.keys else None
            own, prefix = f"tcp/127.0.0.1:{free_port()}", member.namespace or name
            gated = Gate((own,), prefix, keys, open_ and keys is None, member.connect)
            gated.configuration()  # raises if the keys are wrong, before anything starts
            if misplaced := gated.misplaced([row.name for row in rows]):
                raise FleetError(misplaced)
            chosen, extra = self._told(name, member, page, rows)
        except ValueError as error:
            raise FleetError(f"robots.{name}: {error}") from None
        return HostLauncher("offboard", rows, chosen, extra, gated, lambda words: self._say(f"{name}: {words}"))

    def _told(
        self, name: str, member: Member, page: Page, rows: Sequence[Process]
    ) -> tuple[Choices, dict[str, tuple[str, ...]]]:
        """Return the settings of a robot's processes; its console gets a free port."""
        chosen = Choices(robot=member.robot, recordings=f"recordings/{name}")
        extra = process_table.further_settings(member.set, rows)
        if any(row.name == "console" for row in rows):
            chosen = replace(chosen, console_port=free_port())
            self.pages[name] = chosen.console_port
            secret = (process_table.assignment("token", page.token),) if page.token else ()
            extra["console"] = (*extra.get("console", ()), *secret)
        return chosen, extra

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            stack.callback(self._end_halves)
            for name, half in self.planned.items():
                own = contextlib.ExitStack()
                self._halves[name] = half, own
                own.enter_context(half)
            stack.enter_context(self._fleet_proxy)
            self._held = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._held.close()

    @property
    def running(self) -> tuple[str, ...]:
        """The robots whose processes still run."""
        return tuple(self._halves)

    def half(self, name: str) -> HostLauncher:
        """Return the processes of one robot."""
        return self._halves[name][0]

    def beat(self, wait_s: float) -> str:
        """Do what is due, and wait up to `wait_s` [s] for a process to end.

        A failure of one robot's processes ends only the processes of that robot.

        Returns:
            Why the whole fleet has to end, or an empty string.
        """
        for name, (half, own) in list(self._halves.items()):
            if problem := half.beat(0.0):
                self._say(f"{name}: {problem}; the other robots continue")
                del self._halves[name]
                own.close()
        if not self._halves:
            return "no robot's processes are left running"
        for ended in self._fleet_proxy.wait(wait_s):
            self._say(str(ended))
            if not ended.restarted:
                return "the page of all robots keeps failing"
        return ""

    def stop(self, insisted: Callable[[], bool]) -> None:
        """End all processes; kill them at once when `insisted` returns True."""
        self._fleet_proxy.stop(insisted)
        for half, _ in self._halves.values():
            half.stop(insisted)

    def _pass_on(self, _name: str, line: str) -> None:
        self._say(line)

    def _end_halves(self) -> None:
        for _, own in self._halves.values():
            own.close()
        self._halves.clear()


def _proxy_command(page: Page, pages: dict[str, int]) -> tuple[Command]:
    words = [
        process_table.assignment("host", page.host),
        process_table.assignment("port", page.port),
        *([process_table.assignment("token", page.token)] if page.token else []),
        f"robots={{{', '.join(f'{json.dumps(name)} = {port}' for name, port in pages.items())}}}",
    ]
    arguments = ("-m", "sextant.services.console.fleet_proxy", *(word for one in words for word in ("--set", one)))
    return (Command("fleet_proxy", arguments, ENVIRONMENT, restarts=3, watchdog_s=_PROXY_SILENT_S, memory_mb=_PROXY_MB),)
