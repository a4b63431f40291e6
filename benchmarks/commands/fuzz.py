"""`python -m benchmarks fuzz`: fuzz every message and file parser."""

import difflib
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, SUCCESS, CommandError, InputError, open_progress, out_folder, say
from sextant.deploy.terminal.arguments import command, flag, option
from sextant.shared.files import whole_files

_PARTS = 20  # tasks into which the messages are divided


@command()
@options.count("--messages", 10_000_000, "total number of messages")
@options.count("--seed", 0, "random seed", lowest=0)
@option("--only", "parser to fuzz; repeatable (default: all)", "NAME", multiple=True)
@flag("--list", "list the parsers and exit", "listed")
@option("--give", "pass this file unchanged to the parser named by --only", "FILE")
@options.jobs
@options.out
@options.as_json
def fuzz(
    messages: int,
    seed: int,
    only: tuple[str, ...],
    listed: bool,
    give: str | None,
    jobs: int,
    out: str | None,
    as_json: bool,
) -> int:
    """Fuzz every message and file parser; fail on a fault or growing memory."""
    from benchmarks.fuzz import fuzzing
    from benchmarks.fuzz import table as tables
    from sextant.shared.runtime.workers import share_out

    known = fuzzing.names()
    for name in only:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise InputError(f"no parser {name!r}; {hint}`python -m benchmarks fuzz --list` lists all parsers")
    if listed:
        say("\n".join(known))
        return SUCCESS
    if give:
        return _give(only, Path(give))
    folder, progress = out_folder(out, "fuzz"), open_progress(as_json)
    parts = min(_PARTS, messages)
    newest = [folder / f"newest-{part}.bin" for part in range(parts)]
    share, more = divmod(messages, parts)
    tasks = [(share + (k < more), _PARTS * seed + k, only, newest[k]) for k in range(parts)]
    runs: list[fuzzing.Found] = []
    try:
        for run in share_out(fuzzing.fuzz, tasks, jobs, in_order=False):
            runs.append(run)
            progress.say(f"{len(runs)} of {parts} parts of {messages:,} messages: {len(run.findings)} faults")
    except BrokenProcessPool:
        left = [str(file) for file in newest if file.exists()]
        where = ", ".join(left)
        raise CommandError(f"a message crashed a process; the message is in one of these files: {where}") from None
    found = tables.table(runs)
    for file in newest:
        file.unlink()
    for number, finding in enumerate(found.findings):
        whole_files.write_bytes(folder / f"finding-{number}.bin", finding.data)
    say(tables.to_json(found) if as_json else tables.markdown(found))
    whole_files.write_text(folder / "fuzz.json", tables.to_json(found) + "\n", durable=True)
    if not as_json:
        say(f"written to {folder / 'fuzz.json'}")
    return SUCCESS if found.passed else FAILED


def _give(only: tuple[str, ...], file: Path) -> int:
    from benchmarks.fuzz import fuzzing

    if len(only) != 1:
        raise InputError(f"one --only expected, the parser of {file}, found {len(only)}")
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from None
    say(f"{only[0]}: {'accepted' if fuzzing.give(only[0], data) else 'refused'}")
    return SUCCESS
