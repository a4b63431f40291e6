import numpy as np
import pytest

from sextant.evaluation.figures import walk_picture


@pytest.mark.slow
def test_walk_picture_is_drawn_only_for_walking_robot(tmp_path, story):
    cv2 = pytest.importorskip("cv2")
    scorer = story(tilt_deg=2.0).judged()
    assert walk_picture.draw(tmp_path / "walk.png", scorer.result(), scorer.trace)
    pixels = cv2.imread(str(tmp_path / "walk.png"))
    assert pixels.shape == (1500, 1600, 3)
    # Every leg's colour is there.
    for color in walk_picture.LEG_COLORS:
        bgr = np.array([int(color[k : k + 2], 16) for k in (5, 3, 1)])
        assert np.all(np.abs(pixels.astype(int) - bgr) < 12, axis=-1).sum() > 100, color
    silent = story().scorer()
    assert not walk_picture.draw(tmp_path / "none.png", silent.result(), silent.trace)
    assert not (tmp_path / "none.png").exists()


def test_trace_separates_foot_height_and_uncommanded_tilt(story):
    trace = story(tilt_deg=2.0).judged().trace
    walking = trace.walking
    np.testing.assert_allclose(np.degrees(trace.attitude[walking]), [[2.0, 0.0]] * walking.sum(), atol=1e-6)
    np.testing.assert_allclose(trace.attitude_reference[walking], 0.0, atol=1e-9)
    lowest = trace.feet[..., 2] - trace.profile.foot.radius - trace.ground
    assert lowest.min() > -1e-6
    assert lowest.max() > 0.03


def test_shown_leg_has_least_lateral_spread(story):
    trace = story(moved_leg=1).judged().trace
    shown = walk_picture.steadiest_leg(trace)
    spread = np.ptp(trace.feet[trace.walking, :, 1], axis=0)
    assert spread[shown] == spread.min()
    assert shown != 1
