"""`python -m benchmarks`: accuracy, speed and robustness benchmarks."""

import argparse
from pathlib import Path

from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, complain, open_progress, out_folder, say, warm_up
from sextant.shared.files import whole_files


def bench_accuracy(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks accuracy`: measure pose and map errors on rebuilt scenes."""
    from benchmarks.peers import accuracy

    out = out_folder(arguments, "bench-accuracy")
    rows = accuracy.tables(arguments.seeds, arguments.jobs, open_progress(arguments.json).say)
    return _tell_bench(accuracy.in_words(rows), accuracy.to_json(rows), out / "accuracy.json", arguments.json)


def bench_speed(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks speed`: time registration against other implementations."""
    from benchmarks.peers import chart, speed, timing

    out = out_folder(arguments, "bench-speed")
    timings, missing = speed.registration(arguments.seeds, arguments.frames, open_progress(arguments.json).say)
    chart.draw(out / "speed.png", "Registration and other implementations", timings, missing)
    words, text = timing.in_words(timings, missing, speed.HEADINGS), timing.to_json(timings, missing)
    return _tell_bench(words, text, out / "speed.json", arguments.json)


def bench_stages(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks stages`: time the mapping stages against other implementations."""
    from benchmarks.peers import chart, stages, timing

    out = out_folder(arguments, "bench-stages")
    found = stages.stages(arguments.seeds, arguments.frames, open_progress(arguments.json).say)
    chart.draw(out / "stages.png", "Mapping stages and other implementations", found.timings, found.missing, found.parts_ms)
    words = f"{timing.in_words(found.timings, found.missing, stages.HEADINGS)}\n{timing.parts_in_words(found.parts_ms)}"
    text = timing.to_json(found.timings, found.missing, parts_ms=found.parts_ms)
    return _tell_bench(words, text, out / "stages.json", arguments.json)


def bench_passage(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks passage`: time the gap planner against others, check its plans."""
    from benchmarks.peers import chart, passage, timing

    out = out_folder(arguments, "bench-passage")
    found = passage.measure(arguments.seeds, say=open_progress(arguments.json).say)
    chart.draw(out / "passage.png", "Passage planner and other implementations", found.timings, found.missing)
    words = f"{timing.in_words(found.timings, found.missing, passage.HEADINGS)}\n{passage.in_words(found)}"
    sections = passage.sections_for_scripts(found)
    text = timing.to_json(found.timings, found.missing, sections=sections, wrong=found.wrong)
    return _tell_bench(words, text, out / "passage.json", arguments.json)


def bench_access(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks access`: count unauthorised messages that pass a guarded router."""
    from benchmarks.access import access

    out = out_folder(arguments, "bench-access")
    rows = access.measure(arguments.messages, open_progress(arguments.json).say)
    return _tell_bench(access.in_words(rows), access.to_json(rows), out / "access.json", arguments.json)


def bench_strangers(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks strangers`: time authorised clients while strangers connect.

    It fails if one is late.
    """
    from benchmarks.access import strangers

    out, progress = out_folder(arguments, "bench-strangers"), open_progress(arguments.json)
    if arguments.restarts:
        warm_up(progress)
    try:
        found = strangers.measure(
            arguments.cuts, arguments.rate, arguments.restarts, arguments.silent, arguments.seed, progress.say
        )
    except TimeoutError as error:
        complain(f"python -m benchmarks strangers: {error}")
        return FAILED
    told = _tell_bench(strangers.in_words(found), strangers.to_json(found), out / "strangers.json", arguments.json)
    return FAILED if found.late else told


def bench_roles(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks roles`: send extreme messages as each role during a walk.

    It succeeds only if the robot withstands all of them.
    """
    from benchmarks.access import role_attack

    out, progress = out_folder(arguments, "bench-roles"), open_progress(arguments.json)
    roles = tuple(dict.fromkeys(arguments.only)) or role_attack.ROLE_NAMES
    if unknown := [role for role in roles if role not in role_attack.ROLE_NAMES]:
        raise InputError(f"--only: one of the roles {', '.join(role_attack.ROLE_NAMES)} expected, found {', '.join(unknown)}")
    if arguments.lockstep:
        rows = role_attack.measure(roles, arguments.messages, arguments.seed, progress.say)
    else:
        from benchmarks.access import live_role_attack

        warm_up(progress)
        rows = live_role_attack.measure(roles, arguments.messages, arguments.seed, progress.say)
    told = _tell_bench(role_attack.in_words(rows), role_attack.to_json(rows), out / "roles.json", arguments.json)
    return told if all(row.passed for row in rows) else FAILED


def bench_fleet(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks fleet`: measure how many robots one base station supports."""
    from benchmarks.robot import fleet

    out, progress = out_folder(arguments, "bench-fleet"), open_progress(arguments.json)
    warm_up(progress)
    found = fleet.measure(arguments.course, arguments.robots, progress, out.resolve())
    fleet.draw(out / "fleet.png", found)
    return _tell_bench(fleet.in_words(found), fleet.to_json(found), out / "fleet.json", arguments.json)


def bench_link(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks link`: walk live with map and planner behind a radio."""
    from benchmarks.net_testbed.namespace import NetTestbedError
    from benchmarks.robot import link

    out, progress = out_folder(arguments, "bench-link"), open_progress(arguments.json)
    warm_up(progress)
    try:
        if arguments.cuts:
            cut, radio, ended = link.cuts(arguments.cuts, arguments.seed, arguments.longest, progress.say)
            progress.say(f"the radio: {radio}")
            told = _tell_bench(link.cuts_in_words(cut), link.to_json("cuts", cut, radio), out / "cuts.json", arguments.json)
            if ended:
                complain(f"python -m benchmarks link: stopped after {len(cut)} of {arguments.cuts} outages: {ended}")
            return FAILED if ended else told
        seeds = range(arguments.seed, arguments.seed + arguments.walks)
        walked, radio = link.walks(arguments.scenario, seeds, link.LINKS, progress.say)
        progress.say(f"the radio: {radio}")
    except (NetTestbedError, TimeoutError) as error:
        complain(f"python -m benchmarks link: {error}")
        return FAILED
    return _tell_bench(link.walks_in_words(walked), link.to_json("walks", walked, radio), out / "walks.json", arguments.json)


def bench_page(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks page`: measure cost and stop latency of the operator page."""
    from benchmarks.page import page

    out, progress = out_folder(arguments, "bench-page"), open_progress(arguments.json)
    warm_up(progress)
    try:
        found = page.measure(arguments.rounds, progress.say)
    except ImportError:
        raise InputError("Playwright is missing: pip install 'sextant[bench]'") from None
    except FileNotFoundError as error:
        raise InputError(str(error)) from None
    return _tell_bench(page.in_words(found), page.to_json(found), out / "page.json", arguments.json)


def bench_recording(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks recording`: measure the effect of recording on a walk.

    It also measures what happens to the recording when its disk or process fails.
    """
    from benchmarks.robot import recording

    out, progress = out_folder(arguments, "bench-recording"), open_progress(arguments.json)
    warm_up(progress)
    found = recording.measure(arguments.rounds, progress.say)
    return _tell_bench(recording.in_words(found), recording.to_json(found), out / "recording.json", arguments.json)


def bench_soak(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks soak`: walk for long; fail if memory or latency grow."""
    from benchmarks.robot import soak

    out, progress = out_folder(arguments, "bench-soak"), open_progress(arguments.json)
    warm_up(progress)
    found = soak.measure(60.0 * arguments.minutes, progress.say)
    told = _tell_bench(soak.in_words(found), soak.to_json(found), out / "soak.json", arguments.json)
    return FAILED if soak.faults(found) else told


def bench_size(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks size`: measure the disk space of each role."""
    try:
        from benchmarks.robot import size
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is missing: pip install 'sextant[bench]'") from None
    found = size.measure()
    return _tell_bench(
        size.in_words(found), size.to_json(found), out_folder(arguments, "bench-size") / "size.json", arguments.json
    )


def bench_servos(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks servos`: time the servo bus with our packets and dynamixel-sdk."""
    from benchmarks.peers import servo_packets

    out = out_folder(arguments, "bench-servos")
    rows, missing = servo_packets.measure(arguments.rounds, open_progress(arguments.json).say)
    words, text = servo_packets.in_words(rows, missing), servo_packets.to_json(rows, missing)
    return _tell_bench(words, text, out / "servos.json", arguments.json)


def bench_bus(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks bus`: measure how the servo bus driver handles a bad bus."""
    from benchmarks.robot import servo_bus

    if not any(arguments.only in case for case in servo_bus.CASES):
        raise InputError(f"--only {arguments.only!r}: part of one of these names expected: {'; '.join(servo_bus.CASES)}")
    out = out_folder(arguments, "bench-bus")
    found = servo_bus.measure(arguments.questions, arguments.seed, arguments.only, open_progress(arguments.json).say)
    return _tell_bench(servo_bus.in_words(found), servo_bus.to_json(found), out / "bus.json", arguments.json)


def bench_start(arguments: argparse.Namespace) -> int:
    """`python -m benchmarks start`: measure the actuator's start-up time on a standing robot."""
    from benchmarks.robot import start

    out = out_folder(arguments, "bench-start")
    found = start.measure(arguments.rounds, open_progress(arguments.json).say)
    return _tell_bench(start.in_words(found), start.to_json(found), out / "start.json", arguments.json)


def _tell_bench(words: str, text: str, path: Path, as_json: bool) -> int:
    say(text.rstrip() if as_json else words)
    whole_files.write_text(path, text, durable=True)
    if not as_json:
        say(f"written to {path}")
    return SUCCESS
