"""Recorder of a simulated depth camera and its true poses, in TUM RGB-D layout.

`sextant recording replay` reads this layout.
"""

from collections import deque
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.services.perception import tum
from sextant.shared.files.whole_files import WriteError
from sextant.shared.geometry import Array, interpolate
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import DepthImage, GroundTruth

_DOWN = np.array([0.0, 0.0, -1.0])  # gravity in the simulator's world


class DepthRecorder:
    """Writes depth.txt, groundtruth.txt and camera.toml from a run's frames.

    A context manager; `tap` receives the frames. A picture is written once the truth around it is known. Pictures after the
    last truth are written without a pose.
    """

    def __init__(self, folder: Path, profile: RobotProfile):
        """Start a recording.

        Args:
            folder: Made if missing; must not hold a recording already.
            profile: The robot, for its camera.

        Raises:
            FileExistsError: The folder holds a recording.
        """
        camera, sensor = profile.camera, profile.camera.sensor
        self._T_body_camera = camera.T_body_camera
        described = tum.Camera(
            camera.intrinsics, sensor.depth_scale, sensor.rate_hz, _DOWN, min_range=sensor.min_range, max_range=sensor.max_range
        )
        self._writer = tum.RecordingWriter(folder, described)
        self._waiting: deque[tuple[int, NDArray[np.uint16]]] = deque()  # pictures newer than the truth
        self._truth: tuple[int, Array] | None = None  # stamp, T_world_body

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def tap(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Process one frame of the run; only depth and truth are used.

        Raises:
            WriteError: It cannot be written; the recording has ended.
        """
        try:
            self._take(topic, frame)
        except WriteError:
            self._waiting.clear()
            raise

    def _take(self, topic: AnyTopic, frame: bytes) -> None:
        if topic is topics.DEPTH:
            image = codec.decode(frame, DepthImage, topics.DEPTH.max_bytes)[0]
            self._waiting.append((image.stamp_ns, image.depth))
        elif topic is topics.TRUTH:
            truth = codec.decode(frame, GroundTruth, topics.TRUTH.max_bytes)[0]
            self._pose_waiting(truth.stamp_ns, truth.T_world_body)

    def close(self) -> None:
        """Write the waiting pictures; safe to call twice.

        Raises:
            WriteError: They cannot be written.
        """
        while self._waiting:
            self._writer.add(*self._waiting.popleft())

    def _pose_waiting(self, stamp_ns: int, T_world_body: Array) -> None:
        """Write the pictures up to a truth message, with interpolated poses."""
        before_ns, T_before = self._truth or (stamp_ns, T_world_body)
        self._truth = stamp_ns, T_world_body
        while self._waiting and self._waiting[0][0] <= stamp_ns:
            taken_ns, depth = self._waiting.popleft()
            if taken_ns < before_ns:  # before the first truth
                self._writer.add(taken_ns, depth)
                continue
            share = (taken_ns - before_ns) / (stamp_ns - before_ns) if stamp_ns > before_ns else 1.0
            self._writer.add(taken_ns, depth, interpolate(T_before, T_world_body, share) @ self._T_body_camera)


def record_tum(scenario: Scenario, seed: int, folder: Path, duration_s: float) -> None:
    """Walk a scenario in lockstep and record its depth camera.

    Args:
        scenario: The course and how to walk it.
        seed: Random seed of the run.
        folder: Made if missing; must not hold a recording already.
        duration_s: [s] simulated.

    Raises:
        FileExistsError: The folder holds a recording.
    """
    profile = load_profile(scenario.robot)
    with DepthRecorder(folder, profile) as recorder:
        LockstepRun(scenario, seed, profile, recorder.tap).run(round(duration_s * 1e9))
