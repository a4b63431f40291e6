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


def lamps(trust: TextureTrust, legs: list[float]) -> list[bool]:
    """Judge frames in which texture stays where the robot is, while the legs report positions."""
    used = []
    for x in legs:
        trust.begin_frame(at(x))
        used.append(trust.judge(at(0.0), tracks(at(0.0), 60, 60), at(0.0)[None]))
        trust.end_frame(at(x))
    return used


@pytest.mark.parametrize("frames", [40, 400])
def test_sway_earns_no_trust_and_no_tolerance_for_the_way_after_it(frames: int) -> None:
    trust = Walker().trust
    assert not any(lamps(trust, [0.004 * (-1) ** k for k in range(frames)]))
    assert not any(lamps(trust, [_STEP * k for k in range(60)]))


@pytest.mark.parametrize("drift", [0.01, 0.03])
def test_trust_stays_on_the_way_back_over_ground_seen_before(drift: float) -> None:
    trust, poses, last = TextureTrust(20, _PARAMS), np.array([at(0.1 * slot) for slot in range(20)]), at(0.0)
    steps = np.repeat([_STEP, -_STEP], 200)
    used, stored = [], 0
    for step, x in zip(steps, np.cumsum(steps), strict=True):
        prior, T = last.copy(), at(x)
        prior[:2, 3] += step, drift * _STEP
        trust.begin_frame(prior)
        if stored < 20 and x >= 0.1 * stored:
            trust.store(stored)
            stored += 1
        seen = replace(tracks(T, 60, 60), slots=np.full(60, min(int(x / 0.1), stored - 1)))
        used.append(trust.judge(T, seen, poses))
        last = T if used[-1] else prior
        trust.end_frame(last)
    assert all(used[50:])


def test_accumulated_turning_widens_the_turn_limit() -> None:
    walker = Walker()
    walker.walk(15)
    trust, here = walker.trust, walker.legs
    for turned in [*np.arange(0.0, 1.0, 0.05), *np.arange(1.0, 0.0, -0.05), 0.0]:
        trust.begin_frame(at(here, turned))
        trust.end_frame(at(here, turned))
    assert trust.judge(at(here, 0.2), tracks(at(here, 0.2), 60, 60), at(0.0)[None])
