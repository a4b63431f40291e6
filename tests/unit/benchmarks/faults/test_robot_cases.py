"""The faults of robots with different servos, and their limits."""

from math import inf

from benchmarks.faults.cases import BY_NAME, CASES
from benchmarks.faults.robot_cases import of_robot
from sextant.shared.robot.profiles import load_profile

HOBBY = load_profile("printed_ds3218")


def test_servos_that_report_have_all_faults_and_limits() -> None:
    for name in ("phantomx_mk2", "printed_sts3215", "jethexa_hx35h"):
        assert of_robot(CASES, load_profile(name)) == list(CASES)


def test_hobby_servos_have_no_fault_of_what_they_do_not_report() -> None:
    names = {case.name for case in of_robot(CASES, HOBBY)}
    assert names >= {"planner-killed", "bus-gone", "bytes-wrong", "packets-noisy", "servo-silent", "servo-slipped", "off"}
    assert not names & {"overload", "heat", "hot-reading", "drain", "sag", "servo-wrong", "servo-garbage", "off-servo-bit"}


def test_fault_of_a_hobby_servo_is_not_noticed_but_must_cause_no_fall() -> None:
    (case,) = of_robot([BY_NAME["servo-silent"]], HOBBY)
    assert (case.limits.decided_s, case.limits.again_s, case.limits.named) == (inf, inf, "")
    assert case.limits.torque_stays


def test_faults_of_the_board_keep_their_limits() -> None:
    gone, stuck = of_robot([BY_NAME["bus-gone"], BY_NAME["bus-stuck"]], HOBBY)
    assert (gone.limits.decided_s, gone.limits.again_s) == (0.25, 3.0)
    assert (stuck.limits.decided_s, stuck.limits.again_s) == (0.25, inf)  # it may look like the restart of the board
    assert "board" in gone.limits.named
    assert of_robot([BY_NAME["planner-killed"]], HOBBY) == [BY_NAME["planner-killed"]]
