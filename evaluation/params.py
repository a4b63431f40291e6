"""Parameters of all services in one tree, as scenarios and `--set` name them."""

from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any, TypeVar, cast

from sextant.services.actuator.config import ActuatorParams
from sextant.services.mapper.config import MapperParams
from sextant.services.perception.config import PerceptionParams
from sextant.services.planner.config import PlannerParams
from sextant.shared.files import config
from sextant.shared.params import Params
from sextant.shared.runtime.process import toml_value
from sextant.shared.scenario.scenario import Scenario

Table = dict[str, Any]
S = TypeVar("S")


def _misfits_of_handover(actuator: ActuatorParams, planner: PlannerParams) -> list[config.Misfit]:
    """Return the error of a planner that gives the feet less time to stand than the actuator takes."""
    standing_s, handover_s = actuator.unload_s + actuator.load_s, planner.step.handover_s
    if handover_s > standing_s - 1e-9:
        return []
    expected = f"at least actuator.unload_s + actuator.load_s, {standing_s:g} s,"
    return [config.Misfit("planner.step.handover_s", expected, f"{handover_s:g} s")]


@dataclass(frozen=True, slots=True)
class SystemParams(Params):
    """Parameters of all services."""

    actuator: ActuatorParams = field(default_factory=ActuatorParams)
    mapper: MapperParams = field(default_factory=MapperParams)
    perception: PerceptionParams = field(default_factory=PerceptionParams)
    planner: PlannerParams = field(default_factory=PlannerParams)

    checks = (config.Check(("actuator", "planner"), _misfits_of_handover),)


DEFAULTS = SystemParams()


def read(table: object, source: str) -> SystemParams:
    """Return the parameters of a table; parameters that it omits have their defaults.

    Args:
        table: Nested table, as a scenario's `[params]`.
        source: Name of the table in errors.

    Raises:
        ConfigError: A parameter is unknown, of another type, or out of range; the text lists all errors.
    """
    return config.build(cast(Table, table), SystemParams, source)


def assigned(scenario: Scenario, assignments: Iterable[str]) -> Scenario:
    """Return a scenario with assignments such as `planner.costmap.max_step_m=0.07` applied to its parameters.

    Its table then has only the parameters that differ from their defaults.

    Raises:
        ConfigError: A parameter of the scenario or an assignment is invalid.
    """
    of_scenario(scenario)  # its own errors are not those of the assignments
    return replace(scenario, params=assigned_table(assignments, scenario.params))


def assigned_table(assignments: Iterable[str], params: Mapping[str, Any] = MappingProxyType({})) -> Table:
    """Return the parameters that differ from their defaults after assignments to a table, as a nested table.

    Raises:
        ConfigError: An assignment is invalid.
    """
    table = deepcopy(dict(params))
    config.assign(table, assignments)
    return changes(read(table, "--set"))


def of_scenario(scenario: Scenario) -> SystemParams:
    """Return the parameters of a scenario.

    Raises:
        ConfigError: They are invalid.
    """
    return read(scenario.params, f"[params] of {scenario.name}")


def changes(params: Params, defaults: Params | None = None) -> Table:
    """Return the parameters that differ from their defaults, as a nested table."""
    defaults = defaults or type(params)()
    found: Table = {}
    for name in names(params):
        value, default = getattr(params, name), getattr(defaults, name)
        if isinstance(value, Params):
            if inner := changes(value, default):
                found[name] = inner
        elif value != default:
            found[name] = config.as_table(value)
    return found


def names(params: Params) -> list[str]:
    """Return the names of the parameters, or of groups of them."""
    return [one.name for one in fields(params)]  # type: ignore[arg-type]


def flat(table: Mapping[str, Any], prefix: str = "") -> Table:
    """Return dotted key -> value of a nested table."""
    found: Table = {}
    for key, value in table.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


def changes_in_words(scenario: Scenario) -> str:
    """Return the plug-ins and the changed parameters of a scenario as text, or ""."""
    return ", ".join(filter(None, (scenario.plugins.words(), words(scenario.params))))


def words(table: Mapping[str, Any]) -> str:
    """Return the parameters of a table as text, as `--set` takes them."""
    return ", ".join(f"{key}={toml_value(value)}" for key, value in flat(table).items())


def settings(schema: type[S], params: Params, **chosen: Any) -> S:
    """Return the settings of a service: its parameters, and what the run chooses.

    Args:
        schema: Settings of the service; they extend the class of `params`.
        params: Parameters of the service.
        chosen: Further settings.
    """
    return schema(**{name: getattr(params, name) for name in names(params)}, **chosen)
