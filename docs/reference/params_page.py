"""Generator of docs/parameters.md, which lists the groups of parameters, and of a page with the parameters of each service.

It reads the declarations of the parameters. The meaning of a parameter is its comment in the source.
"""

import inspect
import re
from collections.abc import Iterator
from dataclasses import fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

from docs.reference.parts import Part, split
from sextant.evaluation.params import SystemParams
from sextant.shared.field_comments import comments_of, parse
from sextant.shared.files import config
from sextant.shared.params import Params
from sextant.shared.runtime.process import toml_value

_BEGINNING = """# Parameters

*`python -m docs.reference parameters` makes this page from the declarations of the parameters (`params.py` in the folder of
each algorithm); a test checks that it is up to date.*

A parameter is stated on the command line, in a scenario, or in code; nothing else changes it, neither a scenario's name nor a
seed. Each way checks type and range before anything starts.

```sh
sextant run wall --lockstep --set planner.costmap.max_step_m=0.05     # also trials, demo and up; --set is repeatable
```

```toml
[params.planner.costmap]   # in a scenario; --set has precedence
max_step_m = 0.05
```

`report.json` has all values of its run (`params`), a recording those that differ from their defaults, which a replay uses too.
Trials with different parameters are different batches. `sextant up` and a service's process take the same names, such as
`--set planner.costmap.max_step_m=0.05`, next to the settings of a process, such as `--set actuator.port=/dev/ttyUSB1`.

To measure the effect, run the same seeds with and without it. The tables of trials name the parameters that were changed:

```sh
sextant trials cobbles --seeds 1000:1010 --jobs 2                                       # the success rate as it is
sextant trials cobbles --seeds 1000:1010 --jobs 2 --set planner.step.path_margin_m=0.03 # with feet 3 cm over the ground
```

Values that do not fit each other or the robot are refused when the services start, with the reason.

In code each algorithm takes its dataclass: `LocalGroundMap(CostmapParams(max_step_m=0.05))`.

## Groups

A link leads to the parameters of the group, with default, range, unit and meaning.
"""
_ABOUT = "[Parameters](parameters.md) tells how to set them."
_SENTENCE_END = re.compile(r"\.(?: (?=[A-Z])|$)")


def pages() -> dict[str, str]:
    """Return the pages in Markdown by their names."""
    services = [field.name for field in fields(SystemParams)]
    groups = {name: group for service in services for name, group in _groups(service, getattr(SystemParams(), service))}
    text = "\n".join((_BEGINNING, *(line for name, group in groups.items() for line in _section(name, group))))
    parts = {f"parameters_{service}": Part(f"Parameters: {service}", _ABOUT, (service,)) for service in services}
    return split("parameters", text, parts, {name: _SENTENCE_END.split(_about(group))[0] for name, group in groups.items()})


def _groups(name: str, group: Params) -> Iterator[tuple[str, Params]]:
    """Yield a group of parameters and those in it, to any depth, each with its dotted name."""
    yield name, group
    for field in fields(group):  # type: ignore[arg-type]
        value = getattr(group, field.name)
        if isinstance(value, Params):
            yield from _groups(f"{name}.{field.name}", value)


def _about(group: Params) -> str:
    return " ".join((inspect.getdoc(type(group)) or "").split())


def _section(name: str, group: Params) -> Iterator[str]:
    """Yield the lines about a group of parameters: heading, docstring, and a table of those that are in no subgroup."""
    yield from (f"{'#' * (2 + name.count('.'))} {name}", "", _about(group), "")
    own = [field for field in fields(group) if not isinstance(getattr(group, field.name), Params)]  # type: ignore[arg-type]
    if not own:
        return
    yield from ("| parameter | default | range | unit | meaning |", "|---|---|---|---|---|")
    said, hints = comments_of(type(group)), get_type_hints(type(group))
    for field in own:
        default = toml_value(config.as_table(getattr(group, field.name)))
        unit, _, what = parse(said.get(field.name, ""))
        what = what.replace("|", "\\|")
        yield f"| `{field.name}` | {default} | {_range(hints[field.name], config.range_of(field))} | {unit} | {what} |"
    yield ""


def _range(hint: Any, limits: tuple[float, float] | None) -> str:
    if limits is not None:
        return f"{limits[0]:g} to {limits[1]:g}"
    if get_origin(hint) is Literal:
        return ", ".join(f"`{one}`" for one in get_args(hint))
    return "true, false" if hint is bool else ""
