"""Keeps one camera going: opens it, holds back what is of no use, lets it go when it fails, and tries again ever later."""

from collections.abc import Callable

from sextant.services.perception.cameras.camera import Camera, CameraError, Frame, RecordingOverError
from sextant.services.perception.cameras.image_quality import Watch

FIRST_RETRY_S, LAST_RETRY_S = 1.0, 16.0  # [s] between two attempts at the beginning, and at most
_FIRST_PICTURE_S = 4.0  # [s] that a device may take to send its first picture
_SETTLE_S = 2.0  # [s] after opening for which bad pictures are held back only: exposure and projector find their way
_SILENT_S = 1.0  # [s] without a picture after which a device is gone
_BLIND_S = 20.0  # [s] without a picture that shows anything after which a device that works by its looks is opened anew
_RELIABLE_S = 10.0  # [s] of good pictures after which a failure counts as the first


class Keeper:
    """A camera and what stands against it, in words; `ok` only while good pictures come."""

    def __init__(self, device: str, opener: Callable[[], Camera], watch: Watch, clock: Callable[[], int]):
        """Begin without a camera; the first `read` opens it.

        Args:
            device: Its name, for words.
            opener: Opens it.
            watch: Looks at its pictures. It remembers those before a failure: a device that comes back has to do better.
            clock: [ns] that `read` and the pictures go by.
        """
        self.about = device
        self.ok = False
        self.trouble = f"{device} has sent no picture yet"
        self.openings = 0
        self._opener, self._watch, self._clock = opener, watch, clock
        self._camera: Camera | None = None
        self._retry_s = FIRST_RETRY_S
        self._retry_ns = clock()  # when it is opened next
        self._opened_ns = 0
        self._useful_ns = 0  # when the last picture of use came, or the device was opened
        self._heard_ns = 0  # when the last new picture came
        self._patience_s = _FIRST_PICTURE_S
        self._good_since_ns = -1
        self._stamp_ns = -1
        self._over = False

    def read(self, color: bool) -> Frame | None:
        """The newest picture that is of use, or None; waits only for a device to open."""
        if self._camera is None and not self._open():
            return None
        assert self._camera is not None
        try:
            frame = self._camera.read(color)
        except CameraError as error:
            self._over = isinstance(error, RecordingOverError)
            self._lose(str(error))
            return None
        now_ns = self._clock()
        if frame is None or frame.stamp_ns <= self._stamp_ns:  # nothing, or one that was overtaken
            if now_ns - self._heard_ns > self._patience_s * 1e9:
                silent_s = (now_ns - self._heard_ns) * 1e-9
                self._fail(
                    f"{self._camera.about} has sent no new picture for {silent_s:.1f} s", "see that it is still plugged in"
                )
            return None
        self._heard_ns, self._patience_s = now_ns, _SILENT_S
        self._stamp_ns = frame.stamp_ns
        return self._judged(frame, now_ns)

    def close(self) -> None:
        """Let the camera go; safe to call twice."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _open(self) -> bool:
        if self._over or self._clock() < self._retry_ns:
            return False
        self.openings += 1
        try:
            self._camera = self._opener()
        except CameraError as error:
            self._lose(str(error))
            return False
        self.about = self._camera.about
        self._opened_ns = self._useful_ns = self._heard_ns = self._clock()
        self._patience_s = _FIRST_PICTURE_S
        return True

    def _judged(self, frame: Frame, now_ns: int) -> Frame | None:
        """The picture, if nothing speaks against it; a device is opened anew if it is broken, or sees nothing for long."""
        wrong = self._watch.look(frame.depth, frame.stamp_ns)
        if wrong:
            remedy = "see that nothing covers it or stands right before it" if self._watch.sound else "plug it in again"
            since_ns, patience_s = (self._useful_ns, _BLIND_S) if self._watch.sound else (self._opened_ns, _SETTLE_S)
            if now_ns - since_ns > patience_s * 1e9:
                self._fail(f"{self.about}: {wrong}", remedy)
            else:
                self._hold_back(f"{self.about}: {wrong}; {remedy}")
            return None
        self.ok, self.trouble, self._useful_ns = True, "", now_ns
        if self._good_since_ns < 0:
            self._good_since_ns = now_ns
        elif now_ns - self._good_since_ns > _RELIABLE_S * 1e9:
            self._retry_s = FIRST_RETRY_S
        return frame

    def _hold_back(self, trouble: str) -> None:
        """Say what is wrong, and go on."""
        self.ok, self.trouble, self._good_since_ns = False, trouble, -1

    def _fail(self, cause: str, remedy: str) -> None:
        """Say what is wrong; a device is opened anew, a recording goes on."""
        assert self._camera is not None
        if self._camera.recorded:
            self._hold_back(f"{cause}; it was recorded so")
        else:
            self._lose(f"{cause}; {remedy}")

    def _lose(self, trouble: str) -> None:
        """Let the camera go, say why, and try again later."""
        self._hold_back(trouble)  # before it closes, which may take a driver its time
        self.close()
        self._retry_ns = self._clock() + round(self._retry_s * 1e9)
        self._retry_s = min(2 * self._retry_s, LAST_RETRY_S)
