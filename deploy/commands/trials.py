"""`sextant trials`: many seeds of one scenario or of all, and result tables."""

import argparse
from pathlib import Path

from sextant.deploy.commands.common import SUCCESS, InputError, as_asked, asked_scenario, open_progress, out_folder, say
from sextant.shared.files import whole_files


def trials(arguments: argparse.Namespace) -> int:
    """`sextant trials`: measure the success rate over many seeds, in lockstep."""
    if arguments.scenario in ("all", "passages", "troubles"):
        return _campaign(arguments)
    scenario = asked_scenario(arguments)
    out = out_folder(arguments, f"trials-{scenario.name}")
    from sextant.deploy.campaign import trials as batches

    progress = open_progress(arguments.json)
    seeing = batches.run_trials(scenario, arguments.seeds, arguments.jobs, out, say=progress.say)
    baseline = None
    if arguments.blind:
        progress.say("now the same seeds without a map")
        baseline = batches.run_trials(scenario, arguments.seeds, arguments.jobs, out, blind=True, say=progress.say)
    text = batches.to_json(seeing, baseline)
    say(text.rstrip("\n") if arguments.json else batches.words(seeing, baseline))
    whole_files.write_text(out / "trials.json", text, durable=True)
    if not arguments.json:
        say(f"written to {out}: trials.json, trials.jsonl")
    return SUCCESS


def _campaign(arguments: argparse.Namespace) -> int:
    """`sextant trials all`, `passages`, `troubles`: run a group of scenarios.

    Print one table of all of them.
    """
    from sextant.deploy.campaign import campaign_table as tables
    from sextant.deploy.campaign import results_store
    from sextant.deploy.campaign.campaign import run_campaign
    from sextant.deploy.campaign.passage_table import markdown as sections

    passages = arguments.scenario == "passages"
    asked = as_asked(arguments)
    out = out_folder(arguments, f"trials-{arguments.scenario}")
    hear = open_progress(arguments.json).say
    courses = {"all": tables.WALKED, "passages": tables.PASSAGES, "troubles": tables.TROUBLED}[arguments.scenario]
    table = "passages" if passages else "walks"
    found = run_campaign(courses, arguments.seeds, arguments.jobs, out, arguments.blind, asked, hear, table=table)
    say(tables.to_json(found).rstrip("\n") if arguments.json else tables.markdown(found, table))
    if passages and not arguments.json:
        say(sections(results_store.read(out / "campaign.jsonl")))
    tables.write(found, out, table)
    if not arguments.json:
        say(f"written to {out}: table.md, campaign.json, campaign.jsonl, and a folder per terrain")
    return SUCCESS


def table(arguments: argparse.Namespace) -> int:
    """`sextant trials table`: print a table of stored runs, without running anything."""
    from sextant.deploy.campaign import campaign_table as tables
    from sextant.deploy.campaign import passage_table, results_store

    paths = results_store.files([Path(place) for place in arguments.kept])
    runs = [run for path in paths for run in results_store.read(path)]
    if not runs:
        raise InputError(f"no finished run in {', '.join(map(str, paths))}")
    if arguments.of == "sections" and not arguments.json:
        say(passage_table.markdown(runs).rstrip("\n"))
        return SUCCESS
    found = tables.of_runs(runs)
    say((tables.to_json(found) if arguments.json else tables.markdown(found, arguments.of)).rstrip("\n"))
    return SUCCESS
