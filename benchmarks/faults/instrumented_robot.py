"""Simulated robot whose servo bus passes through a tap.

The tap injects faults, or measures when messages reach the servos.
"""

from dataclasses import dataclass, replace
from typing import Self

from benchmarks.faults import bus_sniffer
from sextant.deploy.launch import process_table
from sextant.deploy.launch.process_table import Command
from sextant.deploy.security.router_security import Gate
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints

RESTARTS = 1000
BASE_ROUTER = "base router"
WORLD_ROUTER = "world router"
_URGENT = ("simulator", "actuator")  # processes with real-time priority


@dataclass(frozen=True, slots=True)
class Places:
    """Endpoints and ports of one robot's processes and servos."""

    robot: Endpoints  # the router listens at the first of them
    bus: int  # TCP port of the simulated servo bus
    tap: int  # TCP port of the tap in front of it
    base: Endpoints | None = None  # of the base station, whose router is chained to the robot's; None: one router
    world: Endpoints | None = None  # of the simulator, which stays reachable while the robot's router is broken

    @classmethod
    def free(cls, namespace: str, base: bool = False, world: bool = False) -> Self:
        """Return unused endpoints and ports of this machine.

        `base` and `world` add separate routers for the base station and for the simulator.
        """

        def somewhere() -> Endpoints:
            return Endpoints((f"tcp/127.0.0.1:{free_port()}",), namespace=namespace)

        return cls(somewhere(), free_port(), free_port(), somewhere() if base else None, somewhere() if world else None)

    @property
    def servos(self) -> str:
        """The tap's address for pyserial."""
        return f"socket://127.0.0.1:{self.tap}"


@dataclass(frozen=True, slots=True)
class Page:
    """The operator page of a robot, and its recorder."""

    port: int
    recordings: str  # folder for recordings


def commands(
    places: Places,
    seed: int,
    scenario: str,
    page: Page | None = None,
    scan_rate_hz: float | None = None,
    gate: Gate | None = None,
) -> list[Command]:
    """Return the commands of the services, their routers, and the tap.

    Args:
        places: Endpoints and ports.
        seed: Random seed of the simulator.
        scenario: Name or path of the scenario.
        page: None for no page and no recorder.
        scan_rate_hz: [Hz] scan rate of perception; None for its default.
        gate: Access rules of the router, if it admits other machines.
    """
    chosen = process_table.choices(load_scenario(scenario), scenario, seed, places.bus)
    if page is not None:
        chosen = replace(chosen, console_port=page.port, lift=0.025, recordings=page.recordings)
    tapped = (process_table.assignment("port", places.servos),)
    rarer = () if scan_rate_hz is None else (process_table.assignment("scan_rate_hz", scan_rate_hz),)
    extra = {"actuator": tapped, "stop": tapped, "perception": rarer}
    base, world, paged = places.base, places.world, page is not None
    here = process_table.rows("all" if base is None else "onboard", True, paged)
    there = () if base is None else process_table.rows("offboard", False, paged)
    services = (
        *process_table.commands(here, chosen, places.robot, extra),
        *process_table.commands(there, chosen, base or places.robot, extra, elsewhere=True),
    )
    router = {p.name: BASE_ROUTER for p in there}
    if world is not None:
        (simulator,) = process_table.commands([p for p in here if p.name == "simulator"], chosen, world, extra)
        services = tuple(simulator if one.name == simulator.name else one for one in services)
        router[simulator.name] = WORLD_ROUTER
    # They stand for hardware, which no program slows down.
    services = tuple(replace(one, arguments=(*one.arguments, "--urgent")) if one.name in _URGENT else one for one in services)
    needs = {"actuator": ("tap",)}
    return [
        replace(process_table.router_command(places.robot.connect[0], gate.words() if gate else ()), restarts=RESTARTS),
        *([] if base is None else [_chained_router(BASE_ROUTER, base, places.robot)]),
        *([] if world is None else [_chained_router(WORLD_ROUTER, world, places.robot)]),
        bus_sniffer.command(places.tap, places.bus),
        *(
            replace(
                one,
                restarts=RESTARTS if one.name != "simulator" else 0,
                after=(router.get(one.name, "router"), *one.after, *needs.get(one.name, ())),
            )
            for one in services
        ),
    ]


def _chained_router(name: str, at: Endpoints, robot: Endpoints) -> Command:
    """Return the command of a router that is chained to the robot's."""
    listen = at.connect[0]
    words = ("--listen", listen, "--connect", robot.connect[0], "--namespace", at.namespace)
    return replace(process_table.router_command(listen, words), name=name, restarts=RESTARTS)
