"""`python -m benchmarks faults`: inject faults into walks and check the robot's reaction."""

import argparse
import difflib

from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, open_progress, out_folder, say, warm_up
from sextant.shared.files import whole_files

_PHASES, _LIVE_PHASES = 300, 30


def faults(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks faults`: inject each fault at many phases; succeed within all limits."""
    from benchmarks.faults.cases import BY_NAME, CASES, LIVE_CASES

    unknown = [name for name in arguments.fault if name not in BY_NAME]
    if unknown:
        near = difflib.get_close_matches(unknown[0], BY_NAME, 1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise InputError(f"no fault {unknown[0]!r}; {hint}`python -m benchmarks faults --list` lists all faults")
    wanted = [BY_NAME[name] for name in dict.fromkeys(arguments.fault)]
    cases = wanted or list(LIVE_CASES if arguments.live else CASES)
    if arguments.list:
        for case in wanted or (*(() if arguments.live else CASES), *LIVE_CASES):
            say(f"{case.name:<28} {case.words}{'; live' if case.live else ''}")
        return SUCCESS
    live = {case.live for case in cases}
    if len(live) > 1:
        raise InputError("either lockstep faults or live faults expected, found both; run the command once for each kind")
    phases = arguments.phases or (_LIVE_PHASES if live == {True} else _PHASES)
    jobs = 1 if live == {True} else arguments.jobs
    out = out_folder(arguments, "faults")
    from benchmarks.faults import table as tables
    from benchmarks.faults.batch import FILE, run_faults

    progress = open_progress(arguments.json)
    if live == {True}:
        warm_up(progress)
    found = run_faults(cases, phases, jobs, out, progress.say)
    table = tables.rows(found)
    say(tables.to_json(table).rstrip("\n") if arguments.json else tables.markdown(table))
    whole_files.write_text(out / "faults.json", tables.to_json(table), durable=True)
    whole_files.write_text(out / "faults.md", tables.markdown(table) + "\n")
    if not arguments.json:
        say(f"written to {out}: faults.md, faults.json, {FILE}")
    return SUCCESS if all(row.passed for row in table) else FAILED
