"""Supervision of one camera: opening, withholding unusable images, and retries."""

from collections.abc import Callable, Sequence

from sextant.services.perception.cameras.camera import Camera, CameraError, Frame, RecordingOverError
from sextant.services.perception.cameras.image_quality import ImageQualityCheck
from sextant.services.perception.imu.reading import ImuReading

FIRST_RETRY_S, LAST_RETRY_S = 1.0, 16.0  # [s] shortest and longest interval between two attempts
_FIRST_IMAGE_S = 4.0  # [s] allowed for a device to send its first image
_SETTLE_S = 2.0  # [s] after opening in which bad images are only withheld, while exposure and projector settle
_SILENT_S = 1.0  # [s] without an image after which a device is considered lost
_BLIND_S = 20.0  # [s] without a useful image after which a seemingly working device is reopened
_RELIABLE_S = 10.0  # [s] of good images after which the retry interval is reset


class CameraSupervisor:
    """Camera with its fault as text; `ok` is True only while good images arrive."""

    def __init__(self, device: str, opener: Callable[[], Camera], watch: ImageQualityCheck, clock: Callable[[], int]):
        """Create a supervisor; the first `read` opens the camera.

        Args:
            device: Name for messages.
            opener: Function that opens the camera.
            watch: Image quality check. It keeps its state over a failure, so that a reopened device must deliver better
                images.
            clock: [ns] clock of the images.
        """
        self.description = device
        self.ok = False
        self.trouble = f"{device} has sent no image yet"
        self.openings = 0  # number of attempts to open the camera
        self._opener, self._quality_check, self._clock = opener, watch, clock
        self._camera: Camera | None = None
        self._retry_s = FIRST_RETRY_S
        self._retry_ns = clock()  # time of the next attempt to open
        self._opened_ns = 0  # time of the last opening
        self._useful_ns = 0  # time of the last useful image, or of opening
        self._heard_ns = 0  # time of the last new image
        self._patience_s = _FIRST_IMAGE_S  # time without an image after which the device counts as lost
        self._good_since_ns = -1  # start of the useful images, or -1 after a fault
        self._newest_stamp_ns = -1  # stamp of the newest image
        self._recording_ended = False

    def read(self, color: bool) -> Frame | None:
        """Return the newest useful image, or None; blocks only while a device opens."""
        if self._camera is None and not self._open():
            return None
        assert self._camera is not None
        try:
            frame = self._camera.read(color)
        except CameraError as error:
            self._recording_ended = isinstance(error, RecordingOverError)
            self._lose(str(error))
            return None
        now_ns = self._clock()
        if frame is None or frame.stamp_ns <= self._newest_stamp_ns:  # no image, or one out of order
            if now_ns - self._heard_ns > self._patience_s * 1e9:
                silent_s = (now_ns - self._heard_ns) * 1e-9
                self._fail(
                    f"{self._camera.description} has sent no new image for {silent_s:.1f} s",
                    "check that it is still plugged in",
                )
            return None
        self._heard_ns, self._patience_s = now_ns, _SILENT_S
        self._newest_stamp_ns = frame.stamp_ns
        return self._checked(frame, now_ns)

    def read_imu(self) -> Sequence[ImuReading]:
        """Return the new readings of the camera's IMU; none without one."""
        return () if self._camera is None else self._camera.read_imu()

    def close(self) -> None:
        """Close the camera; safe to call twice."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _open(self) -> bool:
        if self._recording_ended or self._clock() < self._retry_ns:
            return False
        self.openings += 1
        try:
            self._camera = self._opener()
        except CameraError as error:
            self._lose(str(error))
            return False
        self.description = self._camera.description
        self._opened_ns = self._useful_ns = self._heard_ns = self._clock()
        self._patience_s = _FIRST_IMAGE_S
        return True

    def _checked(self, frame: Frame, now_ns: int) -> Frame | None:
        """Return the image if it is useful, else None.

        A device is reopened if it is faulty, or if it shows nothing for long.
        """
        defect = self._quality_check.check(frame.depth, frame.stamp_ns)
        if defect:
            remedy = (
                "check that nothing covers it or is closer than its minimum range"
                if self._quality_check.sound
                else "plug it in again"
            )
            since_ns, patience_s = (self._useful_ns, _BLIND_S) if self._quality_check.sound else (self._opened_ns, _SETTLE_S)
            if now_ns - since_ns > patience_s * 1e9:
                self._fail(f"{self.description}: {defect}", remedy)
            else:
                self._hold_back(f"{self.description}: {defect}; {remedy}")
            return None
        self.ok, self.trouble, self._useful_ns = True, "", now_ns
        if self._good_since_ns < 0:
            self._good_since_ns = now_ns
        elif now_ns - self._good_since_ns > _RELIABLE_S * 1e9:
            self._retry_s = FIRST_RETRY_S
        return frame

    def _hold_back(self, trouble: str) -> None:
        """Report a fault and keep the camera open."""
        self.ok, self.trouble, self._good_since_ns = False, trouble, -1

    def _fail(self, cause: str, remedy: str) -> None:
        """Report a fault; reopen a device, but continue a recording."""
        assert self._camera is not None
        if self._camera.recorded:
            self._hold_back(f"{cause}; the recording contains it")
        else:
            self._lose(f"{cause}; {remedy}")

    def _lose(self, trouble: str) -> None:
        """Close the camera, report the fault, and retry later."""
        self._hold_back(trouble)  # first, because closing a driver may take long
        self.close()
        self._retry_ns = self._clock() + round(self._retry_s * 1e9)
        self._retry_s = min(2 * self._retry_s, LAST_RETRY_S)
