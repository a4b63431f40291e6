"""The whole actuator on emulated servos that follow their goals."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.config import Settings
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.services.actuator.safety.walk_authorization import WalkAuthorization
from sextant.services.actuator.service import Actuator
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.kinematics import body_forward, body_inverse, joint_torques
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, Message, ModeCommand, StepPlan, Tick

PROFILE = load_profile("phantomx_mk2")
REST = PROFILE.rest_feet()
IDS = PROFILE.servo_ids.ravel().tolist()
PERIOD = 20_000_000
TRIPOD = np.arange(6) % 2 == 0
TICK = dxl.TICK_RAD
OUT = np.column_stack([PROFILE.T_body_coxa[:, :2, 0], np.zeros(6)])
UP = np.array([0.0, 0.0, 1.0])
STILL = 0.02  # [rad] tolerance of goals: sag that is integrated away, and rounding to ticks
CRAWL = PROFILE.rest_feet(0.03) + 0.05 * OUT


class Rig:
    """Servos on a bus, and the actuator that owns them.

    A servo with torque reaches its goal one cycle later.
    """

    def __init__(self, feet: Array = REST, torque: bool = True, latch: Latch | None = None) -> None:
        self.now_ns, self.period_ns = 0, PERIOD
        self.latch = latch
        q = PROFILE.servo_angles(body_inverse(PROFILE, feet)).ravel()
        self.bank = ServoBank(IDS, q=q)
        for row, angle in enumerate(q):
            self.bank.write(row, dxl.GOAL_POSITION.address, dxl.GOAL_POSITION.encode(dxl.ticks_from_angle(angle)))
            self.bank.write(row, dxl.TORQUE_ENABLE.address, bytes([torque]))
        self.bus = ServoBusEmulator(self.bank)
        self.push = np.zeros((6, 3))  # [N] (6, 3) {body} on the feet, as the servos feel it, in addition to the ground's force
        self.ground = np.full(6, True)  # legs that stand on something when they are down
        self.order = 0
        self.ordered: ModeCommand | None = None
        self.leads = True  # the planner resends the running step periodically, and the operator resends the order
        self.running: StepPlan | None = None
        self.stuck: dict[int, float] = {}  # [rad] joints (0 to 17) that stay at this angle and ignore their goals
        self.state: ActuatorState | None = None
        self.authorization = WalkAuthorization()
        self.suspended_ns = 0  # time for which the computer was suspended
        self.start()

    def start(self) -> None:
        """Start a new actuator on the same servos."""
        self.port = MemoryPort(self.bus, lambda: self.now_ns)
        self.actuator = Actuator(
            PROFILE, Settings(), lambda: self.port, self.port.now_ns, self.latch, self.authorization, lambda: self.suspended_ns
        )
        self.inbox = Inbox(self.actuator.subscribes, self.actuator.stages)
        self.now_ns = self.port.now_ns()

    @property
    def goals(self) -> Array:
        """Goal joint angles (6, 3) of the servos."""
        ticks = [int.from_bytes(self.bank.read(row, dxl.GOAL_POSITION.address, 2), "little") for row in range(18)]
        return PROFILE.joint_angles(np.array([dxl.angle_from_ticks(t) for t in ticks]).reshape(6, 3))

    @property
    def torque(self) -> bool:
        return all(self.bank.read(row, dxl.TORQUE_ENABLE.address, 1) == b"\x01" for row in range(18))

    def hear(self, message: Message) -> None:
        if isinstance(message, StepPlan):
            self.running = message
        self.inbox.receive(topics.OF_TYPE[type(message)], codec.encode(message), self.now_ns)

    def command(self, mode: str) -> None:
        self.order = max(self.order + 1, self.now_ns)
        self.ordered = ModeCommand(self.now_ns, mode, self.order)  # type: ignore[arg-type]
        self.hear(self.ordered)

    def lead(self) -> None:
        """Resend the order and the running step, as the operator and the planner do."""
        state, plan = self.state, self.running
        if self.ordered is not None and self.now_ns % (25 * PERIOD) < PERIOD:
            self.hear(replace(self.ordered, stamp_ns=self.now_ns))
        if state is None or plan is None or state.phase >= 1.0 or self.now_ns % (4 * PERIOD) >= PERIOD:
            return
        if plan.step == state.step:
            self.hear(replace(plan, stamp_ns=self.now_ns, revision=plan.revision + 1))

    def cycle(self, count: int = 1) -> ActuatorState:
        """Run cycles and return the last state."""
        for _ in range(count):
            self.now_ns = max(self.now_ns + self.period_ns, self.port.now_ns())
            self.bus.advance(self.now_ns)
            q = self.goals if self.torque else PROFILE.joint_angles(self.bank._q.reshape(6, 3))
            q.flat[list(self.stuck)] = list(self.stuck.values())
            low = body_forward(PROFILE, q)[:, 2]
            weight = 4.0 * (self.ground & (low < low[self.ground].min(initial=1.0) + 0.005))[:, None] * [0.0, 0.0, 1.0]
            torque = PROFILE.servo_signs * joint_torques(PROFILE, q, weight + self.push)
            self.bank.step(PROFILE.servo_angles(q).ravel(), np.zeros(18), torque.ravel(), 0.02)
            self.inbox.now_ns = self.now_ns
            if self.leads:
                self.lead()
            self.made = list(self.actuator.step(Tick(self.now_ns), self.inbox))
            self.state = next((m for m in self.made if isinstance(m, ActuatorState)), self.state)
        assert self.state is not None
        return self.state  # the newest one: the actuator publishes every second cycle, and at once on changes

    def plan(self, state: ActuatorState, x: float = 0.04, **changes: Any) -> StepPlan:
        """Return the next step straight ahead; {world} equals {odom}."""
        goal = state.body_ref @ from_xyz_rpy((x, 0.0, 0.0), np.zeros(3))
        feet = apply(state.T_odom_body, state.feet)
        swing = TRIPOD if (state.step + 1) % 2 else ~TRIPOD
        touchdown = np.where(swing[:, None], apply(goal, REST + np.array([x / 2, 0.0, 0.0])), feet)
        touchdown[:, 2] = feet[:, 2]
        plan = StepPlan(
            stamp_ns=state.stamp_ns,
            epoch=state.epoch,
            step=state.step + 1,
            revision=1,
            T_world_odom=np.eye(4),
            swing=swing,
            touchdown=touchdown,
            clearance=np.full(6, 0.03),
            body_goal=goal,
            duration=0.6,
            stop=False,
        )
        return replace(plan, **changes)

    def joint(self, row: int) -> float:
        """Return the angle [rad] of a joint (0 to 17)."""
        return float(PROFILE.joint_angles(self.bank._q.reshape(6, 3)).flat[row])

    def air(self, state: ActuatorState) -> NDArray[np.bool_]:
        """Return a mask (6,) of the feet that are above the others."""
        heights = apply(state.T_odom_body, state.feet)[:, 2]
        return np.asarray(heights > heights.min() + 0.01)

    def walking(self) -> ActuatorState:
        """Order the standing robot to walk, and return the state."""
        self.cycle(2)
        self.command("walk")
        return self.cycle()
