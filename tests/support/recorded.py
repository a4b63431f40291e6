"""Messages of every type that a recording contains."""

import numpy as np

from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import (
    UNKNOWN,
    Message,
    ModeCommand,
    Scan,
    TerrainMap,
    VelocityCommand,
)

S = 1_000_000_000


def velocity(stamp_ns: int, rng: np.random.Generator) -> VelocityCommand:
    return VelocityCommand(stamp_ns, rng.normal(size=2), float(rng.normal()), 0.1, 0.04)


def some_messages(seed: int = 0, n: int = 40) -> list[tuple[AnyTopic, Message, int]]:
    """Return two messages per second, one of each topic."""
    rng = np.random.default_rng(seed)
    made: list[tuple[AnyTopic, Message, int]] = []
    for i in range(n):
        made.append((topics.VELOCITY, velocity(i * S, rng), i * S))
        made.append((topics.MODE, ModeCommand(i * S, "walk", i), i * S + 5))
    return made


def terrain(stamp_ns: int, shape: tuple[int, int] = (5, 4), colored: bool = False) -> TerrainMap:
    """Return a map of a slope; its first row is unknown."""
    rng = np.random.default_rng(stamp_ns)
    elevation = rng.uniform(-0.1, 0.3, shape).astype(np.float32)
    elevation[0] = np.nan
    evaluation = rng.integers(-5, 20, shape).astype(np.int8)
    evaluation[0] = UNKNOWN
    variance, score = np.full_like(elevation, 1e-4), np.abs(elevation) * 3
    color = rng.integers(0, 256, (*shape, 3)).astype(np.uint8)
    layers = (elevation, variance, score, np.zeros(shape, dtype=np.bool_), evaluation)
    origin = np.array([0.5, -1.0])
    return TerrainMap(stamp_ns, 0.01, origin, *layers, color) if colored else TerrainMap(stamp_ns, 0.01, origin, *layers)


def scan(stamp_ns: int, n: int = 50) -> Scan:
    rng = np.random.default_rng(stamp_ns)
    points = rng.integers(-900, 900, (n, 3)).astype(np.int16)
    count, spread = rng.integers(1, 255, n).astype(np.uint8), np.full(n, 2, np.uint8)
    return Scan(stamp_ns, np.array([1.0, 2.0, 0.1]), points, count, spread, np.array([0.1, 0.0, 0.2]), 1e-6 * np.eye(6))


def frames(messages: list[tuple[AnyTopic, Message, int]]) -> list[tuple[AnyTopic, bytes, int]]:
    return [(topic, codec.encode(message), at_ns) for topic, message, at_ns in messages]
