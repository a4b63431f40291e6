import io
import re
from dataclasses import replace

import pytest

from sextant.deploy.terminal.progress import Lines, Terminal, progress_for
from sextant.evaluation.observers.monitor import View
from tests.support.screen import Screen


def test_plain_progress_shows_position_at_intervals_and_each_change_once() -> None:
    stream = io.StringIO()
    progress = progress_for(stream)
    assert isinstance(progress, Lines)
    for i in range(60):
        warnings = (f"mapper: no message for {i} s",) if i > 30 else ()
        doing = {
            "planner": f"stepping: {i} of 3, speed limited" if i < 30 else "blocked: no foothold",
            "mapper": f"mapping, {i} scans",
        }
        progress.update(View(time_s=i * 0.25, up=True, doing=doing, warnings=warnings))
    lines = stream.getvalue().splitlines()
    assert sum("to the goal" in line for line in lines) == 3
    assert sum("no message" in line for line in lines) == 1
    assert [line.split("  ")[-1] for line in lines if "planner" in line or "mapper: mapping" in line] == [
        "planner: stepping: 0 of 3, speed limited",
        "mapper: mapping, 0 scans",
        "planner: blocked: no foothold",
    ]
    assert "\x1b" not in stream.getvalue()


def test_plain_progress_of_an_unsteady_service_is_at_most_a_line_a_second() -> None:
    stream = io.StringIO()
    progress = Lines(stream)
    for i in range(400):
        progress.update(View(time_s=i * 0.025, up=True, doing={"planner": ("stepping", "waiting")[i % 2]}))
    assert 8 <= stream.getvalue().count("planner:") <= 11


def shown(view: View) -> list[str]:
    """Return the lines of the table on a terminal."""
    screen = Screen()
    Terminal(screen).update(view)
    return screen.lines()


RUNNING = View(
    time_s=1.0, up=True, walked=1.0, to_goal=1.0, doing={"mapper": "mapping", "planner": "stepping"}, warnings=("careful",)
)


def test_lines_say_each_quarter_of_the_compiled_functions() -> None:
    written = io.StringIO()
    lines = progress_for(written)
    for done in (0, 1, 13, 14, 26, 27, 54):
        lines.compiled(done, 0 if done == 0 else 54)
    first, *quarters = written.getvalue().splitlines()
    assert first == "compiling the inner loops; the first start takes half a minute"
    assert quarters == [f"compiled {done} of up to 54 functions" for done in (14, 27, 54)]


def test_progress_table_is_redrawn_below_messages() -> None:
    screen = Screen()
    terminal = progress_for(screen)
    assert isinstance(terminal, Terminal)
    terminal.compiled(31, 54)
    assert screen.lines() == ["compiling the inner loops: 31 of up to 54; the first start takes half a minute"]
    terminal.update(RUNNING)
    terminal.say("mapper ended [exit status 1]")
    terminal.update(replace(RUNNING, time_s=2.0))
    assert screen.lines()[-1].split() == ["warning", "careful"]
    terminal.update(replace(RUNNING, time_s=3.0, warnings=()))
    terminal.finish()
    terminal.say("done")
    lines = screen.lines()
    assert lines[0] == "mapper ended [exit status 1]"
    assert lines[1].strip().startswith("3.0 s")
    assert lines[3:] == ["  mapper   mapping", "  planner  stepping", "done"]
    assert screen.getvalue().endswith("done\n")
    assert screen.getvalue().rindex("\x1b[?25h") > screen.getvalue().rindex("\x1b[?25l"), "the cursor is visible again"


@pytest.mark.parametrize("columns", [40, 80, 160])
def test_progress_table_fits_the_terminal_and_100_columns(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    lines = shown(replace(RUNNING, doing={"planner": "stepping " * 30}, warnings=("careful " * 30,)))
    assert all(len(line) <= min(columns, 100) for line in lines)
    assert lines[2].endswith("…")
    assert "".join(lines).count("careful") == 30, "warnings are shown in full"


def test_progress_has_colours_unless_no_color_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    for colours in (True, False):
        screen = Screen()
        Terminal(screen).update(RUNNING)
        assert bool(re.search(r"\x1b\[3\dm", screen.getvalue())) == colours
        monkeypatch.setenv("NO_COLOR", "1")


def test_progress_on_a_dumb_terminal_is_plain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "dumb")
    assert isinstance(progress_for(Screen()), Lines)


def test_slow_simulated_time_is_shown() -> None:
    slow, real = (View(time_s=1.0, up=True, to_goal=1.0, of_real_time=share) for share in (0.4, 0.99))
    assert "at 0.40 of real time" in shown(slow)[0]
    assert "of real time" not in shown(real)[0]
    stream = io.StringIO()
    Lines(stream).update(slow)
    assert "at 0.40 of real time" in stream.getvalue()


def test_number_of_printed_warning_kinds_is_bounded() -> None:
    stream = io.StringIO()
    lines = Lines(stream)
    for k in range(1000):
        invented = "".join(chr(ord("a") + int(digit)) for digit in str(k))
        lines.update(View(time_s=1.0, warnings=(f"{invented} is late",)))
    assert stream.getvalue().count("is late") == 200


def test_table_waits_until_the_actuator_is_up() -> None:
    assert shown(View()) == ["waiting for the robot to start"]


def test_text_of_a_service_is_no_markup() -> None:
    assert shown(View(doing={"mapper": "[red]busy :smile:"}))[-1] == "  mapper  [red]busy :smile:"
