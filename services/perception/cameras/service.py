"""Camera service: publish images and the camera's state without blocking."""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Self

from sextant.services.perception.cameras.camera import Camera, Frame
from sextant.services.perception.cameras.camera_supervisor import CameraSupervisor
from sextant.services.perception.cameras.config import Settings
from sextant.services.perception.cameras.devices import EXTERNAL, open_camera
from sextant.services.perception.cameras.gray_image import NO_GRAY, gray_image
from sextant.services.perception.cameras.image_quality import ImageQualityCheck
from sextant.services.perception.imu.reading import BodyImu, ImuReading
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import CameraState, ColorImage, DepthImage, ExternalDepth, Message, Tick

_LOOKS = 4  # polls of the device per image period
_STATE_NS = 250_000_000  # [ns] between two state messages without a change
_MAX_READINGS = 400  # readings of the IMU that wait to be published: one second
_HUNG_NS = 5_000_000_000  # [ns] in one driver call, after which the driver is considered hung
_GIVE_UP_NS = 20_000_000_000  # [ns] after which the process ends, because only a new one can recover
_PAUSE_S = 0.002  # [s] between two polls of the thread


class CameraService:
    """Camera service that reads a device in a separate thread.

    Without `with`, no thread is started and the service reads in its own steps, for simulated time.
    """

    name = "camera"
    subscribes: tuple[AnyTopic, ...] = (topics.EXTERNAL_DEPTH,)
    publishes: tuple[AnyTopic, ...] = (topics.DEPTH, topics.COLOR, topics.CAMERA_STATE, topics.IMU)

    def __init__(
        self,
        profile: RobotProfile,
        settings: Settings,
        opener: Callable[[], Camera] | None,
        clock: Callable[[], int],
    ):
        """Create the service without an open camera; a missing one is only reported.

        Args:
            profile: Profile of the robot with its camera.
            settings: Settings of this service.
            opener: Opens a camera instead of the one named by settings or profile.
            clock: [ns] clock that stamps the images.
        """
        camera, device = profile.camera, settings.device or profile.camera.device
        i = camera.intrinsics
        self.trigger = Every.hz(_LOOKS * camera.sensor.rate_hz)
        self.stages = Stages()
        self._settings, self._clock = settings, clock
        self._external: deque[ExternalDepth] = deque(maxlen=1)  # newest frame of another program, until read
        if device != EXTERNAL:
            self.subscribes = ()
        opener = opener or (lambda: open_camera(device, profile, settings, clock, self._external))
        self._supervisor = CameraSupervisor(device, opener, ImageQualityCheck(camera.sensor, (i.height, i.width)), clock)
        self._color_due_ns = clock()
        self._color_wanted = False
        self._lens, self._sends_gray = i, camera.color and settings.gray
        self._state_due_ns = clock()
        self._told: tuple[bool, str] | None = None
        self._pictures = 0
        self._newest: deque[Frame] = deque(maxlen=1)  # from the thread, until published
        self._imu = BodyImu(camera.T_body_camera[:3, :3])
        self._readings: deque[ImuReading] = deque(maxlen=_MAX_READINGS)  # from the thread, until published
        self._called_ns = -1  # start of the thread's current driver call, or -1
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None

    def __enter__(self) -> Self:
        """Start reading in a thread, because opening a driver may take long."""
        self._thread = threading.Thread(target=self._read_on, name="camera", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(1.0)  # a hung driver is not waited for

    def status(self) -> str:
        """Return the status: the device and image count, or why no images arrive."""
        trouble = self._trouble()
        if trouble:
            return f"no images: {trouble}; opened {self._supervisor.openings} times so far"
        imu = f", {self._imu.messages} IMU messages" if self._imu.messages else ""
        problem = f"; {self._imu.problem}" if self._imu.problem else ""
        return f"{self._supervisor.description}, {self._pictures} images{imu}{problem}"

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Publish the newest images, and the state when it changes or is due."""
        if self._error is not None:
            raise self._error
        if self._called_ns >= 0 and self._clock() - self._called_ns > _GIVE_UP_NS:
            raise RuntimeError(f"{self._trouble()}; this process ends, so that a new process can open the camera")
        self._external.extend(inbox.drain(topics.EXTERNAL_DEPTH) if self.subscribes else ())
        self._color_wanted = tick.stamp_ns >= self._color_due_ns and inbox.wanted(topics.COLOR)
        frame = self._take()
        if frame is not None:
            self._pictures += 1
            yield DepthImage(frame.stamp_ns, frame.depth, gray_image(frame.rgb, self._lens) if self._sends_gray else NO_GRAY)
            if frame.rgb is not None and self._color_wanted and tick.stamp_ns >= self._color_due_ns:
                self._color_due_ns = tick.stamp_ns + round(1e9 / self._settings.color_rate_hz)
                yield ColorImage(frame.stamp_ns, frame.rgb)
        if self._thread is None:
            self._readings.extend(self._supervisor.read_imu())
        readings = [self._readings.popleft() for _ in range(len(self._readings))]
        yield from self._imu.update(readings)
        trouble = self._trouble()
        if tick.stamp_ns >= self._state_due_ns or (not trouble, trouble) != self._told:
            self._state_due_ns, self._told = tick.stamp_ns + _STATE_NS, (not trouble, trouble)
            yield CameraState(tick.stamp_ns, device=self._supervisor.description[:500], ok=not trouble, reason=trouble[:1000])

    def _take(self) -> Frame | None:
        if self._thread is None:
            return self._supervisor.read(self._color_wanted or self._sends_gray)
        return self._newest.popleft() if self._newest else None

    def _trouble(self) -> str:
        called_ns = self._called_ns
        if called_ns >= 0 and self._clock() - called_ns > _HUNG_NS:
            hung_s = (self._clock() - called_ns) * 1e-9
            return f"the driver of {self._supervisor.description} has not answered for {hung_s:.0f} s; plug the camera in again"
        return self._supervisor.trouble

    def _read_on(self) -> None:
        """Poll the device until stopped; runs in the thread."""
        try:
            while not self._stop.is_set():
                self._called_ns = self._clock()
                frame = self._supervisor.read(self._color_wanted or self._sends_gray)
                self._readings.extend(self._supervisor.read_imu())
                self._called_ns = -1
                if frame is not None:
                    self._newest.append(frame)
                self._stop.wait(_PAUSE_S)
            self._supervisor.close()
        except Exception as error:  # noqa: BLE001 - it is raised again by step, where it ends the process
            self._error = error
