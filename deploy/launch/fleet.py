"""Several robots on one base: of each a router, a mapper, a planner and what else a base has, and one page for all of them.

What is a robot's own is in processes of its own, behind a router of its own, below a prefix of its own: what one robot says,
or how it fails, holds no other up.
"""

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

from sextant.deploy import process_table
from sextant.deploy.launch.half import Half
from sextant.deploy.launch.launcher import Launcher, free_port
from sextant.deploy.network.gate import Gate
from sextant.deploy.process_table import ENVIRONMENT, Choices, Command, Process
from sextant.services.console.config import Settings
from sextant.services.console.fleet_proxy.config import is_name
from sextant.shared.files import config
from sextant.shared.robot.profiles import load_profile

_LOBBY_SILENT_S = 10.0
_LOBBY_MB = 128


class FleetError(ValueError):
    """What a fleet cannot be started with, and of which robot."""


@dataclass(frozen=True, slots=True)
class Member:
    """A robot, as its base sees it."""

    connect: tuple[str, ...]  # endpoints of its router, or of one that it is chained to
    keys: str = ""  # folder of this machine's certificate for it
    robot: str = "phantomx_mk2"  # its profile
    namespace: str = ""  # prefix of its keys; empty: its name
    without: tuple[str, ...] = ()  # processes of a base that do not run here
    set: tuple[str, ...] = ()  # SERVICE.KEY=VALUE, as `sextant up --set` has them

    checks = (
        config.together("connect", lambda connect: len(connect) > 0, "one endpoint at least, e.g. tls/hexapod.local:7448,"),
        *config.each("connect", lambda endpoint: "/" in endpoint, "an endpoint, e.g. tls/hexapod.local:7448,"),
    )

    def __post_init__(self) -> None:
        config.verify(self)


@dataclass(frozen=True, slots=True)
class Page:
    """Where the page of all robots is served, as that of one."""

    host: str = "127.0.0.1"
    port: int = 8080
    token: str = ""

    def __post_init__(self) -> None:
        self.settings()

    @property
    def url(self) -> str:
        """Where a browser finds it."""
        return self.settings().url(self.port)

    def settings(self) -> Settings:
        """The same, as those of a console."""
        return Settings(host=self.host, port=self.port, token=self.token)


@dataclass(frozen=True, slots=True)
class Fleet:
    """The robots by their names, and where the page of all of them is."""

    robots: dict[str, Member]
    page: Page = field(default_factory=Page)

    checks = (
        config.Check(("robots",), lambda robots: _misnamed(robots)),
        config.together("robots", lambda robots: len(robots) > 0, "one table [robots.NAME] at least"),
    )

    def __post_init__(self) -> None:
        config.verify(self)


def _misnamed(names: Iterable[str]) -> Iterator[config.Misfit]:
    for name in names:
        if not is_name(name):
            yield config.Misfit(f"robots.{name}", "a name of at most 32 letters, digits, - and _", repr(name))


def load(path: Path) -> Fleet:
    """Read a fleet from a TOML file; folders and profiles in it are seen from the file.

    Raises:
        ConfigError: All that is wrong with it.
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
    """All that runs of a fleet on this machine; a context manager, whose methods belong to one thread."""

    def __init__(self, fleet: Fleet, open_: bool, say: Callable[[str], object]):
        """See that it can be started.

        Args:
            fleet: The robots.
            open_: Whether robots are met without certificates.
            say: Is told what comes about, with the robot's name before it, from several threads.

        Raises:
            FleetError: A robot would be met without a certificate, its keys are wrong, or a process or setting is none.
        """
        self._say = say
        self._halves: dict[str, tuple[Half, contextlib.ExitStack]] = {}
        self.pages: dict[str, int] = {}  # TCP port of each robot's own page
        self.planned = {name: self._half(name, member, fleet.page, open_) for name, member in fleet.robots.items()}
        self.lobby = _lobby(fleet.page, self.pages) if self.pages else ()
        self._lobby = Launcher(self.lobby, self._pass_on)

    def _half(self, name: str, member: Member, page: Page, open_: bool) -> Half:
        try:
            usual = process_table.rows("offboard", simulated=False, page=True)
            rows = process_table.rearranged(usual, (), member.without, "offboard")
            keys = Path(member.keys) if member.keys else None
            own, prefix = f"tcp/127.0.0.1:{free_port()}", member.namespace or name
            gated = Gate((own,), prefix, keys, open_ and keys is None, member.connect)
            gated.configuration()  # what is wrong with the keys is told before anything starts
            if misplaced := gated.misplaced([row.name for row in rows]):
                raise FleetError(misplaced)
            chosen, extra = self._told(name, member, page, rows)
        except ValueError as error:
            raise FleetError(f"robots.{name}: {error}") from None
        return Half("offboard", rows, chosen, extra, gated, lambda words: self._say(f"{name}: {words}"))

    def _told(
        self, name: str, member: Member, page: Page, rows: Sequence[Process]
    ) -> tuple[Choices, dict[str, tuple[str, ...]]]:
        """What the processes of a robot are told; its console listens where the lobby finds it."""
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
            stack.enter_context(self._lobby)
            self._held = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._held.close()

    @property
    def running(self) -> tuple[str, ...]:
        """The robots that are still cared for."""
        return tuple(self._halves)

    def half(self, name: str) -> Half:
        """What runs of one robot."""
        return self._halves[name][0]

    def beat(self, wait_s: float) -> str:
        """Do what is due, and wait up to a time [s]; why all of it has to end, in words, or nothing.

        What fails of one robot ends what runs of that one.
        """
        for name, (half, own) in list(self._halves.items()):
            if problem := half.beat(0.0):
                self._say(f"{name}: {problem}; the other robots go on")
                del self._halves[name]
                own.close()
        if not self._halves:
            return "nothing is left that runs"
        for ended in self._lobby.wait(wait_s):
            self._say(str(ended))
            if not ended.restarted:
                return "the page of all robots does not stay up"
        return ""

    def stop(self, insisted: Callable[[], bool]) -> None:
        """End the processes; at once where that is insisted on."""
        self._lobby.stop(insisted)
        for half, _ in self._halves.values():
            half.stop(insisted)

    def _pass_on(self, _name: str, line: str) -> None:
        self._say(line)

    def _end_halves(self) -> None:
        for _, own in self._halves.values():
            own.close()
        self._halves.clear()


def _lobby(page: Page, pages: dict[str, int]) -> tuple[Command]:
    words = [
        process_table.assignment("host", page.host),
        process_table.assignment("port", page.port),
        *([process_table.assignment("token", page.token)] if page.token else []),
        f"robots={{{', '.join(f'{json.dumps(name)} = {port}' for name, port in pages.items())}}}",
    ]
    arguments = ("-m", "sextant.services.console.fleet_proxy", *(word for one in words for word in ("--set", one)))
    return (Command("lobby", arguments, ENVIRONMENT, restarts=3, watchdog_s=_LOBBY_SILENT_S, memory_mb=_LOBBY_MB),)
