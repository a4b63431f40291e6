"""`sextant keys`: certificates of a robot and of the machines that may connect."""

from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import SUCCESS, InputError, say
from sextant.deploy.terminal.arguments import Group, argument, option

if TYPE_CHECKING:
    from sextant.deploy.security.authority import Held

keys = Group("keys", "Make and show the certificates of each role.")


@keys.command("new")
@argument("folder", "folder to create the keys in; existing files are not overwritten", "DIR")
@option(
    "--robot-address",
    "host name or address of the robot, e.g. hexapod.local or 192.168.1.20; repeatable",
    "NAME_OR_IP",
    multiple=True,
)
@option(
    "--site-address",
    "host name or address of a router between the robot and others, if any, see docs/fleet.md; repeatable",
    "NAME_OR_IP",
    multiple=True,
)
@options.count("--days", 365, "validity in days")
def new(folder: str, robot_address: tuple[str, ...], site_address: tuple[str, ...], days: int) -> int:
    """Make an authority, and a folder of keys for each role."""
    from sextant.shared.wire.access import SITE

    authority = _authority()
    path = Path(folder)
    try:
        made: tuple[Held, ...] = authority.new(path, {"robot": robot_address, SITE: site_address}, days)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    say(f"{path / 'ca'}: certificate authority; keep it private, no running machine needs it")
    for one in made:
        say(f"{one.file.parent}: for {_what(one.role)}; until {one.ends:%Y-%m-%d}")
    if not robot_address:
        say("the robot's certificate is valid on loopback only; give --robot-address NAME_OR_IP for other machines")
    say("copy the folder of each role to its machine, and start sextant there with --keys FOLDER")
    return SUCCESS


@keys.command("show")
@argument("folder", "folder of `sextant keys new`, or of one role", "DIR")
def show(folder: str) -> int:
    """Print role and expiry of each certificate."""
    for one in _authority().held(Path(folder)):
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
