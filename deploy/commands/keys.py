"""`sextant keys`: certificates of a robot and of the machines that may connect."""

import argparse
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from sextant.deploy.commands.common import SUCCESS, InputError, say

if TYPE_CHECKING:
    from sextant.deploy.security.authority import Held


def new(arguments: argparse.Namespace) -> int:
    """`sextant keys new`: make an authority, and a folder of keys for each role."""
    from sextant.shared.wire.access import SITE

    authority = _authority()
    folder = Path(arguments.folder)
    try:
        addresses = {"robot": arguments.robot_address, SITE: arguments.site_address}
        made: tuple[Held, ...] = authority.new(folder, addresses, arguments.days)
    except OSError as error:
        raise InputError(f"cannot write {folder}: {error.strerror}") from None
    say(f"{folder / 'ca'}: certificate authority; keep it private, no running machine needs it")
    for one in made:
        say(f"{one.file.parent}: for {_what(one.role)}; until {one.ends:%Y-%m-%d}")
    if not arguments.robot_address:
        say("the robot's certificate is valid on loopback only; give --robot-address NAME_OR_IP for other machines")
    say("copy the folder of each role to its machine, and start sextant there with --keys FOLDER")
    return SUCCESS


def show(arguments: argparse.Namespace) -> int:
    """`sextant keys show`: print role and expiry of each certificate."""
    for one in _authority().held(Path(arguments.folder)):
        days = (one.ends - datetime.now(UTC)).total_seconds() / 86400.0
        ends = f"in {days:.0f} days" if days > 0 else f"{-days:.0f} days ago"
        say(f"{one.role:<8} until {one.ends:%Y-%m-%d %H:%M} UTC, {ends}: {one.file}")
    return SUCCESS


def _what(role: str) -> str:
    from sextant.shared.wire.access import ROLE_NAMED

    return ROLE_NAMED[role].what


def _authority() -> ModuleType:
    try:
        from sextant.deploy.security import authority
    except ImportError as error:
        raise InputError(f"{error}; certificates are made with cryptography: pip install 'sextant[access]'") from None
    return authority
