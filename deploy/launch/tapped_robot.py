"""The processes of a simulated robot whose servo bus is tapped: to break one of them, or to time what reaches the servos."""

from dataclasses import replace

from deploy import process_table
from deploy.faults import tap
from deploy.network.gate import Gate
from deploy.process_table import Command
from shared.scenario import load_scenario
from shared.transport import Endpoints

RESTARTS = 1000
BASE_ROUTER = "base router"
WORLD_ROUTER = "world router"


def port(listen: int) -> str:
    """The tap as pyserial opens it, by its TCP port."""
    return f"socket://127.0.0.1:{listen}"


def commands(
    endpoints: Endpoints,
    bus: int,
    listen: int,
    seed: int,
    scenario: str,
    page_port: int | None = None,
    recordings: str = "recordings",
    scan_rate_hz: float | None = None,
    gate: Gate | None = None,
    base: Endpoints | None = None,
    world: Endpoints | None = None,
) -> list[Command]:
    """The services, their router, and the tap between actuator and servos.

    Args:
        endpoints: Where they meet; the router listens at the first of them.
        bus: TCP port of the simulated servo bus.
        listen: TCP port of the tap.
        seed: Of the simulator.
        scenario: That it is given.
        page_port: TCP port of the operators' page; None for no page, and no recorder.
        recordings: Folder in which recordings go.
        scan_rate_hz: Of perception; None for what it takes by itself.
        gate: Of the router, where it lets in others than those of this machine.
        base: Where those of the other half meet, by a router of their own, chained to the robot's; None for one router.
        world: Where the simulator is, by a router of its own, chained to the robot's, so that the truth can be heard while that
            is broken; None where the services meet.
    """
    chosen = process_table.choices(load_scenario(scenario), scenario, seed, bus)
    if page_port is not None:
        chosen = replace(chosen, console_port=page_port, lift=0.025, recordings=recordings)
    tapped = (process_table.assignment("port", port(listen)),)
    rarer = () if scan_rate_hz is None else (process_table.assignment("scan_rate_hz", scan_rate_hz),)
    extra = {"actuator": tapped, "stop": tapped, "perception": rarer}
    page = page_port is not None
    here = process_table.rows("all" if base is None else "onboard", True, page)
    there = () if base is None else process_table.rows("offboard", False, page)
    services = (
        *process_table.commands(here, chosen, endpoints, extra),
        *process_table.commands(there, chosen, base or endpoints, extra, elsewhere=True),
    )
    router = {p.name: BASE_ROUTER for p in there}
    if world is not None:
        (simulator,) = process_table.commands([p for p in here if p.name == "simulator"], chosen, world, extra)
        services = tuple(simulator if one.name == simulator.name else one for one in services)
        router[simulator.name] = WORLD_ROUTER
    needs = {"actuator": ("tap",)}
    return [
        replace(process_table.router_command(endpoints.connect[0], gate.words() if gate else ()), restarts=RESTARTS),
        *([] if base is None else [_chained_router(BASE_ROUTER, base, endpoints)]),
        *([] if world is None else [_chained_router(WORLD_ROUTER, world, endpoints)]),
        tap.command(listen, bus),
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
    """A router chained to the robot's."""
    listen = at.connect[0]
    words = ("--listen", listen, "--connect", robot.connect[0], "--namespace", at.namespace)
    return replace(process_table.router_command(listen, words), name=name, restarts=RESTARTS)
