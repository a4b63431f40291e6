"""`sextant service`: the processes of a role as systemd services."""

import argparse
import getpass
import grp
import os
import pwd
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.commands.common import SUCCESS, InputError, say

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sextant.deploy.launch.units import Manager


def install(arguments: argparse.Namespace) -> int:
    """`sextant service install`: write a unit per process of a role, and a target."""
    from sextant.deploy.launch import units

    manager = _manager(arguments)
    if manager.system:
        _check_user(manager.user)
    made = _made(arguments, manager)
    if arguments.dry_run:
        say("\n".join(f"# {name}\n{text}" for name, text in made.items()).rstrip())
        return SUCCESS
    folder = Path(arguments.folder) if arguments.folder else manager.usual_folder
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


def uninstall(arguments: argparse.Namespace) -> int:
    """`sextant service uninstall`: remove exactly what `install` wrote."""
    from sextant.deploy.launch import units

    manager = _manager(arguments)
    folder = Path(arguments.folder) if arguments.folder else manager.usual_folder
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


def _manager(arguments: argparse.Namespace) -> "Manager":
    from sextant.deploy.launch.units import DEVICE_GROUPS, Manager

    if not arguments.system:
        if arguments.run_as:
            raise InputError("--as is for --system units; the user's own service manager runs its units as that user")
        return Manager(sys.executable)
    user = arguments.run_as or os.environ.get("SUDO_USER") or getpass.getuser()
    there = {group.gr_name for group in grp.getgrall()}  # systemd starts no unit with an unknown group
    return Manager(sys.executable, user, tuple(group for group in DEVICE_GROUPS if group in there))


def _check_user(user: str) -> None:
    """Refuse a user that systemd could not start a unit as."""
    try:
        pwd.getpwnam(user)
    except KeyError:
        raise InputError(
            f"--as: a user of this machine expected, found {user!r}; `sudo useradd --system {user}` creates it"
        ) from None


def _made(arguments: argparse.Namespace, manager: "Manager") -> "Mapping[str, str]":
    """Return the requested units; all their paths are absolute.

    Raises:
        AccessError: The router would admit any client without --open, or the keys are wrong.
    """
    from sextant.deploy.commands.up import asked, gate_of
    from sextant.deploy.launch import process_table, units
    from sextant.shared.wire.transport import Endpoints

    rows, chosen, extra = asked(arguments)
    if chosen.scenario:
        chosen = replace(chosen, bus_port=process_table.BUS_PORT)
    gated = gate_of(arguments, rows, process_table.ROUTER_ENDPOINT)
    router = process_table.router_command(gated.own, gated.words(), arguments.role, rows)
    endpoints = Endpoints((gated.own,), namespace=arguments.namespace)
    off = arguments.role == "offboard"
    processes = process_table.commands(rows, chosen, endpoints, extra, off, gated.role(off))
    return units.units(router, processes, manager)
