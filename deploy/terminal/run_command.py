"""Run a command: exit status and error reporting."""

import argparse
from collections.abc import Callable, Sequence

from sextant.deploy.terminal.output import OutputError, complain, discard_output, flushed_output, prepare_streams
from sextant.shared.errors import SextantError
from sextant.shared.files.whole_files import OUT_OF_ROOM, cause

SUCCESS, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130


def run_command(program: str, parse: Callable[[Sequence[str]], argparse.Namespace], argv: Sequence[str]) -> int:
    """Parse and run a command; return its exit status.

    Args:
        program: Name of the program, for messages.
        parse: Returns the arguments, with `name` and `command` of the chosen command; ends the program if they are invalid.
        argv: Command line after the program.
    """
    prepare_streams()
    name = program
    try:
        with flushed_output():
            arguments = parse(argv)
            name = f"{program} {arguments.name}"
            return int(arguments.command(arguments))
    except KeyboardInterrupt:
        complain("stopped by the operator")
        return INTERRUPTED
    except BrokenPipeError:  # the reader closed the pipe
        discard_output()
        return FAILED
    except OutputError as error:
        discard_output()
        complain(f"{name}: {error}")
        return FAILED
    except SextantError as error:
        complain(f"{name}: {error}")
        return error.exit_status
    except OSError as error:
        if error.errno not in OUT_OF_ROOM:
            raise
        complain(f"{name}: {error.filename or 'a temporary file'} cannot be written: {cause(error)}")
        return FAILED
