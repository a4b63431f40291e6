"""`python -m benchmarks faults`: inject faults into walks and check the robot's reaction."""

import difflib
import fnmatch

from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, open_progress, out_folder, say, warm_up
from sextant.deploy.terminal.arguments import argument, command, flag, option
from sextant.shared.files import whole_files
from sextant.shared.robot.profiles import load_profile

_PHASES, _LIVE_PHASES = 300, 30


@command()
@argument(
    "names",
    "faults to inject, also by patterns such as 'camera-*-steps', or a table: robot, legs, camera, live (default: all)",
    "[FAULT]...",
    nargs=-1,
)
@flag("--live", "inject the faults that need live processes over Zenoh, not those in lockstep")
@option("--phases", "injections of each fault (default: 300, live 30)", "N", type=options.POSITIVE)
@flag("--list", "list the faults and exit", "listed")
@options.robot
@options.jobs
@option("--out", "folder to write to; injections stored there are not repeated", "DIR")
@options.as_json
def faults(
    names: tuple[str, ...],
    live: bool,
    phases: int | None,
    listed: bool,
    robot: str,
    jobs: int,
    out: str | None,
    as_json: bool,
) -> int:
    """Inject faults at many phases of a step, and check the robot's reaction."""
    from benchmarks.faults.cases import BY_NAME, CAMERA_CASES, CASES, GRIDS, LIVE_CASES
    from benchmarks.faults.fault_run import SCENARIO
    from benchmarks.faults.robot_cases import of_robot

    of_grid = {grid: [case.name for case in cases] for grid, cases in GRIDS.items()}
    names = tuple(match for name in names for match in of_grid.get(name) or fnmatch.filter(BY_NAME, name) or [name])
    unknown = [name for name in names if name not in BY_NAME]
    if unknown:
        near = difflib.get_close_matches(unknown[0], BY_NAME, 1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise InputError(f"no fault {unknown[0]!r}; {hint}`python -m benchmarks faults --list` lists all faults")
    wanted = [BY_NAME[name] for name in dict.fromkeys(names)]
    lockstep = (*CASES, *CAMERA_CASES)
    cases = wanted or list(LIVE_CASES if live else lockstep)
    if listed:
        for case in wanted or (*(() if live else lockstep), *LIVE_CASES):
            say(f"{case.name:<32} {case.words}{'; live' if case.live else ''}")
        return SUCCESS
    kinds = {case.live for case in cases}
    if len(kinds) > 1:
        raise InputError("either lockstep faults or live faults expected, found both; run the command once for each kind")
    live, robot = kinds == {True}, options.checked_robot(robot)
    if live and robot != SCENARIO.robot:
        raise InputError(f"--robot: {SCENARIO.robot} expected with live faults, found {robot}; other robots walk in lockstep")
    profile = load_profile(robot)
    if len(profile.servos.buses) > 1 or (profile.servo.pulses and profile.servo.pulses.board != "maestro"):
        raise InputError(f"--robot: a robot with one servo bus or a Maestro expected, found {robot}")
    possible = {case.name: case for case in of_robot(cases, profile)}
    missing = ", ".join(case.name for case in cases if case.name not in possible)
    if not possible:
        raise InputError(f"{missing}: the servos of {robot} do not report this")
    folder = out_folder(out, "faults")
    from benchmarks.faults import table as tables
    from benchmarks.faults.batch import FILE, run_faults

    progress = open_progress(as_json)
    if missing:
        progress.say(f"left out, since the servos of {robot} do not report it: {missing}")
    if live:
        warm_up(progress)
    count = phases or (_LIVE_PHASES if live else _PHASES)
    found = run_faults(list(possible.values()), count, 1 if live else jobs, folder, progress.say, robot=robot)
    table = tables.rows(found, possible)
    say(tables.to_json(table).rstrip("\n") if as_json else tables.markdown(table))
    whole_files.write_text(folder / "faults.json", tables.to_json(table), durable=True)
    whole_files.write_text(folder / "faults.md", tables.markdown(table) + "\n")
    if not as_json:
        say(f"written to {folder}: faults.md, faults.json, {FILE}")
    return SUCCESS if all(row.passed for row in table) else FAILED
