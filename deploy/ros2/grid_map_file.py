"""Export of a recording's map as a GridMap of ROS 2 in an MCAP file, which `ros2 bag play` and Foxglove open."""

from pathlib import Path
from typing import BinaryIO

from mcap.writer import Writer

from sextant.deploy.ros2 import converted
from sextant.deploy.ros2.message_types import definition, encode
from sextant.evaluation.viewers.file_export import MergedMap, merged_map
from sextant.shared.files import whole_files
from sextant.shared.recording.grid_map import TYPE

TOPIC = "/terrain"  # that of the bridge, with its default prefix


def export_grid_map(source: Path, target: Path) -> tuple[int, int]:
    """Write the merged maps of a recording as one message with the layer `elevation`.

    Returns:
        Number of cells along x and y.

    Raises:
        RecordingError: `source` is not a recording, or has no map.
        WriteError: The file cannot be written.
    """
    found = merged_map(source)
    with whole_files.replacing(target) as file:
        write_grid_map(file, found)
    return found.heights.shape


def write_grid_map(file: BinaryIO, found: MergedMap) -> None:
    """Write a map as a recording of ROS 2 with one message."""
    message = converted.grid_map_of({"elevation": found.heights}, found.origin, found.resolution, found.stamp_ns)
    writer = Writer(file)
    writer.start(profile="ros2", library="sextant")
    schema = writer.register_schema(TYPE, "ros2msg", definition(TYPE).encode())
    channel = writer.register_channel(TOPIC, "cdr", schema)
    writer.add_message(channel, found.stamp_ns, encode(TYPE, message), found.stamp_ns)
    writer.finish()  # type: ignore[no-untyped-call]
