"""Translator of the messages of a walk to Foxglove schemas."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message

from sextant.shared.recording.event_log import EventLog
from sextant.shared.recording.foxglove import ground, numbers, robot
from sextant.shared.recording.foxglove.parts import time
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.health_table import HealthTable
from sextant.shared.runtime.service import AnyTopic, Decode
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    CameraState,
    Health,
    PassagePlan,
    PlannerStatus,
    Preview,
    Scan,
    StepPlan,
    TerrainMap,
)

Told = tuple[str, Message]  # topic of Foxglove, message

_MAP_NS = 1_000_000_000  # [ns] between two maps
_SCAN_NS = 400_000_000  # [ns] between two scans
_SCENE_NS = 80_000_000  # [ns] between two scenes of the robot, and between two of its footholds
_SERVICES_NS = 1_000_000_000  # [ns] between two checks for silent services


class Foxglove:
    """Translates frames to Foxglove messages, large ones at a reduced rate."""

    def __init__(self, profile: RobotProfile, decode: Decode = codec.decode):
        """Start with the profile of the robot and a decoder of frames, before any message."""
        self._profile, self._decode = profile, decode
        self._T_world_odom = np.eye(4)
        self._due_ns: dict[str, int] = {}
        self._event_log = EventLog()
        self._logged = 0  # number of log entries already returned
        self._health = HealthTable()
        self._tells: Mapping[AnyTopic, Callable[[Any, int], Iterator[Told]]] = {
            topics.ACTUATOR_STATE: self._legs,
            topics.STEP_PLAN: self._step,
            topics.PLANNER_STATUS: self._planner,
            topics.PASSAGE_PLAN: self._passage,
            topics.TERRAIN: self._map,
            topics.SCAN: self._scan,
            topics.PREVIEW: self._picture,
        }
        self._follows: Mapping[AnyTopic, Callable[[Any, int], None]] = {
            topics.BODY_POSE: self._pose,
            topics.CAMERA_STATE: self._camera,
            **{topic: partial(self._service, role) for role, topic in topics.HEALTH_OF.items()},
        }

    def translate(self, topic: AnyTopic, frame: bytes, at_ns: int) -> Sequence[Told]:
        """Return (Foxglove topic, message) pairs for a frame received at a time [ns].

        A frame that does not decode adds an entry to the log.
        """
        if topic not in self._tells and topic not in self._follows:
            return ()
        if (topic is topics.TERRAIN and not self._due("map", at_ns, _MAP_NS)) or (
            topic is topics.SCAN and not self._due("scan", at_ns, _SCAN_NS)
        ):
            return ()
        told: list[Told] = []
        try:
            message, _ = self._decode(frame, topic.type, topic.max_bytes)
        except codec.DecodeError as error:
            self._event_log.note(at_ns, "recorder", f"{topic.key}: {error}", bad=True)
        else:
            if topic in self._tells:
                told += self._tells[topic](message, at_ns)
            else:
                self._follows[topic](message, at_ns)
        return [*told, *self._log()]

    def _due(self, what: str, at_ns: int, apart_ns: int) -> bool:
        """Return whether the next output is due, and if so schedule the one after it."""
        if at_ns < self._due_ns.get(what, at_ns):
            return False
        self._due_ns[what] = at_ns + apart_ns
        return True

    def _legs(self, state: ActuatorState, at_ns: int) -> Iterator[Told]:
        self._event_log.legs(at_ns, state)
        T_world_body = self._T_world_odom @ state.T_odom_body
        yield "/tf", robot.frames(state, self._T_world_odom, self._profile.camera.T_body_camera)
        yield "/body", robot.body(state, T_world_body)
        yield "/joints", robot.joints(state)
        yield "/walk", numbers.walk(state, T_world_body)
        if self._due("robot", at_ns, _SCENE_NS):
            yield "/robot", robot.drawn(state, self._profile)

    def _step(self, plan: StepPlan, at_ns: int) -> Iterator[Told]:
        if self._due("plan", at_ns, _SCENE_NS):
            yield "/plan", robot.footholds(plan)

    def _planner(self, status: PlannerStatus, at_ns: int) -> Iterator[Told]:
        self._event_log.planner(at_ns, status)
        if len(status.path) and self._due("way", at_ns, _MAP_NS):
            yield "/plan", robot.way(status)

    def _passage(self, plan: PassagePlan, at_ns: int) -> Iterator[Told]:
        self._event_log.passage(at_ns, plan)
        yield "/plan", robot.section(plan)

    def _map(self, terrain: TerrainMap, _: int) -> Iterator[Told]:
        yield "/map", ground.grid(terrain)
        yield "/map/points", ground.cells(terrain)

    def _scan(self, scan: Scan, _: int) -> Iterator[Told]:
        yield "/scan", ground.points(scan)

    def _picture(self, picture: Preview, _: int) -> Iterator[Told]:
        for name, jpeg in (("depth", picture.depth_jpeg), ("color", picture.color_jpeg)):
            if jpeg.size:
                yield f"/camera/{name}", ground.image(picture.stamp_ns, jpeg)

    def _pose(self, pose: BodyPose, at_ns: int) -> None:
        self._T_world_odom = pose.T_world_odom
        self._event_log.perception(at_ns, pose)

    def _camera(self, state: CameraState, at_ns: int) -> None:
        self._event_log.camera(at_ns, state)

    def _service(self, role: str, health: Health, at_ns: int) -> None:
        self._health.add(role, health, at_ns)
        if self._due("services", at_ns, _SERVICES_NS):
            self._health.forget(at_ns)
            self._event_log.services(at_ns, self._health.named())

    def _log(self) -> Iterator[Told]:
        """Yield the new entries of the event log."""
        entries = self._event_log.entries
        new = min(self._event_log.count - self._logged, len(entries))
        self._logged = self._event_log.count
        for entry in list(entries)[len(entries) - new :]:
            level = Log.WARNING if entry.bad else Log.INFO
            yield "/log", Log(timestamp=time(entry.at_ns), level=level, message=entry.words, name=entry.who)
