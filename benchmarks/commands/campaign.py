"""`python -m benchmarks campaign`: which claims of the documentation hold by this code, and run again those that do not."""

import difflib
import json
import math
import time
from dataclasses import asdict
from pathlib import Path

from benchmarks.campaign import evidence as evidences
from benchmarks.campaign import table
from benchmarks.campaign.evidence import Standing
from benchmarks.campaign.part import ROOT, Part, load
from benchmarks.campaign.run import PartError, run
from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, complain, open_progress, say
from sextant.deploy.terminal.arguments import argument, command, flag, number, option
from sextant.evaluation import provenance

_OUT = ROOT / "runs" / "campaign"


@command()
@argument("names", "parts to run (default: those that do not hold by this code, the oldest first)", "[PART]...", nargs=-1)
@flag("--run", "run the parts; without it, only print which claims hold", "run_them")
@option(
    "--hours",
    "stop after this time; what a part has finished by then is not repeated",
    "H",
    type=number(0.0, 10_000.0, "hours"),
)
@options.jobs
@option("--cluster", "Dask scheduler whose workers run the trials, or local:N for N workers on this machine", "ADDRESS")
@option("--out", "folder to write to (default: runs/campaign)", "DIR")
@options.as_json
def campaign(
    names: tuple[str, ...], run_them: bool, hours: float | None, jobs: int, cluster: str | None, out: str | None, as_json: bool
) -> int:
    """Print which claims of the documentation hold by this code, and run again those that do not."""
    parts, found = load(), evidences.read()
    for name in names:
        if name not in parts:
            near = difflib.get_close_matches(name, parts, 1)
            raise InputError(
                f"no part {name!r}{f'; did you mean {near[0]!r}?' if near else ''}; the parts are {', '.join(parts)}"
            )
    if not provenance.commit() or provenance.commit().startswith("version"):
        raise InputError("a checkout expected, because commits are compared; found none")
    wanted = {name: parts[name] for name in names or parts}
    standing = table.standings(wanted, found)
    if not run_them:
        say(_as_json(wanted, found, standing) if as_json else table.in_words(wanted, found, standing))
        return SUCCESS
    if provenance.commit().endswith("+"):
        raise InputError("a checkout without changes expected, because results carry its commit; commit the changes first")
    workers = f"--jobs {jobs}" if cluster is None else f"--cluster {cluster}"
    until = math.inf if hours is None else time.monotonic() + hours * 3600.0
    folder, hear, failed = _OUT if out is None else Path(out), open_progress(as_json).say, list[str]()
    for name in standing:
        if names or not standing[name].holds:
            hear(f"{name}: {wanted[name].claim}, about {wanted[name].core_hours:g} core-hours")
            try:
                made = run(wanted[name], folder / name / provenance.commit(), workers, until, hear)
            except PartError as error:  # the others do not depend on it
                failed.append(name)
                complain(f"{name}: {error}")
                continue
            if made is None:
                hear(f"{name}: not finished after {hours:g} hours; the next run continues at the same commit")
                break
            found[name] = made
            evidences.keep(found)
            hear(f"{name}: docs/{wanted[name].kept}")
    standing = table.standings(wanted, found)
    say(_as_json(wanted, found, standing) if as_json else table.in_words(wanted, found, standing))
    if failed:
        complain(f"without a result: {', '.join(failed)}")
    return FAILED if failed else SUCCESS


def _as_json(parts: dict[str, Part], found: dict[str, evidences.Evidence], standing: dict[str, Standing]) -> str:
    rows = {
        name: {
            "claim": parts[name].claim,
            "commands": parts[name].commands,
            "made": asdict(found[name]) if name in found else None,
            "holds": state.holds,
            "reason": state.reason,
        }
        for name, state in standing.items()
    }
    return json.dumps(rows, indent=1)
