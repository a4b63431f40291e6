"""Endpoints of a robot with a tap on its servo bus."""

import pytest

from benchmarks.faults.instrumented_robot import BASE_ROUTER, WORLD_ROUTER, Page, Places, commands
from sextant.deploy.launch.process_table import Command


def robot_commands(places: Places, page: Page | None = None) -> dict[str, Command]:
    return {one.name: one for one in commands(places, 1, "flat", page)}


def connect_endpoint(one: Command) -> str:
    """Return the endpoint that a process connects to."""
    return one.arguments[one.arguments.index("--connect") + 1]


@pytest.mark.parametrize("world", [False, True])
@pytest.mark.parametrize("base", [False, True])
def test_base_and_simulator_use_own_routers_chained_to_robot(base: bool, world: bool) -> None:
    places = Places.free("halves", base, world)
    robot = robot_commands(places, Page(1234, "recordings"))
    away = {"mapper": places.base, "planner": places.base, "console": places.base, "recorder": places.base}
    away |= {"simulator": places.world}
    routers = {places.robot: "router", places.base: BASE_ROUTER, places.world: WORLD_ROUTER}
    for name in ("simulator", "actuator", "stop", "perception", "mapper", "planner", "console", "recorder"):
        place = away.get(name) or places.robot
        assert connect_endpoint(robot[name]) == place.connect[0]
        assert robot[name].after[0] == routers[place]
    assert (BASE_ROUTER in robot, WORLD_ROUTER in robot) == (base, world)
    for name in {BASE_ROUTER, WORLD_ROUTER} & robot.keys():
        assert connect_endpoint(robot[name]) == places.robot.connect[0]


def test_all_ports_are_different() -> None:
    places = Places.free("far", base=True, world=True)
    assert places.base is not None
    assert places.world is not None
    ports = [one.connect[0].rpartition(":")[2] for one in (places.robot, places.base, places.world)]
    assert len({*ports, str(places.bus), str(places.tap)}) == 5
    assert places.servos == f"socket://127.0.0.1:{places.tap}"
