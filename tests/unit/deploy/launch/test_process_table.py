import dataclasses
import importlib.util
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.deploy.launch import process_table
from sextant.deploy.launch.process_table import Choices, assignment, choices, commands, rows
from sextant.shared.runtime import process
from sextant.shared.scenario.scenario import Goal, MapOptions, Scenario, Variation, Walk
from sextant.shared.scenario.terrain import Plane
from sextant.shared.wire.transport import Endpoints

ENDPOINTS = Endpoints(("tcp/127.0.0.1:7447",), namespace="test")


@dataclasses.dataclass(frozen=True)
class Text:
    key: str


@pytest.mark.parametrize("row", process_table.TABLE, ids=lambda row: row.name)
def test_each_process_module_exists(row: process_table.Process) -> None:
    assert importlib.util.find_spec(row.module) is not None
    assert importlib.util.find_spec(f"{row.module}.__main__") is not None


@pytest.mark.parametrize("row", process_table.TABLE, ids=lambda row: row.name)
def test_each_setting_exists_in_service_schema(row: process_table.Process) -> None:
    schema = importlib.import_module(f"{row.module}.config").Settings
    settings = row.settings(Choices(scenario="steps", camera="realsense"))
    made = process.load_settings(schema, None, [assignment(k, v) for k, v in settings.items()])
    assert {key: getattr(made, key) for key in settings} == settings


def test_scenario_map_options_reach_mapper_and_perception() -> None:
    chosen = choices(Scenario("fine", (Plane(),), Goal(1.0), map=MapOptions(100, 300, 0.02)), "fine", 0)
    made = {}
    for row in process_table.TABLE:
        schema = importlib.import_module(f"{row.module}.config").Settings
        made[row.name] = process.load_settings(schema, None, [assignment(k, v) for k, v in row.settings(chosen).items()])
    assert (made["mapper"].shape, made["mapper"].resolution) == ((100, 300), 0.02)
    assert made["perception"].scan_resolution == 0.02


def test_roles_partition_services() -> None:
    names = {role: [p.name for p in rows(role, simulated=False)] for role in ("all", "onboard", "offboard", "sim")}  # type: ignore[arg-type]
    assert names["onboard"] == ["actuator", "stop", "camera", "imu", "perception"], "the camera's bandwidth stays on the robot"
    assert sorted(names["onboard"] + names["offboard"]) == sorted(names["all"])
    assert names["sim"] == ["simulator"]
    assert "simulator" not in names["all"]
    assert rows("all", simulated=True)[0].name == "simulator"


def test_console_runs_only_on_operator_roles_if_page_is_wanted() -> None:
    for role, there in (("all", True), ("offboard", True), ("onboard", False), ("sim", False)):
        for simulated in (True, False):
            assert ("console" in {p.name for p in rows(role, simulated, page=True)}) is there  # type: ignore[arg-type]
            assert "console" not in {p.name for p in rows(role, simulated)}  # type: ignore[arg-type]


def test_camera_process_runs_only_on_real_robot() -> None:
    for role, simulated, there in (
        ("all", False, True),
        ("onboard", True, False),
        ("all", True, False),
        ("offboard", False, False),
    ):
        assert ("camera" in {p.name for p in rows(role, simulated)}) is there  # type: ignore[arg-type]
    made = {c.name: c for c in commands(rows("onboard", False), Choices(camera="/a/walk"), ENDPOINTS)}
    assert made["camera"].arguments[-2:] == ("--set", "device=/a/walk")


def test_names_are_unique_and_dependencies_are_in_table() -> None:
    names = [p.name for p in process_table.TABLE]
    assert len(set(names)) == len(names)
    assert all(set(p.after) <= set(names) for p in process_table.TABLE)


def test_watchdog_limits_are_shortest_for_actuator_and_stop() -> None:
    patience = {c.name: c.watchdog_s for c in commands(process_table.TABLE, Choices(), ENDPOINTS)}
    assert all(0.0 < limit < float("inf") for limit in patience.values())
    assert max(patience["actuator"], patience["stop"]) <= 1.5, "detected, killed, started, and holding within 3.5 s"
    assert min(limit for name, limit in patience.items() if name not in ("actuator", "stop")) >= 10.0


def test_scenario_options_reach_processes() -> None:
    scenario = Scenario(
        "wild",
        (Plane(),),
        Goal(1.0),
        walk=Walk(blind=True, footholds="evaluation", arc="sixth_order"),
        variation=Variation(registration="kiss-icp"),
    )
    made = {
        c.name: " ".join(c.arguments)
        for c in commands(rows("all", True), choices(scenario, "/a/wild.toml", 7, 7450), ENDPOINTS)
    }
    assert "--set scenario=/a/wild.toml --set seed=7 --set bus_port=7450" in made["simulator"]
    assert "--set port=socket://127.0.0.1:7450 --set arc=sixth_order" in made["actuator"]
    assert "--set method=kiss-icp" in made["perception"]
    assert "--set blind=true --set footholds=evaluation" in made["planner"]
    assert all("--connect tcp/127.0.0.1:7447 --namespace test" in line for line in made.values())


def test_actuator_waits_only_for_simulated_bus() -> None:
    simulated = {c.name: c for c in commands(rows("all", True), Choices(scenario="flat", bus_port=7450), ENDPOINTS)}
    assert simulated["actuator"].after == ("simulator",)
    assert simulated["simulator"].ready_port == 7450
    real = {c.name: c for c in commands(rows("all", False), Choices(), ENDPOINTS)}
    assert real["actuator"].after == ()
    assert "--set" not in real["actuator"].arguments


def test_only_the_actuator_of_a_robot_has_real_time_priority() -> None:
    simulated = commands(rows("all", True), Choices(scenario="flat"), ENDPOINTS)
    real = commands(rows("all", False), Choices(), ENDPOINTS)
    assert [c.name for c in simulated if "--urgent" in c.arguments] == []
    assert [c.name for c in real if "--urgent" in c.arguments] == ["actuator"]


def test_extra_settings_override_defaults() -> None:
    made = commands(rows("onboard", False), Choices(), ENDPOINTS, {"actuator": ("port=/dev/ttyACM3",)})
    actuator = next(c for c in made if c.name == "actuator")
    assert actuator.arguments[-2:] == ("--set", "port=/dev/ttyACM3")


def test_process_environment_limits_libraries_to_one_thread() -> None:
    for command in commands(rows("all", True), Choices(scenario="flat"), ENDPOINTS):
        assert {command.environment[k] for k in command.environment if k.endswith("_NUM_THREADS")} == {"1"}
        assert command.environment["PYTHONUNBUFFERED"] == "1"


@given(st.text(st.characters(exclude_categories=["Cs"]), max_size=30))
def test_text_setting_round_trips_through_command_line(text: str) -> None:
    assert process.load_settings(Text, None, [assignment("key", text)]).key == text


@given(st.sampled_from([Path("/tmp/a b/c.toml"), Path("/x/true"), Path("/é.toml")]))
def test_path_setting_is_passed_unchanged(path: Path) -> None:
    assert assignment("key", str(path)) == f"key={path}"


def test_movable_process_can_run_on_robot_or_base() -> None:
    onboard, offboard = (process_table.rows(role, simulated=False, page=True) for role in ("onboard", "offboard"))
    robot = process_table.rearranged(onboard, ("mapper", "planner"), (), "onboard")
    base = process_table.rearranged(offboard, (), ("mapper", "planner"), "offboard")
    assert [p.name for p in robot] == ["actuator", "stop", "camera", "imu", "perception", "mapper", "planner"]
    assert [p.name for p in base] == ["console", "recorder"]
    moved = process_table.rearranged(offboard, ("perception",), (), "offboard")
    assert [p.name for p in moved] == ["perception", "mapper", "planner", "console", "recorder"], "in the table's order"
    for name in process_table.ON_ROBOT:
        with pytest.raises(ValueError, match=f"{name} must run on the robot"):
            process_table.rearranged(offboard, (name,), (), "offboard")


def test_elsewhere_option_is_only_for_other_machines() -> None:
    rows = process_table.rows("offboard", simulated=False)
    here, away = (process_table.commands(rows, Choices(), ENDPOINTS, elsewhere=elsewhere) for elsewhere in (False, True))
    assert not any("--elsewhere" in command.arguments for command in here)
    assert all("--elsewhere" in command.arguments for command in away)


def test_arrays_are_packed_only_for_readers_on_other_machines() -> None:
    unpacked = {
        role: {c.name for c in commands(rows(role, True), Choices(scenario="flat"), ENDPOINTS) if "--unpacked" in c.arguments}
        for role in ("all", "onboard", "offboard")
    }
    assert unpacked == {"all": {"perception", "mapper"}, "onboard": set(), "offboard": set()}
    base = commands(rows("offboard", True), Choices(), ENDPOINTS, elsewhere=True)
    assert {c.name for c in base if "--unpacked" in c.arguments} == {"mapper"}, "the page of a robot is on its base"


def test_robot_with_its_own_map_packs_it_for_a_page_elsewhere() -> None:
    with_map = process_table.rearranged(rows("onboard", False), ("mapper", "planner"), (), "onboard")
    with_page = process_table.rearranged(with_map, ("console",), (), "onboard")
    unpacked = [
        {c.name for c in commands(some, Choices(), ENDPOINTS) if "--unpacked" in c.arguments} for some in (with_map, with_page)
    ]
    assert unpacked == [{"perception"}, {"perception", "mapper"}]


def test_only_recorder_uses_single_malloc_arena() -> None:
    made = process_table.commands(process_table.rows("all", True, page=True), Choices(), ENDPOINTS)
    assert [one.name for one in made if "MALLOC_ARENA_MAX" in one.environment] == ["recorder"]
    assert all(one.environment.items() >= process_table.ENVIRONMENT.items() for one in made)


def test_simulated_time_file_requires_simulator() -> None:
    file = Path("/a/time")
    made = commands(rows("all", True), Choices(scenario="flat"), ENDPOINTS, simulated_time=file)
    assert all(
        ("--simulated-time", str(file)) == c.arguments[k : k + 2] for c in made if (k := c.arguments.index("--simulated-time"))
    )
    with pytest.raises(ValueError, match="needs the simulator"):
        commands(rows("all", False), Choices(), ENDPOINTS, simulated_time=file)
