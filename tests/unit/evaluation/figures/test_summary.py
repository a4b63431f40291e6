import struct
from dataclasses import replace

import numpy as np
import pytest

from sextant.evaluation.figures import summary

_UNKNOWN = (0xE4, 0xE4, 0xE4)


def _pixels(path):
    cv2 = pytest.importorskip("cv2")
    return cv2.imread(str(path))[..., ::-1]


def _drawn(path, scorer):
    summary.draw(path, scorer.result(), scorer.trace)
    with path.open("rb") as file:
        header = file.read(24)
    width, height = struct.unpack(">II", header[16:24])
    assert width == 1600 >= height - 100
    return _pixels(path)


def _share(pixels, color, region=(slice(None), slice(None))):
    return np.mean(np.all(np.abs(pixels[region].astype(int) - color) < 12, axis=-1))


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Draw the picture of a good walk once."""
    folder = tmp_path_factory.mktemp("good")

    def pixels(story):
        path = folder / "summary.png"
        return _pixels(path) if path.exists() else _drawn(path, story(moved_leg=2).judged())

    return pixels


@pytest.mark.slow
def test_summary_title_is_green_on_success_and_red_on_failure(tmp_path, story, good):
    bad = _drawn(tmp_path / "bad.png", story(topple_s=4.0).judged())
    title = (slice(0, 80), slice(None))
    green, red = (0x1A, 0x7F, 0x37), (0xB3, 0x26, 0x1E)
    assert _share(good(story), green, title) > 0.005 > _share(good(story), red, title)
    assert _share(bad, red, title) > 0.005 > _share(bad, green, title)


@pytest.mark.slow
def test_summary_of_empty_run_shows_unknown_ground_and_long_reason(tmp_path, story, good):
    scorer = story().scorer()  # it received no message
    long = replace(scorer.result(), reason="no foothold for the left front leg, " * 20)
    summary.draw(tmp_path / "new" / "nothing.png", long, scorer.trace)
    nothing = _pixels(tmp_path / "new" / "nothing.png")
    top = (slice(250, 500), slice(90, 600))
    assert _share(nothing, _UNKNOWN, top) > 0.85 > 0.3 > _share(good(story), _UNKNOWN, top)
    assert np.all(nothing[:, -8:] == 255)


@pytest.mark.slow
def test_colored_map_is_shown_in_its_colors(tmp_path, story, good):
    scorer = story().judged()
    seen = np.isfinite(scorer.trace.mosaic.elevation)
    color = np.where(seen[..., None], np.array([40, 90, 200], dtype=np.uint8), np.uint8(0))
    summary.draw(tmp_path / "c.png", scorer.result(), replace(scorer.trace, mosaic=replace(scorer.trace.mosaic, color=color)))
    ground = (slice(120, 590), slice(90, 1400))
    assert _share(_pixels(tmp_path / "c.png"), (40, 90, 200), ground) > 0.1 > _share(good(story), (40, 90, 200), ground)
