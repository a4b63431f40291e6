"""`python -m benchmarks`: accuracy, speed and robustness benchmarks."""

from pathlib import Path

from sextant.deploy.commands import options
from sextant.deploy.commands.common import (
    FAILED,
    SUCCESS,
    CommandError,
    InputError,
    open_progress,
    out_folder,
    say,
    warm_up,
)
from sextant.deploy.terminal.arguments import Group, Parsed, flag, number, option, whole
from sextant.shared.files import whole_files

benchmarks = Group("benchmarks", "Benchmarks, fault injection and fuzzing of Sextant.")
_seeds = option(
    "--seeds", "seeds of the rides, B not included", "A:B", type=Parsed(options.seeds, "seeds"), default="1000:1003"
)
_frames = option("--frames", "frames of each ride, 2 cm apart", "N", type=whole(3, 100_000), default=100)
_registration = options.plugin("registration")


@benchmarks.command("accuracy")
@options.jobs
@_seeds
@_registration
@options.params
@options.out
@options.as_json
def bench_accuracy(jobs: int, seeds: range, registration: str, params: tuple[str, ...], out: str | None, as_json: bool) -> int:
    """Measure pose and map errors of the real services on rebuilt scenes.

    With a plug-in or parameters, a second row of each scene has its errors.
    """
    from benchmarks.peers import accuracy
    from sextant.evaluation.params import assigned_table

    options.check_plugin("registration", registration)
    variant = accuracy.Variant(registration, assigned_table(params))
    if unused := sorted(variant.params.keys() - {"perception", "mapper"}):
        raise InputError(
            f"--set: a parameter of perception or mapper expected, found one of {unused[0]}, which does not run here"
        )
    folder = out_folder(out, "bench-accuracy")
    rows = accuracy.tables(seeds, jobs, open_progress(as_json).say, variant)
    return _tell_bench(accuracy.in_words(rows), accuracy.to_json(rows), folder / "accuracy.json", as_json)


@benchmarks.command("speed")
@_frames
@_seeds
@option("--recording", "depth sequence with reference poses (TUM layout), instead of rides", "DIR")
@option("--only", "compare only with methods with these words in their name", "WORDS", default="")
@_registration
@options.out
@options.as_json
def bench_speed(
    frames: int, seeds: range, recording: str | None, only: str, registration: str, out: str | None, as_json: bool
) -> int:
    """Compare error and time of registration with other implementations, frame by frame."""
    from benchmarks.peers import chart, registration_speed, timing

    options.check_plugin("registration", registration)
    folder, say_progress = out_folder(out, "bench-speed"), open_progress(as_json).say
    if recording is not None:
        found = registration_speed.on_recording(Path(recording), say_progress, registration, only)
    else:
        found = registration_speed.registration(seeds, frames, say_progress, registration, only)
    chart.draw(folder / "speed.png", "Registration and other implementations", found.timings, found.missing)
    words = timing.in_words(found, registration_speed.HEADINGS)
    return _tell_bench(words, timing.to_json(found), folder / "speed.json", as_json)


@benchmarks.command("stages")
@_frames
@_seeds
@options.plugin("foothold")
@option("--anybotics", "folder with checkouts of ANYbotics' elevation_mapping and grid_map, and eigen3, to compile", "DIR")
@options.out
@options.as_json
def bench_stages(frames: int, seeds: range, foothold: str, anybotics: str | None, out: str | None, as_json: bool) -> int:
    """Compare the times of the mapping stages with other implementations."""
    from benchmarks.peers import anybotics_core, chart, map_stages, timing

    options.check_plugin("foothold", foothold)
    folder = out_folder(out, "bench-stages")
    try:
        core = anybotics_core.build(Path(anybotics), folder.resolve()) if anybotics else None
    except anybotics_core.BuildError as error:
        raise CommandError(f"--anybotics: {error}") from None
    found = map_stages.stages(seeds, frames, open_progress(as_json).say, foothold, core)
    chart.draw(folder / "stages.png", "Mapping stages and other implementations", found.timings, found.missing, found.parts_ms)
    return _tell_bench(map_stages.in_words(found), timing.to_json(found), folder / "stages.json", as_json)


@benchmarks.command("maps")
@_frames
@_seeds
@options.out
@options.as_json
def bench_maps(frames: int, seeds: range, out: str | None, as_json: bool) -> int:
    """Compare our map building with Masri's as published: pose, heights, footholds and time."""
    from benchmarks.peers import map_building

    folder = out_folder(out, "bench-maps")
    built = map_building.measure(seeds, frames, say=open_progress(as_json).say)
    return _tell_bench(map_building.in_words(built), map_building.to_json(built), folder / "maps.json", as_json)


@benchmarks.command("passage")
@_seeds
@options.out
@options.as_json
def bench_passage(seeds: range, out: str | None, as_json: bool) -> int:
    """Compare the time of the passage planner with others, and check its plans."""
    from benchmarks.peers import chart, passage, timing

    folder = out_folder(out, "bench-passage")
    found = passage.measure(seeds, say=open_progress(as_json).say)
    chart.draw(folder / "passage.png", "Passage planner and other implementations", found.timings, found.missing)
    return _tell_bench(passage.in_words(found), timing.to_json(found), folder / "passage.json", as_json)


@benchmarks.command("plans")
@option(
    "--scenario",
    "course whose requests are planned; repeatable (default: steps, rubble, stepping_stones)",
    "NAME",
    multiple=True,
)
@_seeds
@options.count("--requests", 40, "most requests of a walk")
@options.plugin("planner")
@options.out
@options.as_json
def bench_plans(scenario: tuple[str, ...], seeds: range, requests: int, planner: str, out: str | None, as_json: bool) -> int:
    """Compare step planners on the requests of lockstep walks: time, and whether the actuator accepts the steps."""
    from benchmarks.peers import step_plans, timing
    from sextant.shared.scenario.loading import load_scenario

    courses = [load_scenario(name) for name in dict.fromkeys(scenario) or step_plans.COURSES]
    options.check_plugin("planner", planner)
    folder = out_folder(out, "bench-plans")
    found = step_plans.measure(courses, seeds, requests, planner, open_progress(as_json).say)
    return _tell_bench(timing.in_words(found, step_plans.HEADINGS), timing.to_json(found), folder / "plans.json", as_json)


@benchmarks.command("cycle")
@option("--scenario", "course of the walks", "NAME", default="steps")
@_seeds
@options.count("--cycles", 2000, "most control cycles of a walk")
@options.out
@options.as_json
def bench_cycle(scenario: str, seeds: range, cycles: int, out: str | None, as_json: bool) -> int:
    """Measure the computing time of the actuator's control cycle, standing and walking."""
    from benchmarks.robot import actuator_cycle
    from sextant.shared.scenario.loading import load_scenario

    course = load_scenario(scenario)
    folder = out_folder(out, "bench-cycle")
    try:
        found = actuator_cycle.measure(course, seeds, cycles)
    except ValueError as error:
        raise CommandError(str(error)) from None
    return _tell_bench(actuator_cycle.in_words(found), actuator_cycle.to_json(found), folder / "cycle.json", as_json)


@benchmarks.command("calibration")
@options.robot
@option("--scenario", "ground and deviations of the robots", "NAME", default="flat+harsh")
@option("--seeds", "seeds of the robots, B not included", "A:B", type=Parsed(options.seeds, "seeds"), default="1000:1010")
@options.jobs
@options.out
@options.as_json
def bench_calibration(robot: str, scenario: str, seeds: range, jobs: int, out: str | None, as_json: bool) -> int:
    """Calibrate simulated robots that differ from their profile, and compare with the truth."""
    from benchmarks.robot import calibration
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.scenario.loading import load_scenario

    load_profile(robot)  # a wrong name is reported before anything starts
    load_scenario(scenario)
    folder = out_folder(out, "bench-calibration")
    found = calibration.measure(robot, scenario, seeds, jobs, open_progress(as_json).say)
    return _tell_bench(calibration.in_words(found), calibration.to_json(found), folder / "calibration.json", as_json)


@benchmarks.command("naming")
@option("--scenarios", "courses of the walks", "NAMES", default="steps,cobbles,stairs")
@option("--errors", "errors to walk with, one at a time", "KINDS", default="none,pitch,roll,yaw,height,depth,delay,horn")
@option("--seeds", "seeds of the walks, B not included", "A:B", type=Parsed(options.seeds, "seeds"), default="1000:1003")
@options.jobs
@options.out
@options.as_json
def bench_naming(scenarios: str, errors: str, seeds: range, jobs: int, out: str | None, as_json: bool) -> int:
    """Walk with one error of the camera or a horn, and count whether the robot names it and nothing else."""
    from benchmarks.robot import naming
    from sextant.shared.scenario.loading import load_scenario

    courses, kinds = scenarios.split(","), errors.split(",")
    if unknown := sorted(set(kinds) - set(naming.KINDS)):
        raise InputError(f"--errors: some of {', '.join(naming.KINDS)} expected, found {unknown[0]!r}")
    for course in courses:
        load_scenario(course)  # a wrong name is reported before anything starts
    folder = out_folder(out, "bench-naming")
    found = naming.measure(courses, kinds, seeds, jobs, open_progress(as_json).say)
    return _tell_bench(naming.in_words(found), naming.to_json(found), folder / "naming.json", as_json)


@benchmarks.command("slow-core")
@option("--scenario", "course of the walk", "NAME", default="steps")
@option("--share", "share of a core for the actuator", "S", type=number(0.2, 1.0, "share"), default=0.2)
@options.count("--seed", 1000, "random seed", lowest=0)
@options.out
@options.as_json
def bench_slow_core(scenario: str, share: float, seed: int, out: str | None, as_json: bool) -> int:
    """Walk live while the actuator has only a share of a core, as on a slower computer; it needs root."""
    from benchmarks.robot import slow_core
    from sextant.shared.scenario.loading import load_scenario

    load_scenario(scenario)  # a wrong name is reported before anything starts
    folder = out_folder(out, "bench-slow-core")
    folder.mkdir(parents=True, exist_ok=True)
    warm_up(open_progress(as_json))
    try:
        found = slow_core.measure(scenario, seed, share, folder)
    except slow_core.SlowCoreError as error:
        raise CommandError(str(error)) from None
    told = _tell_bench(slow_core.in_words(found), slow_core.to_json(found), folder / "slow-core.json", as_json)
    return told if found.success else FAILED


@benchmarks.command("latency")
@option("--scenario", "course of the walks", "NAME", default="steps")
@options.count("--runs", 5, "live walks, each with a seed of its own")
@options.count("--seed", 1000, "seed of the first walk", lowest=0)
@options.out
@options.as_json
def bench_latency(scenario: str, runs: int, seed: int, out: str | None, as_json: bool) -> int:
    """Measure the time from a depth image to the plan that the legs execute, live."""
    from benchmarks.robot import latency
    from sextant.shared.scenario.loading import load_scenario

    load_scenario(scenario)  # a wrong name is reported before anything starts
    folder, progress = out_folder(out, "bench-latency"), open_progress(as_json)
    warm_up(progress)
    try:
        found = latency.measure(scenario, range(seed, seed + runs), folder.resolve(), progress.say)
    except latency.WalkError as error:
        raise CommandError(str(error)) from None
    return _tell_bench(latency.in_words(found), latency.to_json(scenario, found), folder / "latency.json", as_json)


@benchmarks.command("access")
@options.count("--messages", 10_000, "messages of each kind")
@options.out
@options.as_json
def bench_access(messages: int, out: str | None, as_json: bool) -> int:
    """Publish unauthorised messages through a secured router, and count those that pass."""
    from benchmarks.access import access

    folder = out_folder(out, "bench-access")
    rows = access.measure(messages, open_progress(as_json).say)
    return _tell_bench(access.in_words(rows), access.to_json(rows), folder / "access.json", as_json)


@benchmarks.command("strangers")
@options.count("--cuts", 100, "radio outages between robot and base station")
@options.count("--rate", 1000, "strangers' connections per second", metavar="HZ")
@options.count("--restarts", 10, "actuator restarts, each with and without silent connections", lowest=0)
@options.count("--silent", 500, "silent connections at each router endpoint during these restarts")
@options.count("--seed", 0, "random seed of the outages", lowest=0)
@options.out
@options.as_json
def bench_strangers(cuts: int, rate: int, restarts: int, silent: int, seed: int, out: str | None, as_json: bool) -> int:
    """Measure how fast authorised clients connect while strangers connect too."""
    from benchmarks.access import strangers

    folder, progress = out_folder(out, "bench-strangers"), open_progress(as_json)
    if restarts:
        warm_up(progress)
    try:
        found = strangers.measure(cuts, rate, restarts, silent, seed, progress.say)
    except TimeoutError as error:
        raise CommandError(str(error)) from None
    told = _tell_bench(strangers.in_words(found), strangers.to_json(found), folder / "strangers.json", as_json)
    return FAILED if found.late else told


@benchmarks.command("roles")
@options.count("--messages", 10_000, "messages of each role")
@option("--only", "role to test; repeatable (default: all)", "ROLE", multiple=True)
@flag("--lockstep", "run on simulated time, in this process")
@options.count("--seed", 1, "random seed", lowest=0)
@options.out
@options.as_json
def bench_roles(messages: int, only: tuple[str, ...], lockstep: bool, seed: int, out: str | None, as_json: bool) -> int:
    """Send valid messages with extreme values as each role while a robot walks.

    It succeeds only if the robot withstands all of them.
    """
    from benchmarks.access import role_attack

    folder, progress = out_folder(out, "bench-roles"), open_progress(as_json)
    roles = tuple(dict.fromkeys(only)) or role_attack.ROLE_NAMES
    if unknown := [role for role in roles if role not in role_attack.ROLE_NAMES]:
        raise InputError(f"--only: one of the roles {', '.join(role_attack.ROLE_NAMES)} expected, found {', '.join(unknown)}")
    if lockstep:
        rows = role_attack.measure(roles, messages, seed, progress.say)
    else:
        from benchmarks.access import live_role_attack

        warm_up(progress)
        rows = live_role_attack.measure(roles, messages, seed, progress.say)
    told = _tell_bench(role_attack.in_words(rows), role_attack.to_json(rows), folder / "roles.json", as_json)
    return told if all(row.passed for row in rows) else FAILED


@benchmarks.command("fleet")
@options.count("--robots", 12, "largest number of robots")
@option("--course", "scenario, walked once in lockstep, then replayed by each robot", "SCENARIO", default="steps")
@options.out
@options.as_json
def bench_fleet(robots: int, course: str, out: str | None, as_json: bool) -> int:
    """Add robots to one base station until it is overloaded."""
    from benchmarks.robot import fleet
    from sextant.shared.scenario.loading import load_scenario

    load_scenario(course)  # a wrong name is reported before anything starts
    folder, progress = out_folder(out, "bench-fleet"), open_progress(as_json)
    warm_up(progress)
    found = fleet.measure(course, robots, progress, folder.resolve())
    fleet.draw(folder / "fleet.png", found)
    return _tell_bench(fleet.in_words(found), fleet.to_json(found), folder / "fleet.json", as_json)


@benchmarks.command("link")
@options.count("--walks", 5, "walks over each link")
@option("--scenario", "scenario of the walks", "NAME", default="steps")
@options.count("--cuts", 0, "only inject N radio outages into one walk", lowest=0)
@option(
    "--longest",
    "duration [s] of the longest outage; the shortest takes 0.1 s",
    "S",
    type=number(0.1, 600.0, "seconds"),
    default=30.0,
)
@options.count("--seed", 0, "first seed of the walks, or seed of the outages", lowest=0)
@options.out
@options.as_json
def bench_link(walks: int, scenario: str, cuts: int, longest: float, seed: int, out: str | None, as_json: bool) -> int:
    """Walk with mapper and planner behind a radio with packet loss or outages."""
    from benchmarks.net_testbed.namespace import NetTestbedError
    from benchmarks.robot import link
    from sextant.shared.scenario.loading import load_scenario

    load_scenario(scenario)  # a wrong name is reported before anything starts
    folder, progress = out_folder(out, "bench-link"), open_progress(as_json)
    warm_up(progress)
    try:
        if cuts:
            cut, radio, ended = link.cuts(cuts, seed, longest, progress.say)
            progress.say(f"the radio: {radio}")
            told = _tell_bench(link.cuts_in_words(cut), link.to_json("cuts", cut, radio), folder / "cuts.json", as_json)
            if ended:
                raise CommandError(f"stopped after {len(cut)} of {cuts} outages: {ended}")
            return told
        seeds = range(seed, seed + walks)
        walked, radio = link.walks(scenario, seeds, link.LINKS, progress.say)
        progress.say(f"the radio: {radio}")
    except (NetTestbedError, TimeoutError) as error:
        raise CommandError(str(error)) from None
    return _tell_bench(link.walks_in_words(walked), link.to_json("walks", walked, radio), folder / "walks.json", as_json)


@benchmarks.command("page")
@options.count("--rounds", 30, "repetitions of each measurement")
@options.out
@options.as_json
def bench_page(rounds: int, out: str | None, as_json: bool) -> int:
    """Measure the stop latency of the operator's page in a real browser, and its cost."""
    from benchmarks.page import page

    folder, progress = out_folder(out, "bench-page"), open_progress(as_json)
    warm_up(progress)
    try:
        found = page.measure(rounds, progress.say)
    except ImportError:
        raise InputError("Playwright is missing: pip install 'sextant[bench]'") from None
    except FileNotFoundError as error:
        raise InputError(str(error)) from None
    return _tell_bench(page.in_words(found), page.to_json(found), folder / "page.json", as_json)


@benchmarks.command("recording")
@options.count("--rounds", 5, "repetitions of each measurement")
@options.out
@options.as_json
def bench_recording(rounds: int, out: str | None, as_json: bool) -> int:
    """Measure the servo cycle during recording, with a full disk, and a killed recorder."""
    from benchmarks.robot import recording

    folder, progress = out_folder(out, "bench-recording"), open_progress(as_json)
    warm_up(progress)
    found = recording.measure(rounds, progress.say)
    return _tell_bench(recording.in_words(found), recording.to_json(found), folder / "recording.json", as_json)


@benchmarks.command("soak")
@option("--minutes", "duration of the walk in minutes", "MIN", type=number(0.5, 1440.0, "minutes"), default=60.0)
@options.out
@options.as_json
def bench_soak(minutes: float, out: str | None, as_json: bool) -> int:
    """Walk for a long time, and check that memory and latency do not grow."""
    from benchmarks.robot import soak

    folder, progress = out_folder(out, "bench-soak"), open_progress(as_json)
    warm_up(progress)
    found = soak.measure(60.0 * minutes, progress.say)
    told = _tell_bench(soak.in_words(found), soak.to_json(found), folder / "soak.json", as_json)
    return FAILED if soak.faults(found) else told


@benchmarks.command("size")
@options.out
@options.as_json
def bench_size(out: str | None, as_json: bool) -> int:
    """Measure the disk space of each role."""
    try:
        from benchmarks.robot import size
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is missing: pip install 'sextant[bench]'") from None
    found = size.measure()
    return _tell_bench(size.in_words(found), size.to_json(found), out_folder(out, "bench-size") / "size.json", as_json)


@benchmarks.command("servos")
@options.count("--rounds", 300, "repetitions of each job")
@options.out
@options.as_json
def bench_servos(rounds: int, out: str | None, as_json: bool) -> int:
    """Compare the servo bus driver's time with that of dynamixel-sdk."""
    from benchmarks.peers import servo_packets

    folder = out_folder(out, "bench-servos")
    found = servo_packets.measure(rounds, open_progress(as_json).say)
    return _tell_bench(servo_packets.in_words(found), servo_packets.to_json(found), folder / "servos.json", as_json)


@benchmarks.command("bus")
@options.count("--questions", 20_000, "least number of requests in each case")
@option("--only", "run only cases with these words in their name", "WORDS", default="")
@options.count("--seed", 0, "random seed of the faults", lowest=0)
@options.out
@options.as_json
def bench_bus(questions: int, only: str, seed: int, out: str | None, as_json: bool) -> int:
    """Inject faults into the emulated servo bus; count the replies that the driver accepts."""
    from benchmarks.robot import servo_bus

    if not any(only in case for case in servo_bus.CASES):
        raise InputError(f"--only {only!r}: part of one of these names expected: {'; '.join(servo_bus.CASES)}")
    folder = out_folder(out, "bench-bus")
    found = servo_bus.measure(questions, seed, only, open_progress(as_json).say)
    return _tell_bench(servo_bus.in_words(found), servo_bus.to_json(found), folder / "bus.json", as_json)


@benchmarks.command("checksums")
@options.count("--answers", 20_000, "least number of answers of each servo, spoilt in each way")
@option("--servo", "servo model, or another row of the table; repeatable (default: all rows)", "MODEL", multiple=True)
@options.count("--seed", 0, "random seed", lowest=0)
@options.out
@options.as_json
def bench_checksums(answers: int, servo: tuple[str, ...], seed: int, out: str | None, as_json: bool) -> int:
    """Spoil answers of each servo family; compare the accepted ones with the checksum's odds."""
    from benchmarks.robot import checksum_rigs, checksums

    if wrong := [name for name in servo if name not in checksum_rigs.RIGS]:
        raise InputError(f"--servo {wrong[0]!r}: one of these expected: {'; '.join(checksum_rigs.RIGS)}")
    folder = out_folder(out, "bench-checksums")
    found = checksums.measure(answers, seed, servo, open_progress(as_json).say)
    _tell_bench(checksums.in_words(found), checksums.to_json(found), folder / "checksums.json", as_json)
    return SUCCESS if all(one.passed for one in found) else FAILED


@benchmarks.command("start")
@options.count("--rounds", 20, "number of starts")
@options.out
@options.as_json
def bench_start(rounds: int, out: str | None, as_json: bool) -> int:
    """Measure the actuator's start-up time on a standing robot."""
    from benchmarks.robot import start

    folder = out_folder(out, "bench-start")
    found = start.measure(rounds, open_progress(as_json).say)
    return _tell_bench(start.in_words(found), start.to_json(found), folder / "start.json", as_json)


def _tell_bench(words: str, text: str, path: Path, as_json: bool) -> int:
    say(text.rstrip() if as_json else words)
    whole_files.write_text(path, text, durable=True)
    if not as_json:
        say(f"written to {path}")
    return SUCCESS
