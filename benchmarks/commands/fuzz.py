"""`python -m benchmarks fuzz`: fuzz every message and file parser."""

import argparse
import difflib
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, complain, open_progress, out_folder, say
from sextant.shared.files import whole_files

_PARTS = 20  # tasks into which the messages are divided


def fuzz(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks fuzz`: fuzz all parsers; fail on a fault or growing memory."""
    from benchmarks.fuzz import fuzzing
    from benchmarks.fuzz import table as tables
    from sextant.deploy.workers import share_out

    known = fuzzing.names()
    for name in arguments.only:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise InputError(f"no parser {name!r}; {hint}`python -m benchmarks fuzz --list` lists all parsers")
    if arguments.list:
        say("\n".join(known))
        return SUCCESS
    if arguments.give:
        return _give(arguments.only, Path(arguments.give))
    out, progress = out_folder(arguments, "fuzz"), open_progress(arguments.json)
    parts = min(_PARTS, arguments.messages)
    newest = [out / f"newest-{part}.bin" for part in range(parts)]
    share, more = divmod(arguments.messages, parts)
    tasks = [(share + (k < more), _PARTS * arguments.seed + k, arguments.only, newest[k]) for k in range(parts)]
    runs: list[fuzzing.Found] = []
    try:
        for run in share_out(fuzzing.fuzz, tasks, arguments.jobs, in_order=False):
            runs.append(run)
            progress.say(f"{len(runs)} of {parts} parts of {arguments.messages:,} messages: {len(run.findings)} faults")
    except BrokenProcessPool:
        left = [str(file) for file in newest if file.exists()]
        complain(
            f"python -m benchmarks fuzz: a message crashed a process; the message is in one of these files: {', '.join(left)}"
        )
        return FAILED
    found = tables.table(runs)
    for file in newest:
        file.unlink()
    for number, finding in enumerate(found.findings):
        whole_files.write_bytes(out / f"finding-{number}.bin", finding.data)
    say(tables.to_json(found) if arguments.json else tables.markdown(found))
    whole_files.write_text(out / "fuzz.json", tables.to_json(found) + "\n", durable=True)
    if not arguments.json:
        say(f"written to {out / 'fuzz.json'}")
    return SUCCESS if found.passed else FAILED


def _give(only: list[str], file: Path) -> int:
    from benchmarks.fuzz import fuzzing

    if len(only) != 1:
        raise InputError(f"one --only expected, the parser of {file}, found {len(only)}")
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from None
    say(f"{only[0]}: {'accepted' if fuzzing.give(only[0], data) else 'refused'}")
    return SUCCESS
