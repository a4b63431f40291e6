"""Base class of the errors that the command line reports as one line, without a traceback."""


class SextantError(Exception):
    """Error whose message tells the user what was expected, what was found, and what to do."""

    exit_status = 2  # invalid input; 1 if the machine or the robot is the cause
