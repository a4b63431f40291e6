"""Export of a recording to the rerun viewer.

It shows the robot on its map, its scans and plans, and its measurements over time. rerun also opens a recording directly, but
shows only its frames, points and log.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from sextant.evaluation.figures.terrain_mesh import terrain_mesh
from sextant.evaluation.observers.progress import Progress
from sextant.shared.files import whole_files
from sextant.shared.recording.event_log import EventLog
from sextant.shared.recording.reader import Recording
from sextant.shared.robot.kinematics import leg_points
from sextant.shared.robot.profile import JOINTS, LEGS, RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ActuatorState, BodyPose, PlannerStatus, Preview, Scan, StepPlan, TerrainMap

_SHOW_MESSAGES = 5000
_MAP_NS = 1_000_000_000  # [ns] between two maps
_SCAN_NS = 200_000_000  # [ns] between two scans
_CARRIES, _IN_AIR, _STANDS = (50, 190, 90), (240, 165, 40), (150, 150, 150)


def export(source: Path, target: Path, progress: Progress) -> int:
    """Write a recording for rerun; return the number of drawn messages.

    Raises:
        RecordingError: `source` is not a recording, or has another version.
        WriteError: `target` cannot be written.
    """
    drawn = 0

    def write(path: Path) -> None:
        nonlocal drawn
        drawn = _write(source, path, progress)

    whole_files.write_by_name(target, write)
    return drawn


def _write(source: Path, target: Path, progress: Progress) -> int:
    recording = Recording(source)
    export: _Export | None = None
    drawn = 0
    stream = rr.RecordingStream("sextant")
    stream.save(target)
    for heard, (topic, message, at_ns) in enumerate(recording.messages(), start=1):
        if export is None:  # the robot's profile is known from here on
            export = _Export(stream, load_profile(recording.about.get("robot", "phantomx_mk2")))
        drawn += export.take(topic, message, at_ns)
        if heard % _SHOW_MESSAGES == 0:
            progress.say(f"{heard} messages read")
    stream.flush()
    stream.disconnect()
    return drawn


class _Export:
    """Follows a recording and draws it."""

    def __init__(self, stream: rr.RecordingStream, profile: RobotProfile):
        self._stream, self._profile = stream, profile
        self._T_world_odom = np.eye(4)
        self._due_ns: dict[str, int] = {}
        self._event_log = EventLog()
        self._logged = 0
        self._way: list[NDArray[np.float64]] = []
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._takes: Mapping[AnyTopic, Callable[[Any, int], None]] = {
            topics.ACTUATOR_STATE: self._legs,
            topics.BODY_POSE: self._pose,
            topics.TERRAIN: self._map,
            topics.SCAN: self._scan,
            topics.STEP_PLAN: self._plan,
            topics.PLANNER_STATUS: self._planner,
            topics.PREVIEW: self._picture,
        }

    def take(self, topic: AnyTopic, message: Any, at_ns: int) -> bool:
        """Draw a message; return whether it contains anything to draw."""
        if topic not in self._takes:
            return False
        self._stream.set_time("robot_time", duration=at_ns * 1e-9)
        self._takes[topic](message, at_ns)
        self._log()
        return True

    def _due(self, what: str, at_ns: int, apart_ns: int) -> bool:
        if at_ns < self._due_ns.get(what, at_ns):
            return False
        self._due_ns[what] = at_ns + apart_ns
        return True

    def _legs(self, state: ActuatorState, at_ns: int) -> None:
        self._event_log.legs(at_ns, state)
        T_world_body = self._T_world_odom @ state.T_odom_body
        self._stream.log("world/body", rr.Transform3D(translation=T_world_body[:3, 3], mat3x3=T_world_body[:3, :3]))
        self._stream.log(
            "world/body/box", rr.Boxes3D(sizes=[self._profile.body.size], colors=[(70, 80, 95)], fill_mode="solid")
        )
        legs = leg_points(self._profile, state.q)
        self._stream.log("world/body/legs", rr.LineStrips3D(list(legs), radii=0.006, colors=[(220, 222, 228)]))
        colors = [_CARRIES if on else _IN_AIR if up else _STANDS for on, up in zip(state.contact, state.swing, strict=True)]
        self._stream.log("world/body/feet", rr.Points3D(legs[:, 3], radii=self._profile.foot.radius, colors=colors))
        if self._due("way", at_ns, _SCAN_NS):
            self._way.append(T_world_body[:3, 3])
        if self._due("path", at_ns, _MAP_NS):
            self._stream.log("world/path", rr.LineStrips3D([np.array(self._way)], radii=0.003, colors=[(240, 240, 240)]))
        numbers = {"height": T_world_body[2, 3], "voltage": state.voltage, "temperature": state.temperature, "slip": state.slip}
        for name, value in numbers.items():
            self._stream.log(f"numbers/{name}", rr.Scalars(float(value)))
        for leg, angles, torques in zip(LEGS, state.q, state.load_nm, strict=True):
            for joint, q, torque in zip(JOINTS, angles, torques, strict=True):
                name = f"joints/{leg.replace(' ', '_')}/{joint}"
                self._stream.log(f"{name}/angle", rr.Scalars(float(q)))
                self._stream.log(f"{name}/torque", rr.Scalars(float(torque)))

    def _pose(self, pose: BodyPose, at_ns: int) -> None:
        self._T_world_odom = pose.T_world_odom
        self._event_log.perception(at_ns, pose)

    def _map(self, terrain: TerrainMap, at_ns: int) -> None:
        if self._due("map", at_ns, _MAP_NS):
            points, triangles, colors = terrain_mesh(terrain)
            drawn = rr.Mesh3D(vertex_positions=points, triangle_indices=triangles, vertex_colors=colors)
            self._stream.log("world/map", drawn)

    def _scan(self, scan: Scan, at_ns: int) -> None:
        if self._due("scan", at_ns, _SCAN_NS):
            self._stream.log("world/scan", rr.Points3D(scan.points, radii=0.003, colors=[(250, 210, 60)]))

    def _plan(self, plan: StepPlan, _: int) -> None:
        feet = plan.touchdown[plan.swing]
        self._stream.log("world/footholds", rr.Points3D(feet, radii=0.012, colors=[(60, 140, 255)]))

    def _planner(self, status: PlannerStatus, at_ns: int) -> None:
        self._event_log.planner(at_ns, status)

    def _picture(self, picture: Preview, _: int) -> None:
        for name, jpeg in (("depth", picture.depth_jpeg), ("color", picture.color_jpeg)):
            if jpeg.size:
                self._stream.log(f"camera/{name}", rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg"))

    def _log(self) -> None:
        """Log the new entries of the diary."""
        entries = list(self._event_log.entries)
        new = min(self._event_log.count - self._logged, len(entries))
        self._logged = self._event_log.count
        for entry in entries[len(entries) - new :]:
            self._stream.log(f"log/{entry.who}", rr.TextLog(entry.words, level="WARN" if entry.bad else "INFO"))
