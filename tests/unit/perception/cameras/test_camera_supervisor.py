"""Camera supervisor: a failed camera is named, closed and opened again.

The delay grows with each attempt, so that a dead camera causes no busy loop.
"""

from collections.abc import Iterator

import numpy as np
import pytest

from sextant.services.perception.cameras.camera import Camera, CameraError, Frame, RecordingOverError
from sextant.services.perception.cameras.camera_supervisor import LAST_RETRY_S, CameraSupervisor
from sextant.services.perception.cameras.image_quality import ImageQualityCheck


class ScriptedCamera(Camera):
    """A camera that returns scripted pictures, nothing, or errors."""

    description = "scripted camera"
    recorded = False

    def __init__(self, acts: Iterator[object]):
        self.acts, self.closed = acts, 0

    def read(self, color: bool) -> Frame | None:
        act = next(self.acts)
        if isinstance(act, Exception):
            raise act
        return act  # type: ignore[return-value]

    def close(self) -> None:
        self.closed += 1

    def __enter__(self):  # type: ignore[no-untyped-def]
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Rig:
    def __init__(self, kit, acts=None, opener=None) -> None:  # type: ignore[no-untyped-def]
        self.kit, self.opened = kit, []
        self.acts = acts

        def opens() -> ScriptedCamera:
            self.opened.append(kit.clock())
            if opener is not None:
                opener(len(self.opened))
            return ScriptedCamera(self.acts)

        watch = ImageQualityCheck(kit.profile.camera.sensor, (48, 64))
        self.keeper = CameraSupervisor("scripted", opens, watch, kit.clock)

    def pictures(self, make):  # type: ignore[no-untyped-def]
        """Yield endless pictures, each stamped with the current time."""
        k = 0
        while True:
            made = make(k)
            yield made if made is None or isinstance(made, Exception) else Frame(self.kit.clock(), made, None)
            k += 1

    def run(self, seconds: float) -> int:
        """Read thirty times a second; return the number of pictures."""
        handed = 0
        for _ in range(round(30 * seconds)):
            handed += self.keeper.read(False) is not None
            self.kit.clock.pass_s(1 / 30)
        return handed


def test_good_images_are_passed_on(kit) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(kit)
    rig.acts = rig.pictures(kit.ground)
    assert not rig.keeper.ok
    assert "no image yet" in rig.keeper.trouble
    assert rig.run(3.0) == 90
    assert rig.keeper.ok
    assert rig.keeper.trouble == ""
    assert len(rig.opened) == 1


def test_absent_camera_is_retried_with_growing_delay(kit) -> None:  # type: ignore[no-untyped-def]
    def absent(_: int) -> None:
        raise CameraError("no device found", "plug it in")

    rig = Rig(kit, opener=absent)
    assert rig.run(100.0) == 0
    waits = np.diff(rig.opened) * 1e-9
    assert (waits[:4] > 0.99 * np.array([1.0, 2.0, 4.0, 8.0])).all()
    assert waits.max() < 1.1 * LAST_RETRY_S
    assert rig.keeper.trouble == "no device found; plug it in"


def test_camera_is_opened_once_plugged_in(kit) -> None:  # type: ignore[no-untyped-def]
    def late(attempt: int) -> None:
        if attempt < 3:
            raise CameraError("no device found", "plug it in")

    rig = Rig(kit, opener=late)
    rig.acts = rig.pictures(kit.ground)
    assert rig.run(2.9) == 0
    assert rig.run(1.0) > 20
    assert rig.keeper.ok


def test_silent_camera_is_reported_and_reopened(kit) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(kit)
    rig.acts = rig.pictures(lambda k: kit.ground(k) if k < 60 or k > 120 else None)
    assert rig.run(2.0) == 60
    rig.run(1.5)
    assert not rig.keeper.ok
    assert "no new image for 1.0 s" in rig.keeper.trouble
    assert rig.run(6.0) > 60
    assert rig.keeper.ok
    assert len(rig.opened) == 2


def test_disconnected_camera_is_reported_and_reopened(kit) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(kit)
    rig.acts = rig.pictures(lambda k: CameraError("device disconnected", "plug it in") if k == 30 else kit.ground(k))
    rig.run(1.1)
    assert rig.keeper.trouble == "device disconnected; plug it in"
    assert rig.run(2.0) > 20
    assert rig.keeper.ok


def test_faulty_images_are_withheld_until_good_images_return(kit) -> None:  # type: ignore[no-untyped-def]
    frozen = kit.ground(1000)
    for bad, words in ((frozen, "frozen"), (np.zeros((24, 32), np.uint16), "48x64")):
        rig = Rig(kit)
        began_ns = kit.clock()

        def picture(k, bad=bad, began_ns=began_ns):  # type: ignore[no-untyped-def]
            return bad if 1.0 <= (kit.clock() - began_ns) * 1e-9 < 6.0 else kit.ground(k)

        rig.acts = rig.pictures(picture)
        assert rig.run(1.0) == 30
        assert rig.run(2.5) <= 65, "within the patience of the watch"
        assert words in rig.keeper.trouble
        assert rig.run(2.0) == 0, "it was opened again, and is no better"
        assert 1 < len(rig.opened) < 4
        assert rig.run(20.0) > 100, "it came back"
        assert rig.keeper.ok


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_nearly_blind_camera_is_withheld_but_stays_open(kit, share: float) -> None:  # type: ignore[no-untyped-def]
    """Check a picture of a wall nearer than the sensor's range."""
    rig = Rig(kit)

    def picture(k):  # type: ignore[no-untyped-def]
        made = kit.ground(k)
        if 30 <= k < 300:
            made[: round(48 * (1.0 - share))] = 0
        return made

    rig.acts = rig.pictures(picture)
    assert rig.run(1.0) == 30
    assert rig.run(2.2) <= 65, "within the patience of the watch"
    assert rig.run(6.5) == 0
    assert not rig.keeper.ok
    assert "within its range" in rig.keeper.trouble
    assert "nothing covers it" in rig.keeper.trouble
    assert rig.run(1.0) > 20, "it came back at once"
    assert rig.keeper.ok
    assert len(rig.opened) == 1


@pytest.mark.slow
def test_blind_camera_is_reopened_at_long_intervals(kit) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(kit)
    rig.acts = rig.pictures(lambda k: kit.ground(k) * np.uint16(k < 30))
    rig.run(25.0)
    assert len(rig.opened) == 2
    assert "nothing" in rig.keeper.trouble
    rig.run(600.0)
    assert 10 < len(rig.opened) < 30


def test_fault_is_reported_before_driver_is_closed(kit, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    rig, said = Rig(kit), []
    rig.acts = rig.pictures(lambda k: kit.ground(k) if k < 30 else None)
    monkeypatch.setattr(ScriptedCamera, "close", lambda _: said.append((rig.keeper.ok, rig.keeper.trouble)))
    rig.run(3.0)
    assert said
    assert not said[0][0]
    assert "no new image" in said[0][1]


@pytest.mark.parametrize("what", ["gap", "still", "blind"])
def test_faulty_recording_continues_without_reopening(kit, monkeypatch, what: str) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(ScriptedCamera, "recorded", True)
    rig = Rig(kit)
    faulty = {"gap": None, "still": kit.ground(0), "blind": np.zeros((48, 64), np.uint16)}[what]
    rig.acts = rig.pictures(lambda k: faulty if 60 <= k < 1000 else kit.ground(k))
    rig.run(30.0)
    assert not rig.keeper.ok
    assert "the recording contains it" in rig.keeper.trouble or what == "blind"
    rig.run(5.0)
    assert rig.keeper.ok
    assert len(rig.opened) == 1


def test_flapping_device_is_reopened_with_delay(kit) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(kit)
    rig.acts = rig.pictures(lambda k: CameraError("flaps", "mend it") if k % 10 == 9 else kit.ground(k))
    rig.run(60.0)
    assert len(rig.opened) < 10


def test_ended_recording_is_not_reopened(kit) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(kit)
    rig.acts = rig.pictures(lambda k: RecordingOverError("it is over", "loop") if k >= 5 else kit.ground(k))
    assert rig.run(60.0) == 5
    assert len(rig.opened) == 1
    assert "over" in rig.keeper.trouble


def test_device_with_constant_stamp_is_reported(kit) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(kit)
    stuck = (Frame(5, kit.ground(k), None) for k in range(1000))
    rig.acts = stuck
    assert rig.run(3.0) == 1
    assert "no new image" in rig.keeper.trouble


def test_out_of_order_image_is_dropped(kit) -> None:  # type: ignore[no-untyped-def]
    stamps = [5, 6, 6, 4, 7]
    rig = Rig(kit)
    rig.acts = iter([Frame(stamp, kit.ground(k), None) for k, stamp in enumerate(stamps)])
    handed = [rig.keeper.read(False) for _ in stamps]
    assert [f.stamp_ns for f in handed if f] == [5, 6, 7]
