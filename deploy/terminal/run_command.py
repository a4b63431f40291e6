"""Run a command: exit status, error reporting and completion of words in a shell."""

import os
from collections.abc import Sequence

import click

from sextant.deploy.terminal.arguments import in_one_line, parse
from sextant.deploy.terminal.missing_extra import remedy, uvx_command
from sextant.deploy.terminal.output import (
    OutputError,
    complain,
    discard_output,
    explained,
    flushed_output,
    prepare_streams,
)
from sextant.shared.errors import SextantError
from sextant.shared.files.whole_files import OUT_OF_ROOM, cause

_AGAIN = "SEXTANT_STARTED_AGAIN"  # set in a command that was started again with the extra that it lacked
SUCCESS, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130


class CommandError(SextantError):
    """Failure of a command that the machine or the robot causes."""

    exit_status = FAILED


def run_command(program: click.Command, name: str, argv: Sequence[str]) -> int:
    """Parse and run a command; return its exit status.

    Args:
        program: The commands.
        name: Name of the program, for messages.
        argv: Command line after the program.
    """
    prepare_streams()
    variable = f"_{name}_COMPLETE".upper()
    try:
        with flushed_output():
            if asked := os.environ.get(variable):
                from click.shell_completion import shell_complete

                return shell_complete(program, {}, name, variable, asked)
            with explained():  # it may print the help
                chosen = parse(program, name, argv)
            name = chosen.path
            return chosen.run()
    except KeyboardInterrupt as interrupt:
        complain(": ".join(("stopped by the operator", *map(str, interrupt.args))))
        return INTERRUPTED
    except BrokenPipeError:  # the reader closed the pipe
        discard_output()
        return FAILED
    except OutputError as error:
        discard_output()
        complain(f"{name}: {error}")
        return FAILED
    except click.UsageError as error:
        complain(in_one_line(error))
        return WRONG_INPUT
    except SextantError as error:
        complain(f"{name}: {error}")
        return error.exit_status
    except ModuleNotFoundError as error:
        words = remedy(error)
        if not words:
            raise
        if (again := uvx_command(argv)) and _AGAIN not in os.environ:
            os.environ[_AGAIN] = "1"
            os.execv(again[0], again)
        complain(f"{name}: {words}")
        return WRONG_INPUT
    except OSError as error:
        if error.errno not in OUT_OF_ROOM:
            raise
        complain(f"{name}: {error.filename or 'a temporary file'} cannot be written: {cause(error)}")
        return FAILED
