import numpy as np
import pytest

from sextant.evaluation.figures import walk_picture
from sextant.evaluation.figures.thesis_figures import TESTS, Measured, Published, side_by_side
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario


def test_thesis_scenarios_use_thesis_robot_stride_and_height():
    for name in TESTS:
        scenario = load_scenario(name)
        assert scenario.robot == "lotriet_rx64"
        assert scenario.walk.body_height == pytest.approx(0.09)
        step_s = load_profile(scenario.robot).stance.step_s
        assert 2 * scenario.walk.speed * step_s == pytest.approx(TESTS[name].stride_m, abs=1e-3)  # of two steps


def test_measured_walk_values_match_synthetic_walk(story):
    trace = story(sag=0.004, tilt_deg=1.0, bob=0.002, stride=0.06).judged().trace
    measured = Measured.of(trace)
    assert measured.height_error_m == pytest.approx(-0.004, abs=3e-4)
    assert measured.oscillation_m == pytest.approx(0.002, abs=2e-4)
    assert (measured.tilt_deg, measured.jumps_deg, measured.off_command_deg) == pytest.approx((1.0, 1.0, 1.0), abs=1e-6)
    assert measured.stride_m == pytest.approx(0.12, abs=1e-3)
    assert measured.step_height_m == pytest.approx(0.04, abs=2e-3)


def test_missing_thesis_values_are_dashes():
    measured = Measured(-0.001, 0.002, 0.3, 0.8, 0.2, 0.15, np.nan)
    rows = side_by_side(Published("8.9", height_error_m=-0.01, stride_m=0.15), measured)
    by_name = {name: (theirs, ours) for name, theirs, ours in rows}
    assert by_name["body height error, mean"] == ("-10 mm", "-1.00 mm")
    assert by_name["stride"] == ("15 cm", "15.00 cm")
    assert by_name["tilt, jumps"] == ("-", "0.80 deg")


@pytest.mark.slow
def test_walk_picture_of_thesis_test_includes_table(tmp_path, story, monkeypatch):
    cv2 = pytest.importorskip("cv2")
    scorer = story().judged()
    monkeypatch.setattr(walk_picture, "TESTS", {"story": Published("8.1", -0.010, 0.009, 0.5, 2.0, 0.15, 0.10)})
    assert walk_picture.draw(tmp_path / "walk.png", scorer.result(), scorer.trace)
    assert cv2.imread(str(tmp_path / "walk.png")).shape == (1720, 1600, 3)
