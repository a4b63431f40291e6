"""Grid maps of ROS 2, written by another library: every cell comes back at its position."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from sextant.deploy.ros2 import message_types as ros
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.files.config import ConfigError
from sextant.shared.recording.grid_map import TYPE, read_grid_map
from sextant.shared.recording.layout import RecordingError
from sextant.shared.scenario.loading import load_scenario

RESOLUTION = 0.25
POSITION = np.array([1.5, -2.0])  # [m] centre of the map
SHAPE = (4, 3)


def value_at(x, y):
    """Return what the map holds at a position."""
    return 10.0 * x + y


def matrix():
    """Return the values as grid_map's documentation has them: index (0, 0) lies at the largest x and y, rows go along x."""
    corner = POSITION + 0.5 * RESOLUTION * np.array(SHAPE)
    i, j = np.indices(SHAPE)
    return value_at(corner[0] - RESOLUTION * (i + 0.5), corner[1] - RESOLUTION * (j + 0.5)).astype(np.float32)


def array(values, order="F"):
    names, sizes = ("column_index", "row_index"), values.shape[::-1]
    if order == "C":
        names, sizes = names[::-1], sizes[::-1]
    strides = (values.size, sizes[1])
    dims = [ros.MultiArrayDimension(*dim) for dim in zip(names, sizes, strides, strict=True)]
    return ros.Float32MultiArray(ros.MultiArrayLayout(dims, data_offset=0), values.ravel(order=order))


def grid_map(layers=None, start=(0, 0), order="F", **changed):
    layers = {"variance": 0.0 * matrix(), "elevation": matrix()} if layers is None else layers
    info = {
        "resolution": RESOLUTION,
        "length_x": RESOLUTION * SHAPE[0],
        "length_y": RESOLUTION * SHAPE[1],
        "pose": ros.Pose(ros.Point(*POSITION, 0.3), ros.Quaternion(0.0, 0.0, 0.0, 1.0)),
    } | changed
    return ros.GridMap(
        header=ros.Header(ros.Time(1, 2), "map"),
        info=ros.GridMapInfo(**info),
        layers=list(layers),
        basic_layers=["elevation"],
        data=[array(np.roll(values, start, axis=(0, 1)), order) for values in layers.values()],
        outer_start_index=start[0],
        inner_start_index=start[1],
    )


def recorded(folder: Path, *messages, topic="/terrain", little_endian=True) -> Path:
    """Write messages as `ros2 bag record` does; return the MCAP file."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        add(writer, topic, messages, little_endian)
    (file,) = folder.glob("*.mcap")
    return file


def add(writer, topic, messages, little_endian=True):
    channel = writer.add_connection(topic, TYPE, typestore=ros._STORE)
    for k, message in enumerate(messages):
        data = (
            message
            if isinstance(message, bytes)
            else bytes(ros._STORE.serialize_cdr(message, TYPE, little_endian=little_endian))
        )
        writer.write(channel, 1_000_000_000 * (k + 1), data)


@pytest.mark.parametrize("start", [(0, 0), (3, 0), (1, 2)])
@pytest.mark.parametrize("order", ["F", "C"])
@pytest.mark.parametrize("little_endian", [True, False])
def test_every_cell_comes_back_at_its_position(tmp_path, start, order, little_endian):
    found = read_grid_map(
        recorded(tmp_path / "bag", grid_map(start=start, order=order), little_endian=little_endian), "elevation"
    )
    assert (found.resolution, found.frame, found.values.shape) == (RESOLUTION, "map", SHAPE)
    for (i, j), value in np.ndenumerate(found.values):
        assert value == pytest.approx(value_at(*(found.origin + RESOLUTION * np.array([i, j]))))


def test_newest_map_and_named_topic_are_taken(tmp_path):
    old, new = grid_map({"elevation": 0.0 * matrix()}), grid_map({"elevation": matrix()})
    file = recorded(tmp_path / "one", old, new)
    assert read_grid_map(file, "elevation").values.max() == matrix().max()
    with Writer(tmp_path / "two", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        add(writer, "/a", [old])
        add(writer, "/b", [new])
    (file,) = (tmp_path / "two").glob("*.mcap")
    assert read_grid_map(file, "elevation", "/a").values.max() == 0.0
    with pytest.raises(RecordingError, match="a topic expected, because there are several grid maps, on /a, /b"):
        read_grid_map(file, "elevation")
    with pytest.raises(RecordingError, match="a grid map on /c expected, found some on /a, /b"):
        read_grid_map(file, "elevation", "/c")


TURNED = ros.Pose(ros.Point(0.0, 0.0, 0.0), ros.Quaternion(0.0, 0.0, 0.7071, 0.7071))
WRONG = {
    "layer": (grid_map({"elevations": matrix()}), "a layer elevation expected, found elevations; did you mean 'elevations'"),
    "resolution": (
        grid_map(resolution=float("nan")),
        "a resolution of 0.001 to 10 m and a finite position expected, found nan m",
    ),
    "lengths": (grid_map(length_y=3.0), "the lengths of 4 x 3 cells of 0.25 m expected, found 1 x 3 m"),
    "orientation": (grid_map(pose=TURNED), "a grid map along the axes of map expected, found one with orientation"),
    "start": (grid_map(), "start indices within 4 x 3 cells expected, found"),
    "cut": (b"\0\1\0\0" + b"\1\0\0\0", "a complete grid_map_msgs/msg/GridMap expected, found one cut off"),
    "encoding": (b"\0\3\0\0", "a message in plain CDR expected, found 00 03 00 00"),
    "empty": (grid_map({"elevation": np.zeros((0, 0), np.float32)}), "0 x 0 values of a layer expected, found 0"),
}
WRONG["start"][0].outer_start_index = 9


@pytest.mark.parametrize("case", WRONG)
def test_invalid_grid_map_is_refused_in_one_sentence(tmp_path, case):
    message, said = WRONG[case]
    with pytest.raises(RecordingError) as refused:
        read_grid_map(recorded(tmp_path / "bag", message), "elevation")
    assert f"/terrain: {said}" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_every_truncation_and_flipped_byte_is_refused_or_read(tmp_path):
    data = bytearray(bytes(ros._STORE.serialize_cdr(grid_map(), TYPE)))
    damaged = [bytes(data[:k]) for k in range(0, len(data), 7)]
    for k in range(len(data)):
        other = bytearray(data)
        other[k] ^= 0xFF
        damaged.append(bytes(other))
    path = tmp_path / "x.mcap"
    from sextant.shared.recording import grid_map as reader

    for one in damaged:
        try:
            assert reader._decode(one, "elevation").values.shape == SHAPE
        except reader._InvalidError:
            continue
    with pytest.raises(RecordingError, match=r"x\.mcap: No such file"):
        read_grid_map(path, "elevation")


def course(folder: Path, file: Path, more="") -> str:
    toml = folder / "course.toml"
    head = 'name = "mapped"\n[goal]\ndistance = 0.1\n[[terrain]]\nkind = "height_map"\n'
    toml.write_text(f'{head}file = "{file.relative_to(folder)}"\n{more}')
    return str(toml)


def test_grid_map_is_ground_of_a_scenario_where_its_frame_has_it(tmp_path):
    values = matrix()
    values[0, 0] = np.nan
    file = recorded(tmp_path / "bag", grid_map({"ground": values}))
    ground = build_terrain(load_scenario(course(tmp_path, file, 'layer = "ground"\nscale = 0.1\n')), np.random.default_rng(0))
    xy = POSITION + RESOLUTION * np.array([[-1.5, -1.0], [0.5, 0.0]])
    np.testing.assert_allclose(ground.height_at(xy), 0.1 * value_at(*xy.T), atol=1e-6)
    field = ground.height_field
    assert field.heights[-1, -1] == np.nanmin(0.1 * values.astype(np.float64))  # unknown ground is the lowest


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ('layer = "elevatoin"\n', "did you mean 'elevation'?"),
        ("rows = [0, 2]\n", "xy of the cropped or rotated map expected, found none"),
        ('topic = "/other"\n', "a grid map on /other expected, found some on /terrain"),
    ],
)
def test_wrong_scenario_of_a_grid_map_is_refused(tmp_path, more, said):
    file = recorded(tmp_path / "bag", grid_map())
    with pytest.raises(ConfigError) as refused:
        build_terrain(load_scenario(course(tmp_path, file, more)), np.random.default_rng(0))
    assert said in str(refused.value)


def test_height_map_of_numbers_needs_resolution_and_place(tmp_path):
    np.save(tmp_path / "map.npy", np.zeros((3, 3)))
    with pytest.raises(ConfigError, match="resolution of the map expected, found none"):
        load_scenario(course(tmp_path, tmp_path / "map.npy"))
    with pytest.raises(ConfigError, match="xy of the map expected, found none"):
        load_scenario(course(tmp_path, tmp_path / "map.npy", "resolution = 0.1\n"))
