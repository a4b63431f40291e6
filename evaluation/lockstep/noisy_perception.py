"""Perception with the pose errors of a recorded SLAM system, for simulated runs.

For live runs: `python -m sextant.evaluation.lockstep.noisy_perception`.
"""

from dataclasses import dataclass, fields
from typing import Literal

from sextant.evaluation.lockstep.pose_error import MODELS, NoisyPerception
from sextant.services.perception.config import Settings as PerceptionSettings
from sextant.services.perception.service import Perception
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime import process


@dataclass(frozen=True, slots=True)
class Settings(PerceptionSettings):
    """Settings of perception, and the pose error model."""

    pose_error: Literal["rgbdslam", "orb_slam"] = "orb_slam"
    seed: int = 0


def make(profile: RobotProfile, settings: Settings) -> NoisyPerception:
    """Create a perception with pose errors."""
    own = {f.name: getattr(settings, f.name) for f in fields(PerceptionSettings)}
    return NoisyPerception(Perception(profile, PerceptionSettings(**own)), MODELS[settings.pose_error], settings.seed)


if __name__ == "__main__":
    process.main("perception", Settings, make)
