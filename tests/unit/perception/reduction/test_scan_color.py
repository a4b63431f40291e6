"""Colours of scan points, from the picture with the same stamp.

A point has the colour of its pixel, or none if another object hides it.
"""

import numpy as np

from sextant.services.perception.reduction.scan_color import KEPT, Coloring
from sextant.shared.color import NO_COLOR, codes, from_codes, ycocg_from_rgb
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.camera import Intrinsics
from sextant.shared.wire import codec
from sextant.shared.wire.messages import Scan

CAMERA = Intrinsics(160, 120, 146.0, 146.0, 79.5, 59.5)
SHAPE = CAMERA.height, CAMERA.width
T = from_xyz_rpy((0.3, -0.2, 0.4), (2.2, 0.1, -0.4))
WALL = np.full(SHAPE, 1000, dtype=np.uint16)  # 1 m away


def picture() -> np.ndarray:
    rgb = np.zeros((*SHAPE, 3), dtype=np.uint8)
    rgb[:, :80], rgb[:, 80:] = (200, 40, 40), (40, 60, 200)
    return rgb


def points(z: float = 1.0, n: int = 400) -> tuple[Array, Array]:
    """Return points [m] {world} at one depth, and flags of those on the left."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.45, 0.45, n) * z, rng.uniform(-0.35, 0.35, n) * z
    x[np.abs(x) < 0.03 * z] = 0.1 * z
    return apply(T, np.column_stack([x, y, np.full(n, z)])), x < 0


def test_points_have_color_of_their_pixel() -> None:
    coloring = Coloring(CAMERA, 1000.0)
    coloring.keep(7, WALL, T)
    p, left = points()
    color = from_codes(coloring.colors(p, 7, picture()))
    expected = ycocg_from_rgb(np.where(left[:, None], (200, 40, 40), (40, 60, 200)).astype(np.uint8))
    assert np.abs(color - expected).max() <= 5.0


def test_hidden_or_outside_points_have_no_color() -> None:
    coloring = Coloring(CAMERA, 1000.0)
    nearer = WALL.copy()
    nearer[:60] = 700  # a leg in front of the upper half
    nearer[:, :20] = 0  # no return
    coloring.keep(7, nearer, T)
    p, _ = points()
    p = np.vstack([p, apply(T, np.array([[5.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))])
    code = coloring.colors(p, 7, picture())
    in_camera = apply(np.linalg.inv(T), p)
    with np.errstate(divide="ignore"):
        v, u = 146.0 * in_camera[:, 1] / in_camera[:, 2] + 59.5, 146.0 * in_camera[:, 0] / in_camera[:, 2] + 79.5
    visible = (v > 60.5) & (v < 118) & (u > 20.5) & (u < 158) & (in_camera[:, 2] > 0)
    hidden = (v < 59.0) | (u < 19.0) | (u > 160) | (in_camera[:, 2] < 0)
    assert (code[visible, 0] != NO_COLOR).all()
    assert (code[hidden, 0] == NO_COLOR).all()


def test_color_image_is_used_once_and_only_with_matching_depth_stamp() -> None:
    coloring = Coloring(CAMERA, 1000.0)
    p, _ = points()
    assert len(coloring.colors(p, 7, picture())) == 0
    assert "no depth frame of the same stamp" in coloring.problem
    coloring.keep(7, WALL, T)
    assert len(coloring.colors(p, 7, picture())) == len(p)
    assert coloring.problem == ""
    assert len(coloring.colors(p, 7, picture())) == 0
    assert len(coloring.colors(p, 8, np.zeros((3, 3, 3), np.uint8))) == 0
    assert "a colour picture of (120, 160) expected" in coloring.problem
    for stamp in range(20, 21 + KEPT):
        coloring.keep(stamp, WALL, T)
    assert len(coloring.colors(p, 20, picture())) == 0, "forgotten"
    assert len(coloring.colors(p, 25, picture())) == len(p)


def test_full_colored_scan_of_rough_ground_fits_message_size() -> None:
    """Check 14 000 cells of blocks and gravel, each with a slightly different colour."""
    rng = np.random.default_rng(1)
    i, j = np.divmod(np.arange(14_000), 140)
    block = (i // 8, j // 8)
    height = rng.integers(-70, 70, (13, 18))[block] + rng.integers(-3, 4, len(i))
    within = np.clip(rng.normal(5.0, 1.0, (2, len(i))), 1, 9)
    mm = np.column_stack([10 * i + within[0], 10 * j + within[1], height])
    rgb = rng.integers(30, 220, (13, 18, 3))[block] + rng.normal(0.0, 8.0, (len(i), 1)) + rng.normal(0.0, 3.0, (len(i), 3))
    scan = Scan(
        stamp_ns=0,
        origin=np.zeros(3),
        points_mm=np.rint(mm).astype(np.int16),
        pixel_count=np.rint(rng.normal(15, 3, len(i))).astype(np.uint8),
        height_range_mm=rng.integers(0, 12, len(i)).astype(np.uint8),
        p_world_camera=np.zeros(3),
        pose_covariance=np.zeros((6, 6)),
        color=codes(ycocg_from_rgb(np.clip(rgb, 0, 255).astype(np.uint8))),
    )
    frame = codec.encode(scan)
    assert len(frame) <= 60_000
    np.testing.assert_array_equal(codec.decode(frame, Scan)[0].color, scan.color)
