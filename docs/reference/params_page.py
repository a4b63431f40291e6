"""Generator of docs/parameters.md, a page with every parameter of the services.

It reads the declarations of the parameters. The meaning of a parameter is its comment in the source.
"""

import inspect
from collections.abc import Iterator
from dataclasses import fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

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
"""


def page() -> str:
    """Return the page in Markdown."""
    return "\n".join([_BEGINNING, *_group(SystemParams(), "")])


def _group(group: Params, name: str) -> Iterator[str]:
    """Yield the lines of a group of parameters: its own, then its groups."""
    own = [field for field in fields(group) if not isinstance(getattr(group, field.name), Params)]  # type: ignore[arg-type]
    if name:
        yield f"{'#' * (2 + name.count('.'))} {name}"
        yield ""
        yield " ".join((inspect.getdoc(type(group)) or "").split())
        yield ""
    if own:
        yield "| parameter | default | range | unit | meaning |"
        yield "|---|---|---|---|---|"
        said, hints = comments_of(type(group)), get_type_hints(type(group))
        for field in own:
            default = toml_value(config.as_table(getattr(group, field.name)))
            unit, _, what = parse(said.get(field.name, ""))
            what = what.replace("|", "\\|")
            yield f"| `{field.name}` | {default} | {_range(hints[field.name], config.range_of(field))} | {unit} | {what} |"
        yield ""
    for field in fields(group):  # type: ignore[arg-type]
        value = getattr(group, field.name)
        if isinstance(value, Params):
            yield from _group(value, f"{name}.{field.name}" if name else field.name)


def _range(hint: Any, limits: tuple[float, float] | None) -> str:
    if limits is not None:
        return f"{limits[0]:g} to {limits[1]:g}"
    if get_origin(hint) is Literal:
        return ", ".join(f"`{one}`" for one in get_args(hint))
    return "true, false" if hint is bool else ""
