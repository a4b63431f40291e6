"""When texture is believed: after it has agreed with the legs, and as long as it does."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.perception.registration.params import TextureParams
from sextant.services.perception.registration.texture_tracking import Tracks
from sextant.services.perception.registration.texture_trust import TextureTrust
from sextant.shared.geometry import Array, from_xyz_rpy

_PARAMS = replace(TextureParams(), probation=0.1)
_STEP = 0.01  # [m] of the legs per frame


def at(x: float, yaw: float = 0.0) -> Array:
    """Return the pose of a camera that looks straight down."""
    return np.asarray(from_xyz_rpy((x, 0.0, 0.3), (np.pi, 0.0, yaw)))


class Walker:
    """A robot whose legs report steps of 1 cm."""

    def __init__(self, params: TextureParams = _PARAMS):
        self.trust, self.last = TextureTrust(4, params), at(0.0)
        self.trust.begin_frame(self.last)
        self.trust.store(0)
        self.trust.end_frame(self.last)
        self.legs = 0.0

    def walk(self, frames: int, share: float = 1.0, yaw: float = 0.0, seen: int = 60, expected: int = 60) -> bool:
        """Judge frames in which texture shows a share of the legs' way; the pose is that of the legs."""
        for _ in range(frames):
            self.legs += _STEP
            prior = at(self.legs)
            self.trust.begin_frame(prior)
            T = at(share * self.legs, yaw)
            used = self.trust.judge(T, tracks(T, seen, expected), at(0.0)[None])
            self.trust.end_frame(prior)
        return used


def tracks(T: Array, seen: int, expected: int) -> Tracks:
    points = np.random.default_rng(1).uniform((-0.3, -0.3, 0.0), (0.3, 0.3, 0.0), (seen, 3))
    camera = (points - T[:3, 3]) @ T[:3, :3]
    pixels = camera[:, :2] / camera[:, 2:]
    return Tracks(points, pixels, np.ones((seen, 3)), np.zeros(seen, np.int64), expected, 0.003)


def test_texture_is_trusted_after_some_way() -> None:
    walker = Walker()
    assert not walker.walk(5)
    assert walker.walk(10)
    assert walker.trust.given


@pytest.mark.parametrize("share", [0.0, 0.06, 0.5, 1.6])
def test_texture_that_moves_unlike_the_legs_is_never_trusted(share: float) -> None:
    walker = Walker()
    assert not any(walker.walk(1, share) for _ in range(30))


def test_trusted_texture_shows_slip_and_a_larger_one_ends_the_trust() -> None:
    walker = Walker()
    walker.walk(15)
    assert walker.walk(1, share=0.85)
    assert not walker.walk(1, share=0.4)
    assert not walker.trust.given
    assert not walker.walk(1)


def test_a_turn_that_the_legs_did_not_make_ends_the_trust() -> None:
    walker = Walker()
    walker.walk(15)
    assert walker.walk(1, yaw=0.05)
    assert not walker.walk(1, yaw=0.2)


@pytest.mark.parametrize(("seen", "expected"), [(_PARAMS.min_tracks - 1, 30), (40, 400)])
def test_too_few_points_are_not_used_and_end_the_trust_after_some_frames(seen: int, expected: int) -> None:
    walker = Walker()
    walker.walk(15)
    assert not walker.walk(1, seen=seen, expected=expected)
    assert walker.walk(1)
    assert not walker.walk(_PARAMS.patience + 1, seen=seen, expected=expected)
    assert not walker.trust.given


def test_standing_earns_no_trust() -> None:
    walker = Walker()
    for _ in range(100):
        walker.legs -= _STEP
        assert not walker.walk(1)
