"""Each command of README.md and of the guides exists, and a test runs one like it.

This module fails for a command without a test.
"""

import itertools
import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks import cli as benchmarks
from benchmarks.access import strangers
from sextant.deploy import cli
from sextant.deploy.terminal.arguments import parse
from sextant.evaluation.trials.campaign_table import GROUPS, WALKED, Campaign, markdown

ROOT = Path(__file__).parents[1]

# The commands behind each `make` target.
MAKE = {
    "demo": ("sextant demo",),
    "docs": ("sphinx --quiet --fail-on-warning",),
    "campaign": ("python -m benchmarks campaign --run",),
    "test": ("ruff check", "ruff format --check", "mypy", "lint-imports", "pytest"),
}
# The test that runs each `sextant` command; an option counts if it makes another way of running.
RUN_BY = {
    "demo": "tests/unit/deploy/test_cli.py::test_live_run_and_demo_exit_codes_follow_walk_outcome",
    "demo gap": "tests/unit/deploy/test_cli.py::test_live_run_and_demo_exit_codes_follow_walk_outcome",
    "run": "tests/live/test_live_walk.py::test_parallel_runs_are_isolated_and_leave_no_orphans",
    "run --lockstep": "tests/walk/test_walks.py::test_walk_over_low_blocks_and_two_stairs",
    "run --lockstep --bridge": "tests/walk/test_bridge.py::test_walk_through_mcu_bridge_matches_walk_on_bus",
    "run --lockstep --gait": "tests/walk/test_gaits.py::test_ripple_gait_climbs_two_stairs",
    "camera calibrate": "tests/walk/test_calibration.py::test_command_calibrates_a_simulated_robot_into_its_own_file",
    "benchmarks calibration": "tests/walk/test_calibration.py::test_command_calibrates_a_simulated_robot_into_its_own_file",
    "benchmarks naming": "tests/walk/test_naming.py::test_horn_that_is_off_is_named_and_nothing_else",
    "benchmarks link": "tests/live/test_link.py::test_robot_holds_during_radio_outage_and_resumes",
    "run --lockstep --set": "tests/unit/evaluation/test_params.py::test_run_reports_parameters_of_its_command",
    "run --lockstep --foothold": "tests/walk/test_plugins.py::test_example_plugins_walk_to_the_goal",
    "run --connect": "tests/live/test_live_walk.py::test_attached_run_walks_with_running_services",
    "trials": "tests/walk/test_walks.py::test_trials_command_runs_seeds_in_parallel",
    "trials --foothold": "tests/walk/test_tutorials.py::test_course_and_rule_of_tutorials_walk",
    "trials --set": "tests/walk/test_tutorials.py::test_course_and_rule_of_tutorials_walk",
    "trials --gait": "tests/unit/deploy/test_cli.py::test_robot_and_walk_options_override_scenario",
    "trials --blind": "tests/unit/deploy/test_cli.py::test_trials_report_success_rate_and_blind_baseline",
    "trials --cluster": "tests/unit/evaluation/trials/test_cluster.py::test_trials_command_runs_on_a_cluster",
    "trials all --cluster": "tests/unit/evaluation/trials/test_cluster.py::test_campaign_on_a_cluster_survives_a_killed_worker",
    "trials --curve": "tests/unit/evaluation/trials/test_curve.py::test_curve_command_writes_curve_and_pictures",
    "trials all --blind": "tests/unit/deploy/test_cli.py::test_trials_of_all_terrains_print_one_table",
    "trials table": "tests/unit/deploy/test_cli.py::test_trials_of_all_terrains_print_one_table",
    "trials passages": "tests/unit/deploy/test_cli.py::test_trials_of_all_passages_print_passage_and_thesis_tables",
    "trials troubles": "tests/unit/deploy/test_cli.py::test_trials_troubles_table_covers_each_trouble_and_terrain",
    "trials usual": "tests/unit/deploy/test_cli.py::test_trials_of_a_level_walk_every_terrain_with_its_deviations",
    "recording replay": "tests/walk/test_replay.py::test_replay_command_matches_ground_truth_and_prints_json",
    "recording replay FILE": "tests/unit/evaluation/replay/test_replay.py::test_replay_command_accepts_recording_or_its_folder",
    "record": "tests/live/test_recording.py::test_killed_recorder_loses_less_than_one_second",
    "video": "tests/unit/evaluation/video/test_video.py::test_video_command_renders_run_and_prints_summary",
    "plan": "tests/unit/deploy/test_plan_command.py::test_plan_is_written_printed_and_the_same_in_python",
    "robot check": "tests/unit/deploy/test_robot_command.py::test_check_prints_limits_and_fails_if_one_is_not_met",
    "robot new": "tests/unit/deploy/test_robot_command.py::test_new_asks_for_measures_and_writes_a_profile_that_passes",
    "robot import": "tests/unit/deploy/test_robot_command.py::test_import_writes_a_profile_that_later_commands_read",
    "robot export": "tests/unit/deploy/test_robot_command.py::test_export_writes_file_or_prints",
    "recording info": "tests/unit/shared/recording/test_recovery.py::test_info_command_lists_content",
    "recording recover": "tests/unit/shared/recording/test_recovery.py::test_recover_command_keeps_source_and_reports_losses",
    "topics foxglove": "tests/unit/evaluation/viewers/test_viewers.py::"
    "test_foxglove_server_advertises_channels_and_sends_subscribed",
    "recording export": "tests/unit/evaluation/viewers/test_viewers.py::test_recording_is_exported_to_rerun",
    "recording export FILE": "tests/unit/evaluation/viewers/test_file_export.py::test_exported_grid_map_is_ground",
    "figures run": "tests/unit/evaluation/figures/test_run_figures.py::"
    "test_figures_command_draws_requested_figures_and_comparison",
    "figures masri": "tests/unit/evaluation/theses/test_gallery.py::test_command_draws_table_6_1_and_its_index",
    "figures lotriet": "tests/unit/evaluation/theses/test_gallery.py::test_list_names_each_figure",
    "up --camera": "tests/live/test_camera.py::test_onboard_services_publish_images_and_report_missing_camera",
    "up --connect": "tests/live/test_live_walk.py::test_onboard_and_offboard_start_in_either_order",
    "up --set": "tests/live/test_camera.py::test_onboard_services_publish_images_and_report_missing_camera",
    "up": "tests/live/test_live_walk.py::test_attached_run_walks_with_running_services",
    "fleet": "tests/live/test_fleet.py::test_failure_of_one_robot_does_not_affect_others",
    "benchmarks fleet": "tests/live/test_fleet.py::test_fleet_benchmark_loads_base_with_recorded_robot",
    "order": "tests/live/test_live_walk.py::test_attached_run_walks_with_running_services",
    "drive": "tests/live/test_drive.py::test_keys_walk_the_robot_and_each_end_of_input_stops_it",
    "drive --connect": "tests/live/test_drive.py::test_keys_walk_the_robot_and_each_end_of_input_stops_it",
    "topics list": "tests/unit/deploy/test_cli.py::test_topics_are_listed",
    "topics ros2": "tests/unit/deploy/ros2/test_bridge.py::test_ros2_command_prints_topics_and_ends_on_ctrl_c",
    "topics echo": "tests/unit/deploy/topics/test_passive_subscriber.py::test_echo_prints_requested_number_of_messages",
    "topics hz": "tests/unit/deploy/topics/test_passive_subscriber.py::test_hz_measures_and_prints_totals",
    "benchmarks accuracy": "tests/unit/benchmarks/test_bench.py::test_accuracy_command_writes_tables",
    "benchmarks speed": "tests/unit/benchmarks/test_bench.py::test_speed_command_writes_timings",
    "benchmarks passage": "tests/unit/benchmarks/test_bench.py::test_passage_command_writes_table",
    "benchmarks maps": "tests/unit/benchmarks/test_map_building.py::test_maps_command_writes_table",
    "benchmarks stages": "tests/unit/benchmarks/test_bench.py::test_stages_command_writes_timings_and_picture",
    "benchmarks stages --foothold": "tests/unit/benchmarks/test_bench.py::test_stages_command_writes_timings_and_picture",
    "benchmarks cycle": "tests/unit/benchmarks/test_bench_cycle.py::test_cycle_command_times_standing_and_walking",
    "benchmarks latency": "tests/unit/benchmarks/test_bench_latency.py::test_latency_command_times_live_walks",
    "benchmarks slow-core": "tests/unit/benchmarks/test_slow_core.py::test_slow_core_command_walks",
    "benchmarks plans": "tests/unit/benchmarks/test_bench.py::test_plans_command_asks_planners_for_the_same_steps",
    "service compose": "tests/unit/deploy/test_cli.py::test_compose_prints_the_committed_file",
    "service install": "tests/unit/deploy/launch/test_units.py::test_service_command_installs_prints_next_step_and_uninstalls",
    "benchmarks campaign": "tests/unit/benchmarks/campaign/test_campaign.py::test_part_keeps_what_its_command_leaves",
    "benchmarks faults": "tests/walk/test_faults_command.py::test_faults_command_checks_limits_and_skips_completed_injections",
    "benchmarks fuzz": "tests/unit/benchmarks/test_fuzz.py::test_fuzz_command_reports_findings_and_repeats_message",
    "benchmarks faults --live": "tests/live/test_live_faults.py::test_hung_actuator_is_replaced_and_robot_holds",
    "benchmarks page": "tests/live/test_page.py::test_robot_walks_while_pad_is_held",
    "benchmarks soak": "tests/live/test_soak.py::test_soak_measures_memory_of_processes_and_age_of_topics",
    "benchmarks checksums": "tests/unit/benchmarks/test_bench_checksums.py::test_checksums_command_writes_table",
    "benchmarks bus": "tests/unit/benchmarks/test_bench_bus.py::test_bus_command_writes_table",
    "benchmarks start": "tests/unit/benchmarks/test_bench_start.py::test_start_command_writes_figures",
    "benchmarks strangers": "tests/live/test_strangers.py::test_base_and_actuator_connect_among_unauthorized_clients",
    "benchmarks roles": "tests/unit/benchmarks/test_role_attack.py::test_roles_command_writes_table",
    "benchmarks access": "tests/live/test_access.py::test_access_command_writes_table",
    "keys show": "tests/unit/deploy/security/test_router_security.py::test_new_keys_are_private_and_never_overwritten",
    "keys new": "tests/unit/deploy/security/test_router_security.py::test_new_keys_are_private_and_never_overwritten",
    "benchmarks servos": "tests/unit/benchmarks/test_bench_servos.py::test_servos_command_writes_figures",
    "servos set-id": "tests/test_commissioning.py::test_commissioning_tutorial_runs_as_written",
    "servos scan": "tests/unit/deploy/test_pulse_servos_command.py::test_scan_lists_channels_and_says_that_nothing_is_measured",
    "servos centre": "tests/unit/deploy/test_pulse_servos_command.py::"
    "test_one_channel_is_sent_to_its_middle_and_has_no_pulses_afterwards",
    "servos emulate": "tests/test_commissioning.py::test_commissioning_tutorial_runs_as_written",
    "doctor --bridge": "tests/unit/deploy/doctor/test_servo_checks.py::test_servos_behind_a_bridge_are_checked_as_on_a_bus",
    "doctor": "tests/unit/deploy/test_cli.py::test_doctor_exit_code_follows_failed_checks",
}
SHELL = ("source .venv/bin/activate",)  # of the shell itself
MODULES = {
    "sextant.deploy.launch.router": "tests/unit/deploy/launch/test_router.py::test_router_publishes_presence_of_its_machine",
    "tests.support.mutate": "",  # it runs tests
}
_PREFIX = re.compile(r"[A-Z_]+=.*|time")  # of a command: variables, and the shell's stopwatch
NOT_RUN = {
    "dask": "it serves until it is stopped; tests/unit/evaluation/trials/test_cluster.py starts the same scheduler and workers",
    "pip": "it needs a package index",
    "npm": "it needs a package index",
    "mpremote": "it needs a board",
    "coverage": "it runs tests",
    "pytest": "it runs tests",
}


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of each command in the fenced `sh` blocks, without comments."""
    for block in re.findall(r"^```sh\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        for line in block.replace("\\\n", " ").splitlines():
            words = list(itertools.dropwhile(_PREFIX.fullmatch, shlex.split(line, comments=True)))
            if words and " ".join(words) not in SHELL:
                yield words


def way_of_running(words: list[str]) -> str:
    """Return the key in RUN_BY of a `sextant` command."""
    pairs = (["trials", "all"], ["trials", "passages"], ["trials", "troubles"], ["trials", "table"], ["demo", "gap"])
    groups = ("topics", "benchmarks", "servos", "keys", "recording", "service", "robot", "camera", "figures")
    group = words[:2] if words[0] in groups or words[:2] in pairs else words[:1]
    ways = [
        word
        for word in dict.fromkeys(words)
        if word
        in (
            "--lockstep",
            "--connect",
            "--blind",
            "--camera",
            "--gait",
            "--bridge",
            "--live",
            "--set",
            "--foothold",
            "--cluster",
        )
    ]
    files = ["FILE"] if words[-1].endswith(".mcap") else []
    return " ".join(group + files + ways)


README = list(commands((ROOT / "README.md").read_text(encoding="utf-8")))
GUIDES = list(commands((ROOT / "docs/guides.md").read_text(encoding="utf-8")))
OWN_TESTS = ("deployment.md", "commissioning.md")  # pages whose commands have a test of their own
DOCS = [
    words
    for page in sorted((ROOT / "docs").glob("*.md"))
    if page.name not in OWN_TESTS
    for words in commands(page.read_text(encoding="utf-8"))
]


def test_readme_begins_with_make_demo_and_make_test() -> None:
    assert README[:2] == [["make", "demo"], ["make", "test"]]


@pytest.mark.parametrize("words", list(map(list, dict.fromkeys(map(tuple, README + DOCS)))), ids=" ".join)
def test_command_is_run_by_a_test(words: list[str]) -> None:
    match words:
        case ["make", target, *settings]:
            made = subprocess.run(
                ["make", "-n", target, *settings], cwd=ROOT, capture_output=True, text=True, check=True
            ).stdout
            assert target in MAKE, f"no test knows `make {target}`"
            assert all(part in made for part in MAKE[target]), made
        case ["sextant", *rest]:
            numbered = [re.sub(r"^commit:(\d+)$", r"0:\1", word) for word in rest]  # a commit's seeds need a clean checkout
            assert parse(cli.sextant, "sextant", numbered).path.startswith("sextant ")
            assert way_of_running(rest) in RUN_BY, f"no test runs `{' '.join(words)}`"
        case ["python", "-m", "benchmarks", *rest]:
            assert parse(benchmarks.benchmarks, benchmarks.PROGRAM, rest).path.startswith(benchmarks.PROGRAM)
            assert way_of_running(["benchmarks", *rest]) in RUN_BY, f"no test runs `{' '.join(words)}`"
        case ["python", "-m", module, *_]:
            assert module in MODULES, f"no test runs `{' '.join(words)}`"
        case [program, *_] if program in NOT_RUN:
            pass
        case _:
            pytest.fail(f"no test runs `{' '.join(words)}`")


@pytest.mark.parametrize("test", sorted(set(RUN_BY.values())))
def test_referenced_test_exists(test: str) -> None:
    file, _, name = test.partition("::")
    assert re.search(rf"^def {name}\(", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), f"{test} is not there"


def test_readme_scenarios_are_packaged() -> None:
    from sextant.shared.scenario.loading import load_family, load_scenario

    for words in README + GUIDES:
        if words[:2] in (["sextant", "run"], ["sextant", "trials"]) and words[2] not in (*GROUPS, "table"):
            named = load_family(words[2]) if "--curve" in words else load_scenario(words[2])
            assert named.name == words[2]


def test_readme_names_each_terrain_with_its_words() -> None:
    rows = re.findall(r"^\|.*\|$", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    named = [row.split(" | ")[0] for row in rows[2:]]
    assert named[: len(WALKED)] == [f"| `{name}`: {words}" for name, words in WALKED.items()]


def test_strangers_connect_within_limits() -> None:
    found = strangers.from_json((ROOT / "docs" / "strangers.json").read_text(encoding="utf-8"))
    assert len(found.back_s) == 100
    assert found.late == 0


def test_missteps_table_headings_match_command_output() -> None:
    text = (ROOT / "docs" / "results_maps.md").read_text(encoding="utf-8")
    assert markdown(Campaign((), ()), "missteps").splitlines()[0] in text
