"""Common parts of all commands: errors, output and folders."""

import datetime
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.terminal.output import complain as complain
from sextant.deploy.terminal.output import say as say
from sextant.deploy.terminal.run_command import FAILED as FAILED
from sextant.deploy.terminal.run_command import INTERRUPTED as INTERRUPTED
from sextant.deploy.terminal.run_command import SUCCESS as SUCCESS
from sextant.deploy.terminal.run_command import WRONG_INPUT as WRONG_INPUT
from sextant.deploy.terminal.run_command import CommandError as CommandError
from sextant.shared.errors import SextantError

if TYPE_CHECKING:
    from sextant.evaluation.observers.progress import Progress


class InputError(SextantError, ValueError):
    """Invalid input by the caller, with what is expected."""


def out_folder(asked: str | None, name: str) -> Path:
    """Create and return the output folder of a command."""
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    out = Path(asked) if asked else Path("runs") / f"{stamp}-{name}"
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create the folder {out}: {error.strerror}; give another with --out") from None
    if not os.access(out, os.W_OK | os.X_OK):
        raise InputError(f"this user may not write to the folder {out}; give another with --out")
    return out


def open_progress(as_json: bool) -> "Progress":
    """Return a progress display on stdout, or on stderr if the result is JSON."""
    from sextant.deploy.terminal.progress import progress_for

    return progress_for(sys.stderr if as_json else sys.stdout)


def say_if_it_compiles(progress: "Progress") -> None:
    """Say that the first walk compiles, if nothing has been compiled yet."""
    from sextant.deploy.launch.warm_up import has_compiled

    if not has_compiled():
        progress.say("the inner loops are compiled during the first walk, which takes half a minute")


def warm_up(progress: "Progress") -> None:
    """Compile everything that services would otherwise compile during the walk.

    Raises:
        CommandError: It failed; the message says why.
        KeyboardInterrupt: The operator interrupted it.
    """
    from sextant.deploy.live.live_run import warm_up
    from sextant.deploy.terminal.interrupts import Interrupts

    with Interrupts() as interrupts:
        problem = warm_up(progress, interrupts)
    if interrupts.asked():
        raise KeyboardInterrupt
    if problem:
        raise CommandError(f"{problem}; `sextant doctor` checks what the services need")
