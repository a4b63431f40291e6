import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sextant.evaluation.figures.terrain_mesh import terrain_mesh
from sextant.shared.wire.messages import TerrainMap
from tests.support.recorded import terrain


@given(seed=st.integers(0, 500), nx=st.integers(2, 9), ny=st.integers(2, 9))
def test_mesh_has_vertex_per_known_cell_and_upward_faces(seed: int, nx: int, ny: int) -> None:
    map_: TerrainMap = terrain(seed, (nx, ny))
    points, triangles, colors = terrain_mesh(map_)
    where = np.argwhere(np.isfinite(map_.elevation))
    assert np.allclose(points[:, :2], map_.origin + map_.resolution * where, atol=1e-6)
    assert np.allclose(points[:, 2], map_.elevation[tuple(where.T)])
    assert len(colors) == len(points)
    assert len(triangles) == 2 * (nx - 2) * (ny - 1), "none reaches into the first row, which is unknown"
    a, b, c = points[triangles].transpose(1, 0, 2)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_mesh_colors_good_ground_green_and_bad_ground_red() -> None:
    map_ = terrain(1, (4, 4))
    _, _, colors = terrain_mesh(map_)
    score = map_.score[np.isfinite(map_.elevation)]
    assert colors[np.argmin(score)][1] > colors[np.argmin(score)][0] or score.min() > 0.5
    assert colors[np.argmax(score)][0] >= colors[np.argmin(score)][0]
