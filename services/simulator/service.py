"""Simulator service: emulates the robot's hardware and publishes ground truth.

The hardware is a depth camera, an IMU and a servo bus. Only the scorer uses the ground truth.
"""

import logging
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import replace
from typing import Self

import numpy as np

from sextant.services.simulator.config import Settings
from sextant.services.simulator.physics.model import TIME_STEP_NS, Factors
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.services.simulator.physics.world import World
from sextant.services.simulator.real_robot import real_profile
from sextant.services.simulator.sensors.imu import Imu as ImuSensor
from sextant.services.simulator.sensors.imu import ImuNoise
from sextant.services.simulator.sensors.robot_camera import RobotCamera
from sextant.services.simulator.sensors.stamp_errors import StampErrors
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.bus import BusTiming, ServoBusEmulator
from sextant.services.simulator.servo_bus.bus_faults import BusFaults, row_of
from sextant.services.simulator.servo_bus.host_link import EmulatedBus
from sextant.services.simulator.servo_bus.pulse_board import make_board
from sextant.services.simulator.servo_bus.servo_bank import ServoBank, ServoVariation
from sextant.services.simulator.servo_bus.servo_banks import AnyBank, RobotServos, make_robot_servos
from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
from sextant.services.simulator.viewer import Viewer
from sextant.shared.files.config import ConfigError
from sextant.shared.geometry import Array, rotation_from_rpy
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profile import GRAVITY, RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.clock import in_use
from sextant.shared.runtime.lateness import BEAT
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.runtime.simulated_time import SimulatedTime
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.mover import Mover
from sextant.shared.scenario.scenario import Fault, Scenario
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.wire import topics
from sextant.shared.wire.messages import CameraState, ColorImage, DepthImage, FaultCommand, GroundTruth, Imu, Message, Tick

_MAX_LAG_NS = 1_000_000_000  # [ns] lag up to which the physics catches up; servo writes keep their order meanwhile
_STALE_NS = 40_000_000  # [ns] lag of a live simulation above which its servos do not respond
_BEAT_NS = 2 * TIME_STEP_NS  # [ns] period of `step`; the actuator writes goals every 20 ms
_DT = TIME_STEP_NS * 1e-9  # [s]

log = logging.getLogger(__name__)


class Simulator:
    """Service that simulates a robot on a scenario.

    The physics follows the machine's clock in a live run, and simulated time in lockstep.
    """

    name = "simulator"
    subscribes: tuple[AnyTopic, ...] = (topics.FAULT,)
    publishes: tuple[AnyTopic, ...] = (topics.DEPTH, topics.COLOR, topics.CAMERA_STATE, topics.IMU, topics.TRUTH)

    def __init__(self, profile: RobotProfile, settings: Settings, scenario: Scenario | None = None):
        """Build the world, with the robot standing at its start and torque on.

        Args:
            profile: The robot, unless the scenario has another `real_robot`.
            settings: Settings of the simulator.
            scenario: Scenario that replaces the one of the settings.

        Raises:
            ConfigError: The scenario has a fault of a servo that the robot does not have, or a bridge has no firmware for them.
        """
        clock = in_use()
        self._time = clock if isinstance(clock, SimulatedTime) else None  # shared time, which this service advances
        self.trigger = Every(_BEAT_NS, by_machine=True)  # also ticks while simulated time stands still
        self.max_age_s = {BEAT: _STALE_NS * 1e-9}
        self.stages = Stages()
        scenario = load_scenario(settings.scenario) if scenario is None else scenario
        self._robot = profile.name  # of the services, which do not know the real robot
        R_assumed = profile.imu.R_body_imu
        if scenario.real_robot:
            profile = load_profile(scenario.real_robot)
        self._profile = profile
        self._settings = settings
        self._scenario = scenario
        seeds = [np.random.default_rng([settings.seed, stream]) for stream in range(7)]
        terrain = build_terrain(scenario, seeds[0])
        self._deviation = deviation = scenario.deviation(settings.seed)
        real = real_profile(profile, deviation)
        factors = replace(
            Factors.draw(scenario.variation, seeds[1]),
            foot_friction=deviation.foot_friction,
            link_lengths=deviation.link_lengths,
        )
        self._has_imu = scenario.variation.imu or profile.imu.is_separate
        self.world = World(real, terrain, factors, imu=self._has_imu, patches=deviation.patches)
        self._camera = RobotCamera(
            real,
            scenario,
            self.world,
            settings.seed,
            (seeds[2], seeds[4], seeds[6]),
            self.stages,
            settings.frames_per_picture,
        )
        jitter = np.random.default_rng([settings.seed, 7])
        self._stamps = StampErrors(real.camera.time_offset_s, deviation.stamp_jitter_s, jitter)
        self._imu = ImuSensor(ImuNoise().times(deviation.imu_bias), seeds[3])
        R_true = rotation_from_rpy(np.radians(deviation.imu_rpy_deg)) @ profile.imu.R_body_imu
        self.R_shown_body = R_assumed @ R_true.T  # vectors {body} as the message shows them; only the scorer may read it
        self._signs = profile.servo_signs
        self._horns = profile.servo_angles(np.radians(deviation.horns_deg))  # servo angles at joint angle zero
        self._servos = self._switch_on(profile, scenario, seeds[5])
        self._bank = self._servos.all
        self._bank.set_joint_state(*self._joints())
        self.buses = self._wired(scenario)  # in the order of the robot's buses
        self.bus = self.buses[0]
        self.device: Board | BusFaults = self.bus  # device at the actuator's port, or at that of the first bus
        if settings.bridge:
            try:
                self.device = Board(self.bus, model=self._bank.model, pulses=profile.servo.pulses)
            except ValueError as error:
                raise ConfigError("the bridge's firmware", [str(error)]) from None
        self._devices = (self.device, *self.buses[1:])
        self._adapter_ports = [bus.adapter_port(0) for bus in self.buses]
        self._fault_refused = ""
        self._servers: list[TcpBusServer] = []
        self._viewer: Viewer | None = None
        self._origin_ns: int | None = None  # [ns] tick time at which simulated time is 0
        self._due_ns = {topic.key: 0 for topic in self.publishes}
        self._behind = 0

    def _switch_on(self, profile: RobotProfile, scenario: Scenario, rng: np.random.Generator) -> RobotServos:
        """Place the robot at its start, and return its servos, which hold the pose."""
        height = profile.stance.height_or_own(scenario.walk.body_height)
        q, start = body_inverse(profile, profile.rest_feet(height)), scenario.start
        x, y, yaw_deg = rng.uniform(-1.0, 1.0, 3) * (*start.xy_spread, start.yaw_spread_deg) + (*start.xy, start.yaw_deg)
        real = self._deviation
        self.world.stand(q - np.radians(real.horns_deg), (x, y), np.radians(yaw_deg))
        servo = profile.servo_angles(q).ravel()
        variation = ServoVariation(real.stiffness.ravel(), real.torque.ravel(), np.radians(real.backlash_deg).ravel())
        servos = make_robot_servos(profile, servo, scenario.battery_ah, real.battery_resistance, variation)
        for row, (angle, one) in enumerate(zip(servo, profile.servos.each, strict=True)):
            model, table = one.servo_model, one.servo_model.table
            configured = {
                **(model.joint_settings if model.eeprom_needs_torque_off else {}),  # else the actuator writes them
                **one.controller_settings,  # behind the operating mode, which resets the gains
                table.baud_rate: model.rate_code(model.bus_rate),
                table.goal_position: model.units.ticks(angle),
                table.torque_enable: 1,
            }
            for register, value in configured.items():
                servos.all.write(row, register.address, register.encode(value))
        return servos

    def _wired(self, scenario: Scenario) -> list[BusFaults]:
        """Return the servo buses with the faults of the scenario."""
        try:
            buses = [BusFaults(self._wire(bank), bank, self._settings.seed) for bank in self._servos.on_bus]
            for fault in scenario.bus_faults:
                self._give(buses, fault, 0)
        except ValueError as error:
            raise ConfigError(f"scenario {scenario.name}", [str(error)]) from None
        for bus in buses:
            bus.origin_ns = None
        return buses

    def _wire(self, bank: AnyBank) -> EmulatedBus:
        """Return the bus of some servos, or the board that sends them pulses."""
        if self._profile.servo.pulses is not None:
            assert isinstance(bank, ServoBank)
            return make_board(bank, self._profile.servo.pulses, on_uart=self._settings.bridge)
        return ServoBusEmulator(bank, BusTiming(bank.model.bus_rate, 0) if self._settings.bridge else None)

    def _give(self, buses: Sequence[BusFaults], fault: BusFault, now_ns: int) -> None:
        """Inject a fault into the bus of its servo, or into all buses."""
        row = row_of(fault, self._profile.servo_models)
        for bus, of_bus in zip(buses, self._profile.servos.buses, strict=True):
            if row < 0 or row in of_bus.rows:
                bus.inject(fault, now_ns)

    def __enter__(self) -> Self:
        """Open the TCP ports of the servo bus, and the viewer if there is to be one, for a live run."""
        port, other = self._settings.bus_port, self._settings.other_bus_port
        for number, device in enumerate(self._devices):
            ports = [one and one + number for one in (port, other)]
            server = TcpBusServer(device, port=ports[0], other_port=ports[1], is_current=self._up_to_date)
            self._servers.append(server)
            log.info("servo bus %son %s", f"{name} " if (name := self.bus_names[number]) else "", server.url)
        if self._settings.viewer:
            self._viewer = Viewer(self.world)
        return self

    def __exit__(self, *_: object) -> None:
        if self._viewer is not None:
            self._viewer.close()
        for server in self._servers:
            server.close()

    def status(self) -> str:
        """Return scenario, simulated time, lag and faults as text."""
        late = f", {self._behind} times too slow for real time" if self._behind else ""
        broken = "; ".join(dict.fromkeys(filter(None, (bus.words(self._now_ns()) for bus in self.buses))))
        faults = f", faults: {broken}" if broken else ""
        refused = f", fault refused: {self._fault_refused}" if self._fault_refused else ""
        return f"simulating {self._scenario.name}, {self.world.time_ns * 1e-9:.1f} s{late}{faults}{refused}"

    @property
    def bus_names(self) -> tuple[str, ...]:
        """Names of the buses; that of the only one is empty."""
        return tuple(bus.name for bus in self._profile.servos.buses)

    @property
    def servos(self) -> AnyBank:
        """The servo models.

        Tests and measurements read or set their true state, e.g. the temperature.
        """
        return self._bank

    def inject(self, fault: BusFault) -> None:
        """Schedule a fault of servos or bus at its simulated time.

        The fault begins at once if that time has passed.

        Raises:
            ValueError: The fault names a servo that does not exist.
        """
        with self._locked():
            self._give(self.buses, fault, self._now_ns())

    def disturb(self, by: Fault | Mover) -> None:
        """Add a fault of the camera, or something that moves in its view, from its simulated time on.

        Raises:
            ValueError: It is a fault of a process.
        """
        self._camera.disturb(by)

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Advance the physics to the time of the tick, and yield due sensor messages."""
        if self._time is not None:
            self._time.grant()
        if self._origin_ns is None:
            self._origin_ns = tick.stamp_ns - self.world.time_ns
        for command in inbox.drain(topics.FAULT):
            self._break(command)
        if tick.stamp_ns - (self._origin_ns + self.world.time_ns) > _MAX_LAG_NS:
            self._behind += 1
            self._origin_ns = tick.stamp_ns - self.world.time_ns - 2 * TIME_STEP_NS
        for bus in self.buses:
            bus.origin_ns = self._origin_ns
        while self._origin_ns + self.world.time_ns < tick.stamp_ns:
            with self._locked():
                self._physics(self._origin_ns + self.world.time_ns)
            yield from self._observe(self._origin_ns + self.world.time_ns, inbox)
        if self._viewer is not None:
            self._viewer.show(self.world.time_ns)
        for k, server in enumerate(self._servers):
            if (plugged := self.buses[k].adapter_port(tick.stamp_ns)) != self._adapter_ports[k]:
                self._adapter_ports[k] = plugged
                server.replug()

    def _break(self, command: FaultCommand) -> None:
        """Inject the fault of a command, or log why it is refused."""
        try:
            self.inject(BusFault.of(command))
        except ValueError as error:
            self._fault_refused = str(error)
            log.warning("fault refused: %s", error)
        else:
            self._fault_refused = ""

    def _now_ns(self) -> int:
        return self.world.time_ns + (self._origin_ns or 0)

    def _up_to_date(self, now_ns: int) -> bool:
        """Return whether the physics is at most 40 ms late.

        The bus server calls this from its thread.
        """
        return self._origin_ns is None or now_ns - self._origin_ns - self.world.time_ns < _STALE_NS

    def _locked(self) -> AbstractContextManager[object]:
        """Keep the threads of the bus servers out."""
        if len(self._servers) <= 1:
            return self._servers[0].lock if self._servers else nullcontext()
        stack = ExitStack()
        for server in self._servers:
            stack.enter_context(server.lock)
        return stack

    def _physics(self, now_ns: int) -> None:
        world = self.world
        for device in self._devices:
            device.advance(now_ns)
        command = self._bank.advance(_DT)
        setpoint = self._signs * (command.setpoint.reshape(6, 3) - self._horns - self._bank.slipped.reshape(6, 3))
        world.step(setpoint, command.stiffness.reshape(6, 3), command.torque_limit.reshape(6, 3))
        self._bank.set_joint_state(*self._joints(), now_ns + TIME_STEP_NS)

    def _joints(self) -> tuple[Array, Array, Array]:
        """Return angles [rad], speeds [rad/s] and torques [N m] of the servos, each (18,)."""
        (q, qd, torque), signs = self.world.joints, self._signs
        servo = (signs * q + self._horns).ravel() + self._bank.slipped
        return servo, (signs * qd).ravel(), (signs * torque).ravel()

    def _observe(self, now_ns: int, inbox: Inbox) -> Iterator[Message]:
        """Yield the messages of camera, IMU and ground truth that are due."""
        camera = self._camera
        if self._due(topics.DEPTH, now_ns, self._profile.camera.sensor.rate_hz) and camera.begin_frame():
            depth = camera.depth()
            if depth is not None:
                stamp_ns, due_ns = camera.delivery(self._stamps.stamp(now_ns))
                self._stamps.hold(DepthImage(stamp_ns, depth, camera.gray), due_ns)
                # Colour is rendered at the time of a depth frame, so that their pixels correspond.
                if camera.has_color and inbox.wanted(topics.COLOR) and self._due(topics.COLOR, now_ns):
                    self._stamps.hold(ColorImage(stamp_ns, camera.color()), due_ns)
        yield from self._stamps.release(now_ns)
        if self._due(topics.CAMERA_STATE, now_ns):
            absent = "unplugged by the scenario" if camera.fault == "absent" else ""
            yield CameraState(now_ns, device="simulated depth camera", ok=not absent, reason=absent)
        if self._has_imu and self._due(topics.IMU, now_ns):
            yield self._feel(now_ns)
        if self._due(topics.TRUTH, now_ns):
            yield self._truth(now_ns)

    def _due(self, topic: AnyTopic, now_ns: int, rate_hz: float | None = None) -> bool:
        """Return whether a topic is due, and if so schedule its next period.

        Args:
            topic: The topic.
            now_ns: Current time [ns].
            rate_hz: Rate [Hz] that replaces the topic's rate.
        """
        due_ns = self._due_ns[topic.key]
        if now_ns < due_ns:
            return False
        period_ns = round(1e9 / (rate_hz or topic.rate_hz))
        self._due_ns[topic.key] = due_ns + period_ns * (1 + (now_ns - due_ns) // period_ns)
        return True

    def _feel(self, now_ns: int) -> Imu:
        rate, acceleration = (self.R_shown_body @ vector for vector in self.world.imu)
        gyro, force = self._imu.update(rate, acceleration, 1.0 / topics.IMU.rate_hz)
        return Imu(now_ns, gyro=gyro, specific_force=force)

    def imu_of_level_body(self) -> Array:
        """Return what the IMU shows on a level body at rest, without noise: (3,) [m/s^2]. Only the scorer may read it."""
        return np.asarray(self.R_shown_body[:, 2] * GRAVITY + self._imu.force_bias)

    def _truth(self, now_ns: int) -> GroundTruth:
        world = self.world
        return GroundTruth(
            stamp_ns=now_ns,
            T_world_body=world.T_world_body,
            q=world.q,
            torque=world.torque,
            feet=world.p_world_foot,
            contact=world.foot_contact,
            carries_load=world.leg_contact,
            shutdown=self._bank.shutdown.reshape(6, 3),
            voltage=float(self._bank.voltage),
            temperature=float(self._bank.temperature.max()),
            scenario=self._scenario.name,
            seed=self._settings.seed,
            robot=self._robot,
        )
