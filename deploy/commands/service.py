"""`sextant service`: the processes of a role as systemd services or containers."""

import getpass
import grp
import os
import pwd
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import SUCCESS, InputError, say
from sextant.deploy.commands.up import Launch, asked, gate_of, launch_options
from sextant.deploy.terminal.arguments import Group, flag, option, options_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sextant.deploy.launch.units import Manager


service = Group("service", "Run the processes of a role as systemd services, or in containers.")


@dataclass(frozen=True, slots=True)
class Units:
    """Service manager, user and folder of the units."""

    system: bool
    run_as: str
    folder: str | None

    def manager(self) -> "Manager":
        """Return the service manager."""
        from sextant.deploy.launch.units import DEVICE_GROUPS, Manager

        if not self.system:
            if self.run_as:
                raise InputError("--as is for --system units; the user's own service manager runs its units as that user")
            return Manager(sys.executable)
        user = self.run_as or os.environ.get("SUDO_USER") or getpass.getuser()
        there = {group.gr_name for group in grp.getgrall()}  # systemd starts no unit with an unknown group
        return Manager(sys.executable, user, tuple(group for group in DEVICE_GROUPS if group in there))


_unit_options = options_of(
    Units,
    "where",
    flag("--system", "use the system's service manager, /etc/systemd/system, not the user's"),
    option("--as", "user that runs the --system units (default: the calling user)", "USER", into="run_as", default=""),
    option("--folder", "folder of the units (default: that of the service manager)", "DIR"),
)


@service.command("install")
@launch_options
@flag("--dry-run", "print the units, write nothing")
@_unit_options
def install(launch: Launch, dry_run: bool, where: Units) -> int:
    """Write a unit for each process of a role, and sextant.target for all."""
    from sextant.deploy.launch import units

    manager = where.manager()
    if manager.system:
        _check_user(manager.user)
    made = _made(launch, manager)
    if dry_run:
        say("\n".join(f"# {name}\n{text}" for name, text in made.items()).rstrip())
        return SUCCESS
    folder = Path(where.folder) if where.folder else manager.usual_folder
    try:
        written = units.install(made, folder)
    except OSError as error:
        hint = "; run this command with sudo, or leave --system out" if manager.system else ""
        raise InputError(f"cannot write units to {folder}: {error.strerror}{hint}") from None
    for path in written:
        say(str(path))
    if not manager.system:
        say("they run while you are logged in; `loginctl enable-linger` starts them at boot")
    say(f"next: {manager.systemctl} daemon-reload && {manager.systemctl} enable --now {units.TARGET}")
    return SUCCESS


@service.command("uninstall")
@_unit_options
def uninstall(where: Units) -> int:
    """Remove exactly the units that `install` wrote."""
    from sextant.deploy.launch import units

    manager = where.manager()
    folder = Path(where.folder) if where.folder else manager.usual_folder
    try:
        removed, left = units.uninstall(folder, manager.systemctl)
    except OSError as error:
        raise InputError(f"cannot remove units from {folder}: {error.strerror}") from None
    for path in removed:
        say(f"removed {path}")
    for path in left:
        say(f"kept {path}: changed since `sextant service install` wrote it")
    say(f"next: {manager.systemctl} daemon-reload" if removed else f"no units of sextant in {folder}")
    return SUCCESS


@service.command("compose")
@option("--scenario", "name of the scenario", "NAME", default="steps")
@options.seed
@flag("--offboard", "print compose.yaml of the base station, with certificates")
def compose(scenario: str, seed: int, offboard: bool) -> int:
    """Print a compose.yaml that starts each service in its own container."""
    from sextant.deploy.launch.compose import compose_yaml, offboard_yaml

    say((offboard_yaml() if offboard else compose_yaml(scenario, seed)).rstrip("\n"))
    return SUCCESS


def _check_user(user: str) -> None:
    """Refuse a user that systemd could not start a unit as."""
    try:
        pwd.getpwnam(user)
    except KeyError:
        raise InputError(
            f"--as: a user of this machine expected, found {user!r}; `sudo useradd --system {user}` creates it"
        ) from None


def _made(launch: Launch, manager: "Manager") -> "Mapping[str, str]":
    """Return the requested units; all their paths are absolute.

    Raises:
        AccessError: The router would admit any client without --open, or the keys are wrong.
    """
    from sextant.deploy.launch import process_table, units
    from sextant.shared.wire.transport import Endpoints

    rows, chosen, extra = asked(launch)
    if chosen.scenario:
        chosen = replace(chosen, bus_port=process_table.BUS_PORT)
    gated = gate_of(launch, rows, process_table.ROUTER_ENDPOINT)
    router = process_table.router_command(gated.own, gated.words(), launch.role, rows)
    endpoints = Endpoints((gated.own,), namespace=launch.namespace)
    off = launch.role == "offboard"
    processes = process_table.commands(rows, chosen, endpoints, extra, off, gated.role(off))
    return units.units(router, processes, manager)
