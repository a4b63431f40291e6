"""Compile every inner loop of a simulated robot once, before a run begins.

python -m sextant.deploy.launch.warm_up
"""

import argparse
import hashlib
import itertools
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sextant.deploy.terminal.output import say
from sextant.shared.files import whole_files
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.operating_system import usable_cores
from sextant.shared.runtime.shutdown import end_with
from sextant.shared.runtime.workers import share_out
from sextant.shared.scenario.scenario import load_scenario

_SCENARIOS = ("steps", "cobbles", "puddle")  # with blocks, with a height field, and in colour
_SHARES = (("planner",), ("perception", "mapper", "simulator"))  # both take about equally long when nothing is compiled
_REPORT_EVERY_S = 0.5
_PACKAGE = Path(__file__).parents[2]
MARK = Path(__file__).parent / "__pycache__" / "warm_up.txt"  # fingerprint of what the last warm-up has compiled
COMPILED = "compiled"  # first word of a line of progress; then process, compiled functions, all functions


def main() -> int:
    """Compile for all scenarios; on two cores if much is to be compiled."""
    parser = argparse.ArgumentParser(prog="python -m sextant.deploy.launch.warm_up", description=__doc__)
    parser.add_argument("--parent", type=int, help="id of the parent process; this process ends with it")
    parser.add_argument("--progress", action="store_true", help="print how many functions are compiled")
    arguments = parser.parse_args()
    if arguments.parent:
        end_with(arguments.parent)
    jobs = 1 if has_compiled() else min(len(_SHARES), usable_cores())
    for _ in share_out(_compile_share, [(share, arguments.progress) for share in _SHARES], jobs, in_order=False):
        pass
    with suppress(OSError):  # without the mark the next warm-up looks at every function again
        whole_files.make_folder(MARK.parent)
        whole_files.write_text(MARK, _fingerprint())
    return 0


def is_complete() -> bool:
    """Return whether nothing has changed since the last warm-up: source, compiled code, versions and processor."""
    if "NUMBA_CACHE_DIR" in os.environ:  # the compiled code is not next to its source
        return False
    with suppress(OSError):
        return MARK.read_text(encoding="ascii") == _fingerprint()
    return False


def _fingerprint() -> str:
    """Return a digest of all that decides whether Numba finds its compiled code."""
    from llvmlite import binding

    digest = hashlib.blake2s(repr((sys.version, version("numba"), binding.get_host_cpu_name())).encode())
    for folder, folders, files in os.walk(_PACKAGE, followlinks=True):
        folders.sort()
        for name in sorted(files):
            if name.endswith((".py", ".nbi")):
                found = Path(folder, name).stat()
                digest.update(repr((folder, name, found.st_size, found.st_mtime_ns)).encode())
    return digest.hexdigest()


def has_compiled() -> bool:
    """Return whether Numba has cached the planner's search, which compiles longest.

    If it has, little is usually left to compile.
    """
    from sextant.services.planner.roadmap import roadmap_search

    search: Any = roadmap_search.grow
    return any(Path(search.stats.cache_path).glob(f"{roadmap_search.__name__.rpartition('.')[2]}.grow-*.nbi"))


def compile_functions(profile: RobotProfile, scenario: str) -> None:
    """Compile all services for a robot on a course."""
    for service in itertools.chain(*_SHARES):
        _compile(service, profile, scenario)


def _compile(service: str, profile: RobotProfile, scenario: str) -> None:
    """Compile the functions of a service, which is imported here, so that other processes need not."""
    settings = import_module(f"sextant.services.{service}.config").Settings
    warmup = import_module(f"sextant.services.{service}.warmup")
    warmup.compile_functions(profile, settings(scenario) if service == "simulator" else settings())


def _compile_share(share: tuple[str, ...], progress: bool) -> None:
    """Compile some services for all scenarios."""
    for service in share:
        import_module(f"sextant.services.{service}.warmup")  # now all functions are known
    with _reported() if progress else nullcontext():
        for scenario in _SCENARIOS:
            for service in share:
                _compile(service, load_profile(load_scenario(scenario).robot), scenario)


@contextmanager
def _reported() -> Iterator[None]:
    """Print the number of compiled functions while the block runs, whenever it changes."""
    ended = threading.Event()

    def report() -> None:
        told = ""
        while not ended.wait(_REPORT_EVERY_S):
            known = _compiled_functions()
            line = f"{COMPILED} {os.getpid()} {len(_ready(known))} {len(known)}"
            if line != told:
                told = line
                say(line)

    reporter = threading.Thread(target=report, name="report", daemon=True)
    reporter.start()
    try:
        yield
    finally:
        ended.set()
        reporter.join()


def _ready(functions: list[Any]) -> list[Any]:
    """Return the functions that are compiled, also those that a loaded function of their file contains."""
    loaded = {one.py_func.__module__ for one in functions if one.stats.cache_hits}
    return [one for one in functions if one.overloads or one.py_func.__module__ in loaded]


def _compiled_functions() -> list[Any]:
    """Return the functions that Numba compiles, except those that it inlines."""
    from numba.core.dispatcher import Dispatcher

    modules = [vars(module) for name, module in list(sys.modules.items()) if name.startswith("sextant.")]
    found = {id(one): one for names in modules for one in list(names.values()) if isinstance(one, Dispatcher)}
    return [one for one in found.values() if one.targetoptions.get("inline") != "always"]


if __name__ == "__main__":
    sys.exit(main())
