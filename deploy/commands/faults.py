"""`sextant faults`: faults injected into walks in lockstep, and what the robot did, against its limits."""

import argparse
import difflib
import sys

from deploy.commands.common import FAILED, SUCCESS, InputError, open_progress, out_folder, say


def faults(arguments: argparse.Namespace) -> int:
    """`sextant faults`: inject each fault at many phases; success only if every limit is kept."""
    from deploy.faults.cases import BY_NAME, CASES

    unknown = [name for name in arguments.fault if name not in BY_NAME]
    if unknown:
        near = difflib.get_close_matches(unknown[0], BY_NAME, 1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise InputError(f"no fault {unknown[0]!r}; {hint}`sextant faults --list` names them all")
    cases = [BY_NAME[name] for name in dict.fromkeys(arguments.fault)] or list(CASES)
    if arguments.list:
        for case in cases:
            say(f"{case.name:<24} {case.words}")
        return SUCCESS
    out = out_folder(arguments, "faults")
    from deploy.faults import table as tables
    from deploy.faults.batch import FILE, run_faults

    found = run_faults(cases, arguments.phases, arguments.jobs, out, open_progress(arguments.json).say)
    table = tables.rows(found)
    (out / "faults.json").write_text(tables.to_json(table), encoding="utf-8")
    (out / "faults.md").write_text(tables.markdown(table) + "\n", encoding="utf-8")
    if arguments.json:
        sys.stdout.write(tables.to_json(table))
    else:
        say(tables.markdown(table))
        say(f"written to {out}: faults.md, faults.json, {FILE}")
    return SUCCESS if all(row.passed for row in table) else FAILED
