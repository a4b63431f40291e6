"""Each command of README.md exists and a test runs one like it.

This module fails for a command without a test.
"""

import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks import cli as benchmarks
from benchmarks.access import strangers
from benchmarks.faults import table as fault_table
from benchmarks.fuzz import table as fuzz_table
from benchmarks.robot import fleet, link
from sextant.deploy import cli
from sextant.deploy.campaign import passage_table, results_store
from sextant.deploy.campaign.campaign_table import WALKED, Campaign, markdown, of_runs

ROOT = Path(__file__).parents[1]
KEPT, BY_TOUCH = ROOT / "docs" / "campaign.jsonl", ROOT / "docs" / "by_touch.jsonl"
PASSAGES, DRAWN = ROOT / "docs" / "passages.jsonl", ROOT / "docs" / "passages_commit.jsonl"
TROUBLES = ROOT / "docs" / "troubles.jsonl"
KEPT_DRAWN = ROOT / "docs" / "campaign_commit.jsonl"  # with seeds from a commit's hash, as in DRAWN

# The commands behind each `make` target.
MAKE = {
    "demo": ("sextant demo",),
    "test": ("ruff check", "ruff format --check", "mypy", "lint-imports", "pytest"),
}
# The test that runs each `sextant` command; an option counts if it makes another way of running.
RUN_BY = {
    "demo": "tests/unit/deploy/test_cli.py::test_a_live_run_and_the_demo_end_as_the_walk_does",
    "demo gap": "tests/unit/deploy/test_cli.py::test_a_live_run_and_the_demo_end_as_the_walk_does",
    "run": "tests/live/test_live_walk.py::test_a_course_of_ones_own_is_walked_over_zenoh",
    "run --lockstep": "tests/walk/test_walks.py::test_over_low_blocks_and_two_stairs",
    "run --lockstep --bridge": "tests/walk/test_bridge.py::test_through_a_bridge_it_walks_as_on_the_bus_itself",
    "run --lockstep --gait": "tests/walk/test_gaits.py::test_the_slow_gaits_climb",
    "benchmarks link": "tests/live/test_link.py::test_a_robot_whose_radio_is_cut_holds_and_walks_on_by_itself",
    "run --connect": "tests/live/test_live_walk.py::test_services_that_are_up_walk_for_whoever_joins_them",
    "trials": "tests/walk/test_walks.py::test_trials_of_several_seeds_at_a_time",
    "trials --blind": "tests/unit/deploy/test_cli.py::test_trials_tell_the_rate_and_the_baseline_beside_it",
    "trials all --blind": "tests/unit/deploy/test_cli.py::test_trials_of_all_terrains_print_one_table",
    "trials table": "tests/unit/deploy/test_cli.py::test_trials_of_all_terrains_print_one_table",
    "trials passages": "tests/unit/deploy/test_cli.py::test_trials_of_all_passages_print_their_table_and_the_thesis_one",
    "trials troubles": "tests/unit/deploy/test_cli.py::test_trials_troubles_tells_of_every_trouble_on_every_terrain",
    "replay": "tests/walk/test_replay.py::test_the_command_replays_a_folder_and_prints_json",
    "replay FILE": "tests/unit/deploy/replay/test_replay.py::test_the_command_replays_a_recording_or_the_folder_that_holds_it",
    "record": "tests/live/test_recording.py::test_what_is_said_is_recorded_until_the_recorder_is_killed",
    "video": "tests/unit/deploy/test_video.py::test_the_command_draws_a_run_and_says_what_came_of_it",
    "recording info": "tests/unit/shared/recording/test_recovery.py::test_the_command_says_what_is_in_a_file",
    "recording recover": "tests/unit/shared/recording/test_recovery.py::"
    "test_the_command_leaves_the_old_file_and_says_what_was_lost",
    "topics foxglove": "tests/unit/deploy/test_viewers.py::"
    "test_foxglove_is_told_of_each_channel_and_gets_what_it_subscribes_to",
    "recording export": "tests/unit/deploy/test_viewers.py::test_a_recording_is_written_for_rerun",
    "plot": "tests/unit/deploy/figures/test_run_figures.py::test_the_command_draws_what_is_asked_for_and_compares",
    "up --camera": "tests/live/test_camera.py::test_the_side_of_the_robot_sends_pictures_and_says_when_it_has_none",
    "up --connect": "tests/live/test_live_walk.py::test_two_machines_walk_together_whichever_is_there_first",
    "up": "tests/live/test_live_walk.py::test_services_that_are_up_walk_for_whoever_joins_them",
    "fleet": "tests/live/test_fleet.py::test_what_fails_of_one_robot_holds_no_other_up",
    "benchmarks fleet": "tests/live/test_fleet.py::test_a_base_is_loaded_with_a_recorded_robot",
    "order": "tests/live/test_live_walk.py::test_services_that_are_up_walk_for_whoever_joins_them",
    "topics list": "tests/unit/deploy/test_cli.py::test_topics_are_listed",
    "topics ros2": "tests/unit/deploy/ros2/test_bridge.py::test_the_command_says_what_it_offers_and_ends_at_ctrl_c",
    "topics docs": "tests/unit/deploy/topics/test_keys_page.py::test_the_page_is_the_one_that_the_command_makes",
    "topics echo": "tests/unit/deploy/topics/test_passive_subscriber.py::test_echo_prints_as_many_messages_as_are_asked_for",
    "topics hz": "tests/unit/deploy/topics/test_passive_subscriber.py::test_hz_measures_and_prints_totals",
    "benchmarks accuracy": "tests/unit/benchmarks/test_bench.py::test_the_accuracy_command_leaves_its_tables",
    "benchmarks speed": "tests/unit/benchmarks/test_bench.py::test_the_speed_command_leaves_its_timings",
    "benchmarks passage": "tests/unit/benchmarks/test_bench.py::test_the_passage_command_leaves_its_table",
    "benchmarks stages": "tests/unit/benchmarks/test_bench.py::test_the_stages_command_leaves_timings_and_a_picture",
    "service compose": "tests/unit/deploy/test_cli.py::test_compose_prints_the_committed_file",
    "service install": "tests/unit/deploy/launch/test_units.py::test_the_command_writes_prints_what_is_next_and_removes",
    "benchmarks faults": "tests/walk/test_faults_command.py::test_faults_are_injected_held_to_their_limits_and_not_done_again",
    "benchmarks fuzz": "tests/unit/benchmarks/test_fuzz.py::test_the_command_says_what_it_found_and_gives_a_message_again",
    "benchmarks faults --live": "tests/live/test_live_faults.py::"
    "test_an_actuator_that_is_killed_in_mid_walk_is_back_and_holds_without_a_jump",
    "benchmarks bus": "tests/unit/benchmarks/test_bench_bus.py::test_the_bus_command_leaves_its_table",
    "benchmarks start": "tests/unit/benchmarks/test_bench_start.py::test_the_start_command_leaves_its_figures",
    "benchmarks strangers": "tests/live/test_strangers.py::test_a_base_and_an_actuator_are_let_in_among_strangers",
    "benchmarks roles": "tests/unit/benchmarks/test_role_attack.py::test_the_roles_command_leaves_its_table",
    "benchmarks access": "tests/live/test_access.py::test_the_access_command_leaves_its_table",
    "keys new": "tests/unit/deploy/security/test_router_security.py::"
    "test_new_keys_are_for_their_owner_alone_and_are_not_overwritten",
    "benchmarks servos": "tests/unit/benchmarks/test_bench_servos.py::test_the_servos_command_leaves_its_figures",
    "servos set-id": "tests/test_commissioning.py::test_the_tutorial_runs_as_it_is_written",
    "servos emulate": "tests/test_commissioning.py::test_the_tutorial_runs_as_it_is_written",
    "doctor": "tests/unit/deploy/test_cli.py::test_the_doctor_fails_when_a_check_does",
}
SHELL = ("source .venv/bin/activate",)  # of the shell itself


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of each command in the fenced `sh` blocks, without comments."""
    for block in re.findall(r"^```sh\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words and " ".join(words) not in SHELL:
                yield words


def way_of_running(words: list[str]) -> str:
    """Return the key in RUN_BY of a `sextant` command."""
    pairs = (["trials", "all"], ["trials", "passages"], ["trials", "troubles"], ["trials", "table"], ["demo", "gap"])
    groups = ("topics", "benchmarks", "servos", "keys", "recording", "service")
    group = words[:2] if words[0] in groups or words[:2] in pairs else words[:1]
    ways = [
        word for word in words if word in ("--lockstep", "--connect", "--blind", "--camera", "--gait", "--bridge", "--live")
    ]
    files = ["FILE"] if words[-1].endswith(".mcap") else []
    return " ".join(group + files + ways)


README = list(commands((ROOT / "README.md").read_text(encoding="utf-8")))


def test_the_readme_shows_its_two_commands_first() -> None:
    assert README[:2] == [["make", "demo"], ["make", "test"]]


@pytest.mark.parametrize("words", README, ids=" ".join)
def test_a_command_of_the_readme_is_run_by_a_test(words: list[str]) -> None:
    match words:
        case ["make", target]:
            made = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=True).stdout
            assert target in MAKE, f"no test knows `make {target}`"
            assert all(part in made for part in MAKE[target]), made
        case ["sextant", *rest]:
            assert callable(cli.parse(rest).command)
            assert way_of_running(rest) in RUN_BY, f"no test runs `{' '.join(words)}`"
        case ["python", "-m", "benchmarks", *rest]:
            assert callable(benchmarks.parse(rest).command)
            assert way_of_running(["benchmarks", *rest]) in RUN_BY, f"no test runs `{' '.join(words)}`"
        case _:
            pytest.fail(f"no test runs `{' '.join(words)}`")


@pytest.mark.parametrize("test", sorted(set(RUN_BY.values())))
def test_a_test_that_runs_a_command_exists(test: str) -> None:
    file, _, name = test.partition("::")
    assert re.search(rf"^def {name}\(", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), f"{test} is not there"


def test_scenarios_named_in_the_readme_come_with_sextant() -> None:
    from sextant.shared.scenario.scenario import load_scenario

    for words in README:
        if words[:2] in (["sextant", "run"], ["sextant", "trials"]) and words[2] not in (
            "all",
            "passages",
            "troubles",
            "table",
        ):
            assert load_scenario(words[2]).name == words[2]


def rows(text: str) -> list[str]:
    return re.findall(r"^\|.*\|$", text, re.MULTILINE)


def test_the_table_of_the_readme_is_the_one_that_a_command_prints() -> None:
    printed = rows(markdown(of_runs(results_store.read(KEPT)), "reached"))
    crossed = rows(markdown(of_runs(results_store.read(PASSAGES)), "reached"))[2:]
    assert rows((ROOT / "README.md").read_text(encoding="utf-8")) == printed + crossed
    assert [row.split(" | ")[0] for row in printed[2:]] == [f"| `{name}`: {words}" for name, words in WALKED.items()]


@pytest.mark.parametrize("table", ["walks", "reached", "maps"])
def test_the_tables_of_the_results_are_those_that_a_command_prints(table: str) -> None:
    text = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    printed = markdown(of_runs(results_store.read(KEPT)), table)
    assert "\n".join(rows(printed)) in text
    if table == "walks":
        for words in printed.splitlines():
            assert words in text


@pytest.mark.parametrize("file", [BY_TOUCH, KEPT_DRAWN, TROUBLES])
def test_the_tables_of_walks_by_touch_in_trouble_and_on_drawn_seeds_are_those_that_a_command_prints(file: Path) -> None:
    text = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert markdown(of_runs(results_store.read(file)), "walks").strip() in text


def test_the_tables_of_the_passages_are_those_that_a_command_prints() -> None:
    text, runs = (ROOT / "docs" / "results.md").read_text(encoding="utf-8"), results_store.read(PASSAGES)
    drawn = markdown(of_runs(results_store.read(DRAWN)), "passages")
    for printed in (markdown(of_runs(runs), "passages"), passage_table.markdown(runs), drawn):
        for words in printed.splitlines():
            assert words in text


def test_the_table_of_the_cuts_is_that_which_the_command_prints() -> None:
    text = (ROOT / "docs" / "two_machines.md").read_text(encoding="utf-8")
    printed = link.cuts_in_words(link.cuts_from_json((ROOT / "docs" / "cuts.json").read_text(encoding="utf-8")))
    assert printed in text, "python -m benchmarks link prints another table"


def test_the_table_of_the_walks_over_radios_is_that_which_the_command_prints() -> None:
    text = (ROOT / "docs" / "two_machines.md").read_text(encoding="utf-8")
    printed = link.walks_in_words(link.walks_from_json((ROOT / "docs" / "link_walks.json").read_text(encoding="utf-8")))
    assert printed in text, "python -m benchmarks link prints another table"


def test_the_table_of_strangers_is_that_which_the_command_prints() -> None:
    text = (ROOT / "docs" / "access.md").read_text(encoding="utf-8")
    found = strangers.from_json((ROOT / "docs" / "strangers.json").read_text(encoding="utf-8"))
    assert strangers.in_words(found) in text, "python -m benchmarks strangers prints another table"
    assert len(found.back_s) == 100
    assert found.late == 0


def test_the_table_of_the_fleet_is_that_which_the_command_prints() -> None:
    text = (ROOT / "docs" / "fleet.md").read_text(encoding="utf-8")
    printed = fleet.in_words(fleet.from_json((ROOT / "docs" / "fleet.json").read_text(encoding="utf-8")))
    assert printed in text, "python -m benchmarks fleet prints another table"


def test_the_table_of_broken_messages_is_that_which_the_command_prints() -> None:
    text = (ROOT / "docs" / "fuzz.md").read_text(encoding="utf-8")
    printed = fuzz_table.markdown(fuzz_table.from_json((ROOT / "docs" / "fuzz.json").read_text(encoding="utf-8")))
    assert printed in text, "python -m benchmarks fuzz prints another table"


@pytest.mark.parametrize("name", ["faults", "faults_live"])
def test_the_tables_of_the_faults_are_those_that_the_command_prints(name: str) -> None:
    text = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
    printed = fault_table.markdown(fault_table.from_json((ROOT / "docs" / f"{name}.json").read_text(encoding="utf-8")))
    for words in printed.splitlines():
        assert words in text


def test_the_table_of_missteps_has_the_headings_that_a_command_prints() -> None:
    text = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert markdown(Campaign((), ()), "missteps").splitlines()[0] in text
