"""Finding and calling plug-ins."""

import importlib
import importlib.metadata
import importlib.util
import re
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

from sextant.shared.errors import SextantError
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.spelling import hint

Kind = Literal["planner", "foothold", "registration"]
KINDS: tuple[Kind, ...] = ("planner", "foothold", "registration")
R = TypeVar("R")

_METHODS: dict[Kind, str] = {"planner": "plan", "foothold": "__call__", "registration": "register"}

_OBJECT = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


class PluginError(SextantError):
    """A plug-in cannot be loaded, or has failed."""


@dataclass(frozen=True, slots=True)
class Plugins:
    """Names of the plug-ins of a run; empty for Sextant's own algorithm.

    A name is `package.module:Object`, or that of an entry point in the group `sextant.planner`, `sextant.foothold` or
    `sextant.registration`. The module is installed, in a folder of PYTHONPATH, or in the working directory, which comes last.
    """

    planner: str = ""
    foothold: str = ""
    registration: str = ""

    def chosen(self) -> dict[str, str]:
        """Return kind -> name of the plug-ins."""
        return {kind: name for kind in KINDS if (name := str(getattr(self, kind)))}

    def words(self) -> str:
        """Return the plug-ins as text, or ""."""
        return ", ".join(f"{kind} {name}" for kind, name in self.chosen().items())

    def sources(self) -> list[Path]:
        """Return the Python files of the packages of the plug-ins, in order.

        Raises:
            PluginError: A plug-in cannot be found.
        """
        found: set[Path] = set()
        for kind in KINDS:
            name = str(getattr(self, kind))
            if not name:
                continue
            module = _target(kind, name).partition(":")[0]
            spec = importlib.util.find_spec(module.partition(".")[0])
            if spec is None:
                raise PluginError(f"plug-in {name}: there is no module {module}")
            for folder in spec.submodule_search_locations or ():
                found.update(Path(folder).rglob("*.py"))
            found.update([Path(spec.origin)] if spec.origin and spec.origin.endswith(".py") else [])
        return sorted(found)


def load(kind: Kind, name: str) -> Callable[..., Any]:
    """Return the object of a plug-in, imported.

    Raises:
        PluginError: There is none of that name, its module cannot be imported, or it cannot be called.
    """
    module, _, path = _target(kind, name).partition(":")
    try:
        found: Any = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise PluginError(f"plug-in {name}: {module} needs {error.name}, which is not installed") from error
        where = f"expected in this environment, in a folder of PYTHONPATH, or in the working directory {Path.cwd()}"
        raise PluginError(f"plug-in {name}: there is no module {error.name}; {where}") from error
    except Exception as error:  # its import may raise anything
        raise PluginError(f"plug-in {name}: {module} cannot be imported: {described(error, module)}") from error
    for part in path.split("."):
        if not hasattr(found, part):
            near = hint(part, [one for one in dir(found) if not one.startswith("_")])
            raise PluginError(f"plug-in {name}: {module} has no {part}; {near}")
        found = getattr(found, part)
    if not callable(found):
        raise PluginError(f"plug-in {name}: a class or a function expected, found {type(found).__name__}")
    return found  # type: ignore[no-any-return]


def _target(kind: Kind, name: str) -> str:
    """Return `module:object` of a plug-in's name, and let its module be found in the working directory.

    Raises:
        PluginError: It is neither the name of an entry point nor of that form.
    """
    known = {entry.name: entry.value for entry in importlib.metadata.entry_points(group=f"sextant.{kind}")}
    if name in known:
        return known[name]
    if _OBJECT.fullmatch(name):
        here = str(Path.cwd())
        sys.path += [] if here in sys.path else [here]  # last, so that no file there replaces an installed module
        return name
    installed = hint(name, sorted(known)) if known else "no installed package has one"
    raise PluginError(f"--{kind}: package.module:Object or the name of an entry point expected, found {name!r}; {installed}")


class Plugin:
    """A plug-in in use. Its errors name it, its package and the line."""

    def __init__(self, name: str, target: Any):
        """Wrap an object of a plug-in."""
        self._name, self._target = name, target

    @classmethod
    def make(cls, kind: Kind, name: str, profile: RobotProfile) -> Self:
        """Load a plug-in for a robot.

        A class is called with the profile, and so is a function that makes a planner or a registration.

        Raises:
            PluginError: It cannot be loaded or made.
        """
        found = load(kind, name)
        if kind == "foothold" and not isinstance(found, type):
            return cls(name, found)
        made = cls(name, found).call(lambda make: make(profile), "when it was called with the robot's profile")
        method = _METHODS[kind]
        if not callable(getattr(made, method, None)):
            raise PluginError(f"plug-in {name}: a {kind} with a method {method} expected, found {type(made).__name__}")
        return cls(name, made)

    def call(self, use: Callable[[Any], R], when: str = "") -> R:
        """Return the result of using the object.

        Args:
            use: Uses it.
            when: When that is, as text for its errors.

        Raises:
            PluginError: It failed.
        """
        try:
            return use(self._target)
        except Exception as error:  # its code may raise anything
            module = getattr(self._target, "__module__", None) or type(self._target).__module__
            failed = f"failed {when}" if when else "failed"
            raise PluginError(f"plug-in {self._name} {failed}: {described(error, module)}") from error


def described(error: Exception, module: str) -> str:
    """Return type, text and line of an exception; the line is the innermost one in the package of `module`."""
    package = module.partition(".")[0]
    own = [
        (Path(frame.f_code.co_filename).name, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
        if str(frame.f_globals.get("__name__", "")).partition(".")[0] == package
    ]
    return f"{type(error).__name__}: {error}" + (f" ({own[-1][0]}:{own[-1][1]})" if own else "")
