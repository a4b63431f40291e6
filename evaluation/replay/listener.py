"""Listener for the outputs of perception and mapper: poses, map and passage map."""

from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import BodyPose, PassageMap, TerrainMap


class Listener:
    """Stores the evaluated outputs of a run; `tap` receives the frames."""

    def __init__(self) -> None:
        self.poses: list[BodyPose] = []  # all, in the order of sending
        self.terrain: TerrainMap | None = None  # the newest
        self.passage: PassageMap | None = None  # the newest

    def tap(self, topic: AnyTopic, frame: bytes, _at_ns: int) -> None:
        """Process one frame."""
        if topic is topics.BODY_POSE:
            self.poses.append(codec.decode(frame, BodyPose)[0])
        elif topic is topics.TERRAIN:
            self.terrain = codec.decode(frame, TerrainMap)[0]
        elif topic is topics.PASSAGE:
            self.passage = codec.decode(frame, PassageMap)[0]
