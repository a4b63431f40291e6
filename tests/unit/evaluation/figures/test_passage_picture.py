import struct
from dataclasses import replace

import numpy as np
import pytest

from sextant.evaluation.figures import passage_picture
from sextant.evaluation.figures.passage_picture import stance_at_end
from sextant.evaluation.figures.summary import verdict
from sextant.evaluation.observers.run_observers import RunObservers
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.terrain import Pillars

PASSAGE = load_scenario("passage2")
PLANNED = (slice(150, 530), slice(120, 1430))  # area of the plans in the picture
BLUE, GOOD, ELSEWHERE = (0x1F, 0x5F, 0xD0), (0x3F, 0xA7, 0x96), (0xD3, 0xB4, 0x8A)


def _drawn(path, scorer, trace=None):
    passage_picture.draw(path, scorer.result(), trace or scorer.trace)
    with path.open("rb") as file:
        assert struct.unpack(">II", file.read(24)[16:24]) == (1600, 1500)
    return pytest.importorskip("cv2").imread(str(path))[..., ::-1]


def _share(pixels, color, region):
    return np.mean(np.all(np.abs(pixels[region].astype(int) - color) < 12, axis=-1))


@pytest.fixture(scope="module")
def drawn_crossing(tmp_path_factory):
    """Return a function that draws a crossing once, and returns its scorer and pixels."""
    folder = tmp_path_factory.mktemp("crossed")

    def picture(story):
        scorer = story(scenario=PASSAGE, level=True, stride=0.12, sections=3).judged()
        path = folder / "summary.png"
        return scorer, _drawn(path, scorer)

    return picture


@pytest.mark.slow
def test_picture_shows_footholds_plans_and_leg_colors(story, drawn_crossing):
    _, pixels = drawn_crossing(story)
    assert _share(pixels, GOOD, PLANNED) > 0.2
    assert _share(pixels, ELSEWHERE, PLANNED) > 0.04
    assert _share(pixels, BLUE, PLANNED) > 0.001
    for leg in ((0xD5, 0x5E, 0x00), (0x33, 0x22, 0x88)):
        assert _share(pixels, leg, PLANNED) > 2e-4
    assert np.all(pixels[:, -8:] == 255)


@pytest.mark.slow
def test_plans_are_shown_without_strip_map(tmp_path, story, drawn_crossing):
    scorer, _ = drawn_crossing(story)
    sections = tuple(replace(section, map=None) for section in scorer.trace.sections)
    pixels = _drawn(tmp_path / "p.png", scorer, replace(scorer.trace, sections=sections))
    assert _share(pixels, GOOD, PLANNED) < 1e-3 < _share(pixels, BLUE, PLANNED)


@pytest.mark.slow
def test_impassable_section_shows_reach_and_reason(tmp_path, story, drawn_crossing):
    none = _drawn(tmp_path / "none.png", story(scenario=PASSAGE, level=True, stride=0.12, sections=1, way=False).judged())
    words = (slice(1230, 1500), slice(80, 900))
    red = (0xB3, 0x26, 0x1E)
    _, some = drawn_crossing(story)
    assert _share(none, red, words) > 5e-4 > _share(some, red, words)
    # Half a metre ahead, across the strip: 0.35 + 0.5 m of 2.98 m, but dashed.
    column = 0.07 * 1600 + 0.86 * 1600 * 0.85 / (PASSAGE.goal.distance + 0.7)
    across = (PLANNED[0], slice(round(column) - 20, round(column) + 20))
    assert np.all(np.abs(none[across].astype(int) - BLUE) < 40, axis=-1).any(axis=1).mean() > 0.4


@pytest.mark.slow
def test_blocking_foothold_is_marked_with_grey_stance(tmp_path, story, drawn_crossing):
    scorer = story(scenario=PASSAGE, level=True, stride=0.12, sections=1, way=False).judged()
    (section,) = scorer.trace.sections
    none = _drawn(tmp_path / "none.png", scorer)
    bare = replace(section.plan, leg=section.plan.leg[:0], footholds=section.plan.footholds[:0], body=section.plan.body[:0])
    stays = _drawn(tmp_path / "stays.png", scorer, replace(scorer.trace, sections=(replace(section, plan=bare),)))
    scale = min(0.86 * 1600 / (PASSAGE.goal.distance + 0.7), 0.265 * 1500 / 0.9)  # [pixels/m]
    x, y = section.plan.failure_point[0, :2]
    place = (round(1500 * (1 - 0.627 - 0.1325) - scale * y), round(0.07 * 1600 + scale * (0.35 + x)))
    mark = tuple(slice(c - 9, c + 10) for c in place)
    red, grey = (0xB3, 0x26, 0x1E), (0x5F, 0x63, 0x68)
    some = drawn_crossing(story)[1]
    assert _share(none, red, mark) > 0.2 > _share(some, red, mark)
    assert _share(some, grey, PLANNED) < _share(stays, grey, PLANNED) < _share(none, grey, PLANNED)


@pytest.mark.slow
def test_failed_attempt_with_later_sections_is_not_marked(tmp_path, story, drawn_crossing):
    scorer, some = drawn_crossing(story)
    first, *others = scorer.trace.sections
    failed = replace(first, plan=replace(first.plan, state="no way", failure_point=first.plan.footholds[:1]))
    pixels = _drawn(tmp_path / "p.png", scorer, replace(scorer.trace, sections=(failed, *others)))
    red = (0xB3, 0x26, 0x1E)
    assert _share(pixels, red, PLANNED) <= _share(some, red, PLANNED) + 1e-4


@pytest.mark.slow
def test_weak_pillar_is_marked(tmp_path, story, drawn_crossing):
    shaky = replace(PASSAGE, terrain=tuple(replace(p, weak=1) if isinstance(p, Pillars) else p for p in PASSAGE.terrain))
    walked = (slice(630, 1010), slice(120, 1430))
    pixels = _drawn(tmp_path / "shaky.png", story(scenario=shaky, level=True, stride=0.12, sections=1).judged())
    firm, _ = drawn_crossing(story)
    red = (0xB3, 0x26, 0x1E)
    assert not len(firm.trace.weak)
    assert _share(pixels, red, walked) > _share(drawn_crossing(story)[1], red, walked) + 1e-3


@pytest.mark.slow
def test_section_end_stance_uses_last_foothold_of_each_leg(story, drawn_crossing):
    scorer, _ = drawn_crossing(story)
    section = scorer.trace.sections[0]
    feet = stance_at_end(section)
    for leg in range(6):
        steps = section.plan.footholds[section.plan.leg == leg]
        np.testing.assert_array_equal(feet[leg], steps[-1] if len(steps) else section.feet[leg])
    stays = replace(section.plan, leg=section.plan.leg[:1], footholds=section.plan.footholds[:1], body=section.plan.body[:1])
    feet = stance_at_end(replace(section, plan=stays))
    np.testing.assert_array_equal(feet[1:], section.feet[1:])
    leant = replace(stays, leg=np.array([6], dtype=np.uint8))
    np.testing.assert_array_equal(stance_at_end(replace(section, plan=leant)), section.feet)


@pytest.mark.slow
def test_passage_picture_is_written_only_for_run_with_sections(tmp_path, story, drawn_crossing, monkeypatch):
    drawn = []
    monkeypatch.setattr(passage_picture, "draw", lambda path, *_: drawn.append(path.name))
    for scenario, sections in ((PASSAGE, 3), (replace(PASSAGE, name="bare"), 0)):
        told = story(scenario=scenario, level=True, stride=0.12, sections=sections)
        attendance = RunObservers(told.profile, scenario, 0)
        attendance.scorer = told.judged()
        attendance.leave_behind(told.judged().result(), tmp_path / scenario.name)
        assert (tmp_path / scenario.name / "summary.png").exists()
    assert drawn == ["passage.png"]


def test_merged_strips_keep_forgotten_cells_and_update_sunk_ones(story):
    older = story(scenario=PASSAGE, level=True, stride=0.12).passage(0, 2)
    pillar, platform = (46, int(older.evaluation[46].argmin())), (15, 40)  # cells of one foothold on each
    assert older.evaluation[pillar] < -2 > older.evaluation[platform]
    forgotten, sunk = older.elevation.copy(), older.elevation.copy()
    forgotten[:10] = np.nan
    border = older.evaluation.copy()
    border[:16] = 3  # cells next to unknown ones are also next to vacant ones
    sunk[pillar[0] - 7 : pillar[0] + 8, pillar[1] - 5 : pillar[1] + 6] -= 0.06
    gone = older.evaluation.copy()
    gone[pillar] = 4
    ((_, cells),) = passage_picture._strips([older, replace(older, elevation=forgotten, evaluation=border)])
    np.testing.assert_array_equal(cells, older.evaluation)
    ((_, cells),) = passage_picture._strips([older, replace(older, elevation=sunk, evaluation=gone)])
    assert cells[pillar] == 4
    elsewhere = replace(older, origin=older.origin + 0.3)
    assert len(passage_picture._strips([older, elsewhere])) == 2


@pytest.mark.slow
def test_caption_counts_walked_steps_instead_of_requested_gait(story):
    scorer = story(scenario=PASSAGE, level=True, stride=0.12, sections=1).judged()
    step = replace(scorer.trace.plans[0][1], swing=np.eye(6, dtype=bool)[0])
    trace = replace(scorer.trace, plans=tuple((0.1 * k, step) for k in range(7)))
    words = [text for text, _, _ in verdict(scorer.result(), trace, None)]
    assert any("7 steps with 1 leg in swing" in line for line in words)
    assert not any("tripod" in line for line in words)
