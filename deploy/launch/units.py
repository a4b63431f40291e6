"""systemd units for a robot's computer: one service per process, and a target.

They are made from the process table. systemd restarts each process separately. A process sends its signs of life to systemd by
the same protocol as to the launcher, so `WatchdogSec=` is the table's timeout.
"""

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sextant.deploy.launch.process_table import Command
from sextant.shared.errors import SextantError
from sextant.shared.files import whole_files

TARGET = "sextant.target"
DEVICE_GROUPS = (
    "dialout",
    "uucp",
    "video",
    "plugdev",
    "i2c",
)  # groups that own serial ports, cameras and I2C buses, depending on the distribution
_PREFIX = "sextant-"
_MARK = "# Made by `sextant service install`; change it by `systemctl edit`. "
_START_S = 600  # [s] until its loop runs; it may have to compile first
_STOP_S = 5
_AGAIN_S = 1  # [s] from a failure to the next start
_WITHIN_S = 60  # [s] window in which the table's restarts are counted
_TASKS = 128
_PRIORITY = 10  # real-time priority that an urgent process requests
# Restrictions for every process. None of them blocks serial ports or cameras, as PrivateDevices= and ProtectClock= would, or
# compiled loops, as MemoryDenyWriteExecute= would.
_HARDENED = (
    "NoNewPrivileges=yes",
    "LockPersonality=yes",
    "SystemCallArchitectures=native",
    "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK",
)
_HARDENED_SYSTEM = (  # not available to a user's own service manager
    "CapabilityBoundingSet=",
    "ProtectSystem=strict",
    "ProtectHome=read-only",
    "PrivateTmp=yes",
    "ProtectKernelTunables=yes",
    "ProtectKernelModules=yes",
    "ProtectKernelLogs=yes",
    "ProtectControlGroups=yes",
    "ProtectHostname=yes",
    "RestrictNamespaces=yes",
    "RestrictSUIDSGID=yes",
    # The torque-off latch is a file that all processes share. It outlives them, and any user may set it at a terminal.
    "RuntimeDirectory=sextant",
    "RuntimeDirectoryMode=1777",
    "RuntimeDirectoryPreserve=yes",
    "CacheDirectory=sextant",
)
_SYSTEM_ENVIRONMENT = {"NUMBA_CACHE_DIR": "%C/sextant"}


@dataclass(frozen=True, slots=True)
class Manager:
    """Which service manager starts the units."""

    python: str  # absolute path of the interpreter
    user: str = ""  # user for the system's service manager; empty: the user's own manager
    groups: tuple[str, ...] = ()  # supplementary groups, system manager only; each must exist

    @property
    def system(self) -> bool:
        """Whether this is the system's service manager."""
        return bool(self.user)

    @property
    def systemctl(self) -> str:
        """The command that controls the service manager."""
        return "sudo systemctl" if self.system else "systemctl --user"

    @property
    def usual_folder(self) -> Path:
        """Folder where the service manager looks for units."""
        return Path("/etc/systemd/system") if self.system else Path.home() / ".config" / "systemd" / "user"


class UnitError(SextantError, ValueError):
    """A unit that `install` did not write, with advice."""


def units(router: Command, processes: Sequence[Command], manager: Manager) -> Mapping[str, str]:
    """Return the text of each unit by file name.

    Args:
        router: Command of the router.
        processes: Commands of the other processes; all of them wait for the router.
        manager: The service manager that starts them.
    """
    waiting = [replace(command, after=(router.name, *command.after)) for command in processes]
    made = {_file(command.name): _service(command, manager) for command in (router, *waiting)}
    return {**{name: _marked(text) for name, text in made.items()}, TARGET: _marked(_target(list(made), manager))}


def install(made: Mapping[str, str], folder: Path) -> list[Path]:
    """Write units, and remove those of an earlier installation not among them.

    Returns:
        The files that were written.

    Raises:
        UnitError: A file of that name exists and `install` did not write it, or it was edited; nothing was written.
    """
    if foreign := [name for name in made if (folder / name).exists() and not _ours(folder / name)]:
        raise UnitError(
            f"{', '.join(str(folder / name) for name in foreign)}: changed since `sextant service install` wrote it; move it "
            "away, and make your changes in a drop-in (`systemctl edit`)"
        )
    whole_files.make_folder(folder)
    for path in installed(folder):
        if path.name not in made:
            path.unlink()
    for name, text in made.items():
        whole_files.write_text(folder / name, text, durable=True)
    return [folder / name for name in made]


def uninstall(folder: Path, systemctl: str) -> tuple[list[Path], list[Path]]:
    """Remove exactly what `install` wrote.

    Returns:
        The removed files, and the files that remain because they were edited or are not from `install`.

    Raises:
        UnitError: The target is still enabled.
    """
    if links := sorted(folder.glob(f"*.wants/{TARGET}")):
        raise UnitError(f"{links[0]}: still enabled; run `{systemctl} disable --now {TARGET}` first")
    removed = installed(folder)
    for path in removed:
        path.unlink()
    left = [*folder.glob(f"{_PREFIX}*.service"), *folder.glob(TARGET)]
    return removed, sorted(left)


def installed(folder: Path) -> list[Path]:
    """Return the units in a folder that are unchanged since `install` wrote them."""
    return sorted(path for path in (*folder.glob(f"{_PREFIX}*.service"), *folder.glob(TARGET)) if _ours(path))


def _file(name: str) -> str:
    return f"{_PREFIX}{name}.service"


def _marked(text: str) -> str:
    return f"{_MARK}{_digest(text)}\n{text}"


def _ours(path: Path) -> bool:
    first, _, text = path.read_text(encoding="utf-8").partition("\n")
    return first == f"{_MARK}{_digest(text)}"


def _digest(text: str) -> str:
    return hashlib.blake2s(text.encode()).hexdigest()[:16]


def _service(command: Command, manager: Manager) -> str:
    after = " ".join(_file(name) for name in command.after)
    environment = {**command.environment, **(_SYSTEM_ENVIRONMENT if manager.system else {})}
    words = (manager.python, *command.arguments)
    lines = [
        "[Unit]",
        f"Description=Sextant, {command.name}",
        f"PartOf={TARGET}",
        *([f"After={after}", f"Wants={_file(command.after[0])}"] if after else ["After=network.target"]),
        f"StartLimitIntervalSec={_WITHIN_S}",
        f"StartLimitBurst={command.restarts + 1}",
        "",
        "[Service]",
        "Type=notify",
        f"ExecStart={' '.join(_quoted(word) for word in words)}",
        *(f"Environment={_quoted(f'{key}={value}', specifiers=True)}" for key, value in environment.items()),
        "StateDirectory=sextant",
        "WorkingDirectory=%S/sextant",
        f"Restart={'on-failure' if command.restarts else 'no'}",
        f"RestartSec={_AGAIN_S}",
        "RestartPreventExitStatus=2",  # 2 means a wrong invocation; a restart would fail again
        f"TimeoutStartSec={_START_S}",
        f"TimeoutStopSec={_STOP_S}",
        *([f"WatchdogSec={round(command.watchdog_s * 1e3)}ms"] if command.watchdog_s else []),
        "LimitCORE=0",  # a process that hangs is aborted by SIGABRT and prints its stack
        *([f"LimitRTPRIO={_PRIORITY}"] if "--urgent" in command.arguments else ["RestrictRealtime=yes"]),
        *([f"MemoryMax={command.memory_mb}M"] if command.memory_mb else []),
        f"TasksMax={_TASKS}",
        *_HARDENED,
        *((f"User={manager.user}", *_HARDENED_SYSTEM) if manager.system else ()),
        *([f"SupplementaryGroups={' '.join(manager.groups)}"] if manager.groups else []),
    ]
    return "\n".join(lines) + "\n"


def _target(services: Sequence[str], manager: Manager) -> str:
    lines = [
        "[Unit]",
        "Description=Sextant, all processes of this machine",
        f"Wants={' '.join(services)}",
        "",
        "[Install]",
        f"WantedBy={'multi-user.target' if manager.system else 'default.target'}",
    ]
    return "\n".join(lines) + "\n"


def _quoted(word: str, specifiers: bool = False) -> str:
    """Quote a word for systemd, without variables and, unless wanted, specifiers."""
    word = word if specifiers else word.replace("%", "%%").replace("$", "$$")
    if re.fullmatch(r"[\w%$@:,./=+-]+", word):
        return word
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n").replace("\t", "\\t")
    return f'"{escaped}"'
