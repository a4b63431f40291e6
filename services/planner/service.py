"""The planner: Lotriet's state machine of resting and stepping, on the newest map and pose."""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.approach import PassageMode
from sextant.services.planner.gap_crossing.state_machine import Move, Over, Refused, Standing
from sextant.services.planner.locomotion.blind_walking import ByTouch
from sextant.services.planner.locomotion.gait import GAITS, directions, swing_order
from sextant.services.planner.locomotion.missing_ground import Holes
from sextant.services.planner.locomotion.replan_attempts import Refusals, Way
from sextant.services.planner.locomotion.step_planner import Blocked, Situation, Stride, StridePlanner
from sextant.services.planner.navigation.path_follower import Heading, Pilot, objection
from sextant.services.planner.navigation.path_planner import NoWay
from sextant.services.planner.terrain import Terrain, plane_of
from sextant.shared.geometry import Array, apply, inverse, yaw_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    Goal,
    Message,
    Mode,
    PlannerStatus,
    StepPlan,
    TerrainMap,
    VelocityCommand,
)

State = Literal["waiting", "resting", "stepping", "blocked", "arrived"]

_STATUS_PERIOD_NS = 100_000_000
_TRY_AGAIN_NS = 2_000_000_000  # [ns] after every way of taking a step was refused
_MEASURED_NS = 300_000_000  # [ns] of rest in which feet are measured that have met ground somewhere
_DOUBT_NS = 1_000_000_000  # [ns] that a crossing goes by the legs alone
_UNANSWERED_NS = 300_000_000  # [ns] from a plan to its answer by legs at rest, beyond which it came too late
_GAP_NS = 500_000_000  # [ns] between two states of the legs, from which the planner was held up
_POSES = 45  # remembered: 3 s
_KEPT = 40  # plans remembered besides the newest
_RENEW_NS = 35_000_000  # [ns] after which the running step is sent once more: the actuator goes on for 180 ms without a plan
_MAX_STATE_AGE_S = (
    0.45  # [s] the plan that follows from an older state of the legs reaches them when it is too old to be walked
)
_NEW_COURSE = (0.02, 0.02, 0.1, 0.005, 0.005)  # [m/s, m/s, rad/s, m, m] by which a command must differ to be another one
_STILL = 1e-3  # [m/s] and [rad/s]
_ASKED_AGE_S = 2.0  # by which what is asked may be older than now by its stamp, or ahead: else it is not of now
_NOT_MINE = "the running step is not one of mine; waiting for its end"


class Planner:
    """Plans the next step while the last one is walked, and moves the touchdowns of the running one as the map improves."""

    name = "planner"
    paced_by: AnyTopic = topics.ACTUATOR_STATE
    reads: tuple[AnyTopic, ...] = (
        topics.BODY_POSE,
        topics.TERRAIN,
        topics.VELOCITY,
        topics.GOAL,
        topics.CAMERA_STATE,
        topics.PASSAGE,
    )
    writes: tuple[AnyTopic, ...] = (topics.STEP_PLAN, topics.PLANNER_STATUS, topics.PASSAGE_REQUEST, topics.PASSAGE_PLAN)

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Begin with no plan."""
        self.max_age_s = {topics.ACTUATOR_STATE.key: _MAX_STATE_AGE_S, topics.BODY_POSE.key: settings.pose_age_s}
        if not settings.blind:
            self.max_age_s[topics.TERRAIN.key] = settings.map_age_s
        self.stages = Stages()
        self._profile = profile
        self._settings = settings
        self._strides = StridePlanner(profile, settings)
        self._by_touch = ByTouch(profile, settings)
        self._holes = Holes()
        self._pilot = Pilot(profile)
        self._passage = PassageMode(profile, settings)
        self._led = False  # whether a goal is what it walks by
        self._sent: list[_Sent] = []  # that may yet be walked, the newest last
        self._running: _Sent | None = None  # what is being walked, or was last
        self._refusals = Refusals()
        self._asked: VelocityCommand | None = None  # what was commanded when they began
        self._looked_at: tuple[Stride, TerrainMap] | None = None  # for the last retargeting
        self._poses: deque[BodyPose] = deque(maxlen=_POSES)  # the newest of the last seconds
        self._stepped_ns = 0
        self._due_ns = 0
        self._renew_ns = 0
        self._step, self._begun_ns = -1, 0  # the running step, or the last, and when it was first heard of
        self._sure_ns = 0  # when perception was last sure of where the robot is
        self._moved_ns = 0  # when legs last moved
        self._taken_back: NDArray[np.bool_] = np.zeros(
            6, dtype=np.bool_
        )  # (6,) legs that have had to go back to where they stood
        self._put_down: Array | None = None  # (2,) [m] {world} where the robot stood before its first step
        self._status_due_ns = 0
        self._state: State = "waiting"
        self._reason = "starting"
        self._blocked_leg = -1
        self._moved = 0

    def doing(self) -> str:
        """State and reason."""
        return f"{self._state}: {self._reason}"

    def step(self, state: ActuatorState, inbox: Inbox) -> Iterator[Message]:
        """Follow the legs; plan when it is time to."""
        if state.stamp_ns - self._stepped_ns > _GAP_NS:
            self._pilot.pause()
        self._stepped_ns = state.stamp_ns
        self._follow(state)
        known = inbox.latest(topics.BODY_POSE)
        if known is not None:
            if not self._poses or known is not self._poses[-1]:
                self._poses.append(known)
            self._holes.update(state, known.T_world_odom)
        if state.stamp_ns >= self._due_ns:
            sent = self._plan(state, inbox)
            if sent is not None:
                self._due_ns = state.stamp_ns + round(self._settings.revise_s * 1e9)
                self._sent = [*self._sent[-_KEPT:], sent]
                self._moved = sent.stride.moved
                self._renew_ns = state.stamp_ns + _RENEW_NS
                yield sent.plan
        renewed = self._renewal(state, known)
        if renewed is not None:
            self._sent = [*self._sent[-_KEPT:], renewed]
            self._renew_ns = state.stamp_ns + _RENEW_NS
            yield renewed.plan
        yield from self._passage.messages(state.stamp_ns)
        if state.stamp_ns >= self._status_due_ns:
            self._status_due_ns = state.stamp_ns + _STATUS_PERIOD_NS
            yield self._status(state)

    def _follow(self, state: ActuatorState) -> None:
        """Notice which plan is walked, and which was refused."""
        if state.step != self._step:
            self._step, self._begun_ns = state.step, state.stamp_ns
        if not _rests(state):
            self._moved_ns = state.stamp_ns
        running = self._running
        if running is None or running.plan.stamp_ns != state.plan_ns:
            self._running = next((s for s in self._sent if s.plan.stamp_ns == state.plan_ns), None)
            # None: the actuator walks something else, or began anew.
            if self._running is None and running is not None and state.plan_ns < 0 and state.step == running.plan.step:
                self._taken_back = running.stride.swing.copy()
            if self._running is not None and (running is None or running.plan.step != self._running.plan.step):
                self._due_ns = 0  # a new step: its touchdowns may be looked at at once
                self._refusals.forget()
                if not (self._taken_back & self._running.stride.swing).any():
                    self._taken_back = np.zeros(6, dtype=np.bool_)
        refused = next((s for s in self._sent if s.plan.stamp_ns == state.refused_ns), None)
        if refused is not None:
            self._sent.remove(refused)
            waiting = state.phase < 1.0 and any(s.plan.step == refused.plan.step for s in self._sent)
            if refused.plan.step == state.step + 1 and not waiting:
                self._refusals.add(refused.way, state.refused)

    def _plan(self, state: ActuatorState, inbox: Inbox) -> "_Sent | None":
        """The plan to send now, or none and the reason in the status."""
        pose = inbox.fresh(topics.BODY_POSE, self._settings.pose_age_s)
        velocity, goal = inbox.fresh(topics.VELOCITY), inbox.fresh(topics.GOAL)
        late_velocity, late_goal = _untimely(velocity, state.stamp_ns), _untimely(goal, state.stamp_ns)
        untimely = late_velocity or late_goal
        command = None if late_velocity else _paced(velocity, state.pace)
        goal = None if goal is None or command is not None or late_goal else replace(goal, speed=goal.speed * state.pace)
        self._led = goal is not None
        if command is not None and not _is_still(command):
            self._passage.abandon()  # who falls silent, or rests, may want it later
        if state.mode not in (Mode.WALK, Mode.HOLD):
            self._passage.abandon()
            self._refusals.forget()
            return self._hold("waiting", f"the actuator is in mode {state.mode}: {state.reason}")
        if command is not None and command.by_touch:
            return self._feel_ahead(state, command, inbox)
        if pose is None:
            return self._hold("waiting", f"no fresh pose from perception{_blamed_on_camera(inbox)}")
        if command is None and goal is None:
            return self._hold("resting", untimely or "no fresh velocity command, and no goal")
        self._sure_ns = state.stamp_ns if pose.ok else self._sure_ns
        if state.step == 0 and _rests(state):
            self._put_down = pose.T_world_body[:2, 3].copy()
        terrain = self._terrain(state, pose, inbox)
        if goal is not None and self._passage.crosses(goal):
            if state.stamp_ns - self._sure_ns > _DOUBT_NS:
                return self._hold("waiting", f"where the robot is has been in doubt for a second: {pose.reason}")
            return self._across(goal, state, pose, terrain, inbox)
        if terrain is None:
            blind = f", and the camera does not help: {pose.reason}" if not pose.ok else _blamed_on_camera(inbox)
            return self._hold("waiting", f"no fresh terrain map{blind}")  # never walk blind
        nonsense = terrain.nonsense()
        if nonsense:
            return self._hold("waiting", f"the terrain map makes no sense: {nonsense}")
        if state.phase < 1.0 and state.phase < self._settings.retarget_until:
            return self._retarget(state, pose, terrain)
        if goal is not None and self._passage.under_way(goal):
            return self._across(goal, state, pose, terrain, inbox)
        if command is not None and _is_still(command):
            self._refusals.forget()
            return self._hold("resting", "no velocity is commanded")
        if state.phase < self._settings.plan_from:
            return None
        if command is not None:
            return self._first_that_goes((command,), state, pose, terrain)
        assert goal is not None
        return self._towards(goal, state, pose, terrain, inbox)

    def _feel_ahead(self, state: ActuatorState, command: VelocityCommand, inbox: Inbox) -> "_Sent | None":
        """The next step by touch alone: no map, and where the body is by the legs' odometry since it was last known."""
        known = inbox.latest(topics.BODY_POSE)
        if known is None:
            return self._hold("waiting", "by touch: no pose from perception yet, so {world} is not known")
        pose = replace(known, stamp_ns=state.stamp_ns, T_world_body=known.T_world_odom @ state.T_odom_body)
        if state.stamp_ns - self._moved_ns < _MEASURED_NS:
            return None  # where feet in the air will meet ground is not known
        if _is_still(command):
            self._refusals.forget()
            return self._hold("resting", "by touch: no velocity is commanded")
        terrain = self._holes.marked(self._by_touch.terrain(state.stamp_ns, _feet_in_world(state, pose)))
        situations = self._situations(state, pose, self._by_touch.asked(command))
        if not situations:
            return self._hold("waiting", _NOT_MINE)
        nonsense = self._strides.objection(situations[0].command)
        if nonsense:
            return self._hold("blocked", nonsense)
        with self.stages("plan step"):
            found, way = self._by_touch.choose(situations, terrain, self._refusals.of(0))
        if isinstance(found, Blocked):
            self._due_ns = state.stamp_ns + round(self._settings.revise_s * 1e9)
            if self._refusals.count:
                self._refusals.give_up()
                return self._hold("blocked", f"by touch: {self._refusals.words()}")
            return self._hold("blocked", f"by touch: {found.reason}", found.leg)
        self._state, self._blocked_leg = "stepping", -1
        self._reason = "by touch: feet find the ground"
        return self._send(state, pose.T_world_odom, found, state.step + 1, (0, way), stop=True)

    def _towards(self, goal: Goal, state: ActuatorState, pose: BodyPose, terrain: Terrain, inbox: Inbox) -> "_Sent | None":
        """The next step on the way to a goal; where one on the way does not go, walking without turning, or turning alone."""
        standing = self._standing(state, pose)
        if standing is None:
            return self._hold("waiting", _NOT_MINE)
        body, _ = standing
        asked = VelocityCommand(state.stamp_ns, np.zeros(2), 0.0, goal.body_height, goal.lift, goal.gait)
        nonsense = objection(goal) or self._strides.objection(asked)
        if nonsense:
            return self._hold("blocked", nonsense)
        if self._passage.ordered(goal):
            return self._across(goal, state, pose, terrain, inbox)
        if self._is_unanswered(state):
            self._pilot.pause()
        with self.stages("find a way"):
            found = self._pilot.lead(goal, terrain, self._looked_from(terrain, pose), body, state.stamp_ns)
        if isinstance(found, NoWay):
            return self._across(goal, state, pose, terrain, inbox, found.reason)
        if not found.commands:
            return self._hold("arrived", found.words)
        sent = self._walk_by(found, state, pose, terrain)
        if sent is None:
            self._pilot.note(self._reason)
        return sent

    def _is_unanswered(self, state: ActuatorState) -> bool:
        """Whether legs at rest neither walk a plan of the next step nor refuse it for what it asks: plans come too late."""
        sent = next((s for s in self._sent if s.plan.step == state.step + 1), None)
        waits = sent is not None and state.phase >= 1.0 and not self._refusals.count
        return waits and sent is not None and state.stamp_ns - sent.plan.stamp_ns > _UNANSWERED_NS

    def _looked_from(self, terrain: Terrain, pose: BodyPose) -> Array:
        """The body (4, 4) {world} when the newest scan of a map was taken, as far as poses are remembered."""
        stamp_ns = terrain.map.stamp_ns
        return min(self._poses, key=lambda known: abs(known.stamp_ns - stamp_ns), default=pose).T_world_body

    def _walk_by(self, found: Heading, state: ActuatorState, pose: BodyPose, terrain: Terrain) -> "_Sent | None":
        """The next step by the first command that can be walked, and what leads it, in words."""
        sent = self._first_that_goes(found.commands, state, pose, terrain)
        if sent is not None:
            self._reason = f"{found.words}; {self._reason}"
        return sent

    def _first_that_goes(
        self, commands: tuple[VelocityCommand, ...], state: ActuatorState, pose: BodyPose, terrain: Terrain
    ) -> "_Sent | None":
        """The next step by the first command that the ground, and the actuator, allow; none where every way was refused."""
        if commands and _differ(commands[0], self._asked):
            self._refusals.forget()
            self._asked = commands[0]
        for number, command in enumerate(commands):
            sent = self._next_step(state, pose, command, terrain, number)
            if sent is not None or self._state == "stepping":  # it comes to rest before a step by touch
                return sent
        if commands and self._state == "blocked" and state.phase >= 1.0:
            sent = self._gathering(state, pose, commands[0], terrain)
            if sent is not None:
                return sent
        if self._refusals.count:
            self._refusals.give_up()
            self._due_ns = state.stamp_ns + _TRY_AGAIN_NS
            return self._hold("blocked", self._refusals.words())
        return None

    def _across(
        self, goal: Goal, state: ActuatorState, pose: BodyPose, terrain: Terrain | None, inbox: Inbox, no_way: str = ""
    ) -> "_Sent | None":
        """The next step of a deliberate crossing, where walking finds no way."""
        found = self._standing(state, pose)
        if found is None:
            return self._hold("waiting", _NOT_MINE)
        refused = self._refusals.reason if self._refusals.count > 1 else ""
        if refused:
            self._refusals.forget()
        map_ = inbox.latest(topics.PASSAGE)
        with self.stages("cross a passage"):
            led = self._passage.lead(goal, state, Standing(*found), pose.T_world_body, terrain, map_, refused)
        if isinstance(led, Heading):
            assert terrain is not None
            return None if state.phase < self._settings.plan_from else self._walk_by(led, state, pose, terrain)
        if isinstance(led, Move):
            self._state, self._reason, self._blocked_leg = "stepping", led.words, -1
            return self._send(state, pose.T_world_odom, led.stride, led.number, (0, 0), stop=led.stop)
        if isinstance(led, Refused):
            self._due_ns = state.stamp_ns + round(self._settings.revise_s * 1e9)
            both = f"{no_way}; and no passage: {led.reason}" if no_way else f"no passage: {led.reason}"
            return self._hold("blocked", both)
        if isinstance(led, Over):
            self._pilot = Pilot(self._profile)  # what it knew of the way does not hold here
        return self._hold("stepping" if state.phase < 1.0 else "waiting", led.words)

    def _terrain(self, state: ActuatorState, pose: BodyPose, inbox: Inbox) -> Terrain | None:
        """The map, or for the blind baseline the plane of the standing feet."""
        if self._settings.blind:
            return plane_of(state.stamp_ns, _feet_in_world(state, pose)[~state.swing] - [0.0, 0.0, self._profile.foot.radius])
        map_ = inbox.fresh(topics.TERRAIN, self._settings.map_age_s)
        return None if map_ is None else self._holes.marked(Terrain(map_, self._settings.footholds))

    def _next_step(
        self, state: ActuatorState, pose: BodyPose, command: VelocityCommand, terrain: Terrain, number: int
    ) -> "_Sent | None":
        """The next step by one of the commands, by its number."""
        situations = self._situations(state, pose, command)
        if not situations:
            return self._hold("waiting", _NOT_MINE)
        nonsense = self._strides.objection(command)
        if nonsense:
            return self._hold("blocked", nonsense)
        with self.stages("plan step"):
            found, way = self._strides.choose(situations, terrain, self._refusals.of(number))
        feels = self._running is not None and self._running.plan.stop  # by touch feet stand as no other step would have them
        if isinstance(found, Blocked) and (found.unseen or feels) and self._put_down is not None:
            course = yaw_of(pose.T_world_body) + math.atan2(command.velocity[1], command.velocity[0])
            ground = self._by_touch.underfoot(terrain, situations[0].feet, self._put_down, course)
            if ground is not None:
                sent = self._feel_out(state, pose, command, ground, number)
                if sent is not None or self._state == "stepping":
                    return sent
        if isinstance(found, Blocked):
            self._due_ns = state.stamp_ns + round(self._settings.revise_s * 1e9)  # trying all shares is the dearest of all
            return self._hold("blocked", found.reason + self._where_to_look(found, command), found.leg)
        if self._refusals.given_up:
            self._state, self._reason = "blocked", self._refusals.words()
        else:
            self._state, self._blocked_leg = "stepping", -1
            shorter = "" if found.share == 1.0 else f" at {found.share:.0%} of the stride"
            slower = self._strides.short_of(command, found)
            instead = f"; instead of legs that cannot: {found.instead}" if found.instead else ""
            moved = f"{found.moved} of {found.swing.sum()} footholds moved from their nominal place"
            moved = moved if found.swing.any() else "the body alone moves, to make room for a leg"
            self._reason = f"{moved}{shorter}{slower}{instead}"
        return self._send(state, pose.T_world_odom, found, state.step + 1, (number, way))

    def _gathering(self, state: ActuatorState, pose: BodyPose, command: VelocityCommand, terrain: Terrain) -> "_Sent | None":
        """A step on the spot of a robot that stands blocked, so that stretched legs do not keep it there; it stays blocked."""
        if self._strides.objection(command):
            return None
        with self.stages("gather feet"):
            found, way = self._strides.gather(self._situations(state, pose, command), terrain, self._refusals.of(0))
        if isinstance(found, Blocked):
            return None
        self._reason = f"feet back under the body: {self._reason}"
        return self._send(state, pose.T_world_odom, found, state.step + 1, (0, way))

    def _feel_out(
        self, state: ActuatorState, pose: BodyPose, command: VelocityCommand, ground: Terrain, number: int
    ) -> "_Sent | None":
        """The next step by touch, out of where the robot was put down, onto ground that is seen."""
        if state.stamp_ns - self._moved_ns < _MEASURED_NS:
            return self._hold("stepping", "by touch where the ground is unseen; coming to rest")
        situations = self._situations(state, pose, self._by_touch.asked(command))
        with self.stages("plan step"):
            found, way = self._by_touch.choose(situations, ground, self._refusals.of(number))
        if isinstance(found, Blocked):
            return self._hold("blocked", found.reason, found.leg)  # the caller replaces it by why no step on sight goes on
        self._state, self._blocked_leg = "stepping", -1
        self._reason = "by touch where the ground is unseen, until feet come to ground that is seen"
        return self._send(state, pose.T_world_odom, found, state.step + 1, (number, way), stop=True)

    def _where_to_look(self, found: Blocked, command: VelocityCommand) -> str:
        """What to do first where the ground that is walked to was never in view, in words; a goal's pilot does it by itself."""
        lens = self._profile.camera.intrinsics
        direction = math.atan2(command.velocity[1], command.velocity[0])
        in_view = abs(direction) < math.atan2(lens.width / 2, lens.fx) or not command.velocity.any()
        if self._led or in_view or not found.unseen:
            return ""
        return f"; the ground there is unseen: turn {'left' if direction > 0 else 'right'} first to look at it"

    def _situations(self, state: ActuatorState, pose: BodyPose, command: VelocityCommand) -> list[Situation]:
        """What the next step may begin with, for each group of legs, the most due first; none where that is not known."""
        standing = self._standing(state, pose)
        if standing is None:
            return []
        body, feet = standing
        rest = self._profile.rest_feet(command.body_height)
        along = directions(command.velocity, command.yaw_rate, rest)
        order = swing_order(GAITS[command.gait], along, apply(inverse(body), feet), rest)
        order = sorted(order, key=lambda swing: bool((swing & self._taken_back).any()))  # others first
        return [Situation(body, feet, swing, command) for swing in order]

    def _standing(self, state: ActuatorState, pose: BodyPose) -> tuple[Array, Array] | None:
        """The body (4, 4) and the feet (6, 3) [m] {world} when the running step is over; None where that is not known."""
        T_world_odom = pose.T_world_odom
        feet = _feet_in_world(state, pose)
        body = T_world_odom @ state.body_ref
        if state.phase < 1.0:
            running = self._running
            if running is None:
                return None
            plan = running.plan
            moved = T_world_odom @ inverse(plan.T_world_odom)  # the world as it is believed to be now
            body = moved @ plan.body_goal
            feet[plan.swing] = apply(moved, plan.touchdown)[plan.swing]
            met = plan.swing & state.touch_carries & (state.touch_ns > self._begun_ns)  # ground before their touchdowns
            feet[met] = apply(T_world_odom, state.touch)[met] + [0.0, 0.0, self._profile.foot.radius]
        return body, feet

    def _retarget(self, state: ActuatorState, pose: BodyPose, terrain: Terrain) -> "_Sent | None":
        """A revision of the running step, when the newer map moves a touchdown by more than a little."""
        running = self._running
        if running is None:
            return None
        before, self._looked_at = self._looked_at, (running.stride, terrain.map)
        if before is not None and before[0] is running.stride and before[1] is terrain.map:
            return None  # nothing has changed since
        # The legs walk by what was believed when the plan was made; in the world as it is believed to be now that leads here.
        stride = running.stride.moved_by(pose.T_world_odom @ inverse(running.plan.T_world_odom))
        found = self._strides.retarget(stride, terrain)
        if np.abs(found.touchdown - stride.touchdown).max() < self._settings.retarget_from_m:
            return None
        return self._send(state, pose.T_world_odom, found, running.plan.step, running.way)

    def _renewal(self, state: ActuatorState, pose: BodyPose | None) -> "_Sent | None":
        """The running step as it is, where no plan has been sent for a while: the robot walks on only as long as it is led."""
        running = self._running
        if running is None or state.mode is not Mode.WALK or state.phase >= 1.0 or state.stamp_ns < self._renew_ns:
            return None
        plan = running.plan
        T_world_odom = plan.T_world_odom if pose is None else pose.T_world_odom
        stride = running.stride.moved_by(T_world_odom @ inverse(plan.T_world_odom))
        return self._send(state, T_world_odom, stride, plan.step, running.way, plan.stop)

    def _send(
        self, state: ActuatorState, T_world_odom: Array, stride: Stride, number: int, way: Way, stop: bool = False
    ) -> "_Sent":
        """A plan of a step, as the next revision of it."""
        revision = 1 + max((s.plan.revision for s in self._sent if s.plan.step == number), default=0)
        plan = StepPlan(
            stamp_ns=state.stamp_ns,
            epoch=state.epoch,
            step=number,
            revision=revision,
            T_world_odom=np.array(T_world_odom),
            swing=stride.swing,
            touchdown=stride.touchdown,
            clearance=stride.clearance,
            body_goal=stride.body_goal,
            duration=stride.duration,
            stop=stop,
        )
        return _Sent(plan, stride, way)

    def _hold(self, state: State, reason: str, leg: int = -1) -> "_Sent | None":
        """No plan, and why; time for which data or a command is missing does not count as standing still."""
        if state in ("waiting", "resting"):
            self._pilot.pause()
        self._state, self._reason, self._blocked_leg = state, reason, leg
        return None

    def _status(self, state: ActuatorState) -> PlannerStatus:
        return PlannerStatus(
            stamp_ns=state.stamp_ns,
            state=self._state,
            reason=self._reason,
            step=state.step,
            moved_footholds=self._moved,
            blocked_leg=self._blocked_leg,
            path=self._pilot.path if self._led else np.zeros((0, 2)),
        )


def _untimely(asked: VelocityCommand | Goal | None, now_ns: int) -> str:
    """Why what is asked is not of now, in words, or nothing: it was recorded, or its sender goes by another clock."""
    age_s = 0.0 if asked is None else (now_ns - asked.stamp_ns) * 1e-9
    if abs(age_s) <= _ASKED_AGE_S:
        return ""
    what = "velocity command" if isinstance(asked, VelocityCommand) else "goal"
    when = f"{age_s:.1f} s old" if age_s > 0.0 else f"stamped {-age_s:.1f} s ahead"
    return (
        f"the {what} is {when} by the robot's clock, at most {_ASKED_AGE_S:.0f} s allowed: whoever sends it is to stamp by that"
    )


def _blamed_on_camera(inbox: Inbox) -> str:
    """What the camera says of itself, where it is what is missing."""
    camera = inbox.fresh(topics.CAMERA_STATE)
    return "" if camera is None or camera.ok else f", for the camera sends none: {camera.reason}"


def _rests(state: ActuatorState) -> bool:
    """Whether all legs stand: none swings, none looks for its ground."""
    return state.phase >= 1.0 and state.mode is not Mode.WALK


def _feet_in_world(state: ActuatorState, pose: BodyPose) -> Array:
    """Measured feet (6, 3) [m] {world}."""
    return apply(pose.T_world_odom @ state.T_odom_body, state.feet)


@dataclass(frozen=True, slots=True, eq=False)
class _Sent:
    """A plan and what is behind it."""

    plan: StepPlan
    stride: Stride
    way: Way  # of taking the step


def _paced(command: VelocityCommand | None, pace: float) -> VelocityCommand | None:
    """A command as fast as the servos can bear for long."""
    if command is None or pace >= 1.0:
        return command
    return replace(command, velocity=command.velocity * pace, yaw_rate=command.yaw_rate * pace)


def _is_still(command: VelocityCommand) -> bool:
    """Whether no motion is asked for."""
    return bool(np.abs(command.velocity).max() < _STILL and abs(command.yaw_rate) < _STILL)


def _differ(a: VelocityCommand, b: VelocityCommand | None) -> bool:
    """Whether two commands ask for different steps."""
    if b is None:
        return True
    change = np.abs([*(a.velocity - b.velocity), a.yaw_rate - b.yaw_rate, a.body_height - b.body_height, a.lift - b.lift])
    return bool((change > _NEW_COURSE).any()) or a.gait != b.gait
