"""A registration that trusts the legs: how far does a robot get without one?"""

from sextant.plugins import Frame, Pose, RobotProfile


class OdometryOnly:
    """Returns the pose that leg odometry expects."""

    def __init__(self, profile: RobotProfile):
        self.camera = profile.camera

    def register(self, frame: Frame) -> Pose:
        """Return the expected pose of a frame."""
        return Pose(frame.T_world_camera, frame.covariance)
