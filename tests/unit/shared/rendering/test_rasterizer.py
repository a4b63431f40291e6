"""The rasteriser: shapes, normals, occlusion, and equal depth with and without surfaces."""

import numpy as np
import pytest

from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, transform
from sextant.shared.rendering.meshes import box_faces
from sextant.shared.rendering.rasterizer import (
    BLOCK,
    Canvas,
    draw_capsules,
    draw_faces,
    draw_field,
    draw_plane,
    field_blocks,
    new_canvas,
)

LENS = (90.0, 90.0, 47.5, 31.5)
OPTICAL = transform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))


def capsule_surfaces(starts: Array, ends: Array, radii: Array) -> tuple[Array, Array, Array, Array]:
    """Draw tapered capsules; return the drawn points (n, 3), their normals, and the images.

    The images are the inverse depth and the material of all pixels.
    """
    canvas = new_canvas(120, 90, (150.0, 150.0, 59.5, 44.5))
    draw_capsules(canvas, np.eye(4), starts, ends, radii, np.ones(len(radii), dtype=np.uint16))
    v, u = np.nonzero(canvas.w)
    z = 1.0 / canvas.w[v, u].astype(float)
    return np.column_stack([(u - 59.5) / 150 * z, (v - 44.5) / 150 * z, z]), canvas.normal[v, u], canvas.w, canvas.material


@pytest.mark.parametrize("seed", range(4))
def test_tapered_capsule_is_convex_hull_of_its_end_spheres(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start, end = rng.uniform([-0.2, -0.15, 0.8], [0.2, 0.15, 1.2], (2, 3))
    radii = rng.uniform(0.01, 0.07, 2)
    points, normals, w, _ = capsule_surfaces(start[None], end[None], radii[None])
    s = np.linspace(0.0, 1.0, 2001)[:, None]
    centre, radius = start + s * (end - start), radii[0] + s[:, 0] * (radii[1] - radii[0])
    gap = np.linalg.norm(points[:, None] - centre, axis=2) - radius
    np.testing.assert_allclose(gap.min(axis=1), 0.0, atol=2e-5)
    outward = points - centre[gap.argmin(axis=1)]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert (np.einsum("ij,ij->i", outward, normals) > 0.99).all()
    # Every ray that meets one of the balls is drawn.
    v, u = np.mgrid[:90, :120]
    rays = np.stack([(u - 59.5) / 150, (v - 44.5) / 150, np.ones(u.shape)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    for k in range(0, 2001, 100):
        off = centre[k] - (rays @ centre[k])[..., None] * rays
        assert (w[np.linalg.norm(off, axis=-1) < radius[k] - 1e-6] > 0).all()


def test_faces_occlude_each_other_and_field_matches_heights() -> None:
    T = from_xyz_rpy((1.0, 0.5, 0.5), (0.0, 0.45, -2.68)) @ OPTICAL
    canvas = new_canvas(96, 64, (90.0, 90.0, 47.5, 31.5))
    square = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    lower, upper = 0.4 * square - [0.0, 0.0, 0.1], 0.1 * square + [0.0, 0.0, 0.1]
    draw_faces(canvas, inverse(T), np.array([lower, upper]), np.array([1, 2], dtype=np.uint16))
    field = new_canvas(96, 64, canvas.lens)
    heights = np.full((41, 41), -0.1)
    grid = np.array([-0.4, -0.4, 0.02])
    draw_field(field, inverse(T), heights, grid, field_blocks(heights, grid), 1)
    v, u = np.nonzero(canvas.material)
    z = 1.0 / canvas.w[v, u].astype(float)
    world = apply(T, np.column_stack([(u - 47.5) / 90 * z, (v - 31.5) / 90 * z, z]))
    np.testing.assert_allclose(world[:, 2], np.where(canvas.material[v, u] == 2, 0.1, -0.1), atol=1e-4)
    np.testing.assert_allclose(canvas.normal[v, u], np.tile([0.0, 0.0, 1.0], (len(u), 1)), atol=1e-6)
    below = (canvas.material == 1) & (field.material == 1)
    np.testing.assert_allclose(field.w[below], canvas.w[below], rtol=1e-4)
    draw_faces(canvas, inverse(T), upper[None, ::-1] + [0.0, 0.0, 0.05], np.array([3], dtype=np.uint16))
    assert not (canvas.material == 3).any()  # seen from behind


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
def test_capsule_whose_one_sphere_contains_the_other_is_that_sphere(ratio: float) -> None:
    place, radii = np.array([[0.02, 0.01, 1.0]]), np.array([[0.05, 0.05 * ratio]])
    near = place + np.array([0.001, 0.0, 0.0])
    largest = (place if ratio <= 1.0 else near)[0]
    points, normals, _, _ = capsule_surfaces(place, place if ratio == 1.0 else near, radii)
    outward = points - largest
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), radii.max(), atol=1e-6)
    np.testing.assert_allclose(normals, outward / radii.max(), atol=1e-4)


def draw_scene(canvas: Canvas) -> None:
    rng = np.random.default_rng(3)
    T = inverse(from_xyz_rpy((-0.6, 0.1, 0.4), (0.0, 0.6, 0.0)) @ OPTICAL)
    boxes = box_faces(rng.uniform(-0.3, 0.3, (8, 3)), rng.uniform(0.02, 0.1, (8, 3)), np.tile(np.eye(3), (8, 1, 1)))
    heights, grid = rng.uniform(0.0, 0.05, (40, 40)), np.array([-0.4, -0.4, 0.02])
    draw_plane(canvas, T, 0.0, 1)
    draw_faces(canvas, T, boxes.reshape(-1, 4, 3), np.full(48, 2, dtype=np.uint16))
    draw_field(canvas, T, heights, grid, field_blocks(heights, grid), 3)
    starts, ends = rng.uniform(-0.3, 0.3, (2, 12, 3))
    draw_capsules(canvas, T, starts, ends, rng.uniform(0.01, 0.04, (12, 2)), np.full(12, 4, dtype=np.uint16))


def test_depth_is_equal_with_and_without_surfaces() -> None:
    full, bare = new_canvas(96, 64, LENS), new_canvas(96, 64, LENS, surfaces=False)
    draw_scene(full)
    draw_scene(bare)
    assert full.w.tobytes() == bare.w.tobytes()
    assert set(np.unique(full.material[full.w > 0])) == {1, 2, 3, 4}
    np.testing.assert_allclose(np.linalg.norm(full.normal[full.w > 0], axis=1), 1.0, atol=1e-6)


def test_triangles_of_a_field_with_an_unknown_corner_are_not_drawn() -> None:
    down = inverse(from_xyz_rpy((0.0, 0.0, 1.0), (0.0, np.pi / 2, 0.0)) @ OPTICAL)
    heights, grid = np.zeros((5, 5)), np.array([-0.4, -0.4, 0.2])
    heights[2, 2] = np.nan
    canvas = new_canvas(96, 64, LENS)
    draw_field(canvas, down, heights, grid, field_blocks(heights, grid), 1)
    v, u = np.mgrid[:64, :96]
    x, y = (31.5 - v) / 90, (47.5 - u) / 90
    near = np.abs(x - y) < 0.19  # of the two triangles of a cell, the diagonal leaves one of each of two cells
    hole = (np.abs(x) < 0.19) & (np.abs(y) < 0.19) & near
    inside = (np.abs(x) < 0.35) & (np.abs(y) < 0.5)
    np.testing.assert_array_equal(canvas.w[inside & hole], 0.0)
    away = (np.abs(x) > 0.22) | (np.abs(y) > 0.22)
    np.testing.assert_allclose(canvas.w[(np.abs(x) < 0.35) & (np.abs(y) < 0.38) & away], 1.0)


def test_blocks_bound_their_heights_and_leave_out_unknown_ones() -> None:
    rng = np.random.default_rng(0)
    heights, grid = rng.normal(size=(2 * BLOCK + 5, BLOCK + 1)), np.array([1.0, -2.0, 0.1])
    heights[0, 0] = np.nan
    blocks = field_blocks(heights, grid)
    assert blocks[:, :2].tolist() == [[0, 0], [BLOCK, 0], [2 * BLOCK, 0]]
    for block in blocks:
        i = int(block[0])
        part = heights[i : i + BLOCK + 1]
        low, high = (
            [1.0 + 0.1 * i, -2.0, np.nanmin(part)],
            [1.0 + 0.1 * (i + len(part) - 1), -2.0 + 0.1 * BLOCK, np.nanmax(part)],
        )
        np.testing.assert_allclose(block[2:], [*low, *high])
    assert len(field_blocks(np.full((40, 40), np.nan), grid)) == 0
    assert len(field_blocks(np.zeros((0, 0)), grid)) == 0
