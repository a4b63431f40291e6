"""`sextant trials`: many seeds of one scenario or of all, and the tables of what was kept."""

import argparse
import sys
from pathlib import Path

from deploy.commands.common import SUCCESS, InputError, as_asked, asked_scenario, open_progress, out_folder, say


def trials(arguments: argparse.Namespace) -> int:
    """`sextant trials`: the success rate over many seeds, in lockstep."""
    if arguments.scenario == "all":
        return _campaign(arguments)
    scenario = asked_scenario(arguments)
    out = out_folder(arguments, f"trials-{scenario.name}")
    from deploy import trials as batches

    progress = open_progress(arguments.json)
    seeing = batches.run_trials(scenario, arguments.seeds, arguments.jobs, out, say=progress.say)
    baseline = None
    if arguments.blind:
        progress.say("the same without a map")
        baseline = batches.run_trials(scenario, arguments.seeds, arguments.jobs, out, blind=True, say=progress.say)
    (out / "trials.json").write_text(batches.to_json(seeing, baseline), encoding="utf-8")
    if arguments.json:
        sys.stdout.write(batches.to_json(seeing, baseline))
    else:
        say(batches.words(seeing, baseline))
        say(f"written to {out}: trials.json, trials.jsonl")
    return SUCCESS


def _campaign(arguments: argparse.Namespace) -> int:
    """`sextant trials all`: the table of all terrains."""
    from deploy import campaign_table as tables
    from deploy.campaign import run_campaign

    asked = as_asked(arguments)
    out = out_folder(arguments, "trials-all")
    hear = open_progress(arguments.json).say
    found = run_campaign(tables.WALKED, arguments.seeds, arguments.jobs, out, arguments.blind, asked, hear)
    tables.write(found, out)
    if arguments.json:
        sys.stdout.write(tables.to_json(found))
    else:
        say(tables.markdown(found))
        say(f"written to {out}: table.md, campaign.json, campaign.jsonl, and a folder per terrain")
    return SUCCESS


def table(arguments: argparse.Namespace) -> int:
    """`sextant trials table`: a table of runs that were kept, nothing being run."""
    from deploy import campaign_table as tables
    from deploy import kept

    files = kept.files([Path(place) for place in arguments.kept])
    found = tables.of_runs(run for path in files for run in kept.read(path))
    if not found.entries:
        raise InputError(f"no finished run in {', '.join(map(str, files))}")
    sys.stdout.write(tables.to_json(found) if arguments.json else tables.markdown(found, arguments.of))
    return SUCCESS
