"""Plug-ins for tests."""

import numpy as np

from sextant.plugins import ElevationMap, Frame, NoPose, NoStep, Pose, RobotProfile, Step, StepRequest

not_callable = 3


def all_good(ground: ElevationMap):
    return np.zeros(ground.elevation.shape)


def wrong_shape(ground: ElevationMap):
    return np.zeros(3)


def failing(ground: ElevationMap):
    return helper()


def helper():
    raise KeyError("a name")


class Weighted:
    """A rule that needs the robot."""

    def __init__(self, profile: RobotProfile):
        self.profile = profile

    def __call__(self, ground: ElevationMap):
        return np.full(ground.elevation.shape, ground.foot_radius / self.profile.foot.radius)


class StandStill:
    """Lifts one leg on the spot."""

    def __init__(self, profile: RobotProfile):
        self.requests = []

    def plan(self, request: StepRequest) -> Step:
        self.requests.append(request)
        swing = np.arange(6) == 2
        touchdown = np.where(swing[:, None], request.feet, np.nan)
        return Step(swing, touchdown, request.T_world_body, np.full(6, 0.03), 1.0)


class Idle:
    def __init__(self, profile: RobotProfile):
        pass

    def plan(self, request: StepRequest) -> NoStep:
        return NoStep("it rests on Sundays", 3)


class Shifted:
    """Moves the expected pose by a millimetre."""

    def __init__(self, profile: RobotProfile):
        self.frames = []

    def register(self, frame: Frame) -> Pose:
        self.frames.append(frame)
        T = frame.T_world_camera.copy()
        T[0, 3] += 1e-3
        return Pose(T, frame.covariance, 0.5)


class Lost:
    def __init__(self, profile: RobotProfile):
        pass

    def register(self, frame: Frame) -> NoPose:
        return NoPose("fog")


def broken_maker(profile: RobotProfile):
    raise OSError("no licence")


class BrokenAtFrame:
    def __init__(self, profile: RobotProfile):
        pass

    def register(self, frame: Frame) -> Pose:
        raise RuntimeError("no licence")


class LegsAlone:
    """Takes the pose that leg odometry expects."""

    def __init__(self, profile: RobotProfile):
        pass

    def register(self, frame: Frame) -> Pose:
        return Pose(frame.T_world_camera, frame.covariance)
