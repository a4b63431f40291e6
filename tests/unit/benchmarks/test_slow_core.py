"""The walk whose actuator has a share of a core."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import cli
from benchmarks.robot.slow_core import CpuQuota, SlowCoreError, actuator_of


@pytest.mark.parametrize("version", [1, 2])
def test_quota_is_a_share_of_each_5_ms(tmp_path: Path, version: int) -> None:
    (tmp_path / "cpu").mkdir()
    if version == 2:
        (tmp_path / "cgroup.controllers").touch()
    quota = CpuQuota(0.25, tmp_path)
    with quota:
        written = {path.name: path.read_text() for path in quota.folder.iterdir()}
        for path in quota.folder.iterdir():  # those of a real group vanish with it
            path.unlink()
    assert written == {1: {"cpu.cfs_period_us": "5000", "cpu.cfs_quota_us": "1250"}, 2: {"cpu.max": "1250 5000"}}[version]
    assert not quota.folder.exists()


def test_missing_control_groups_and_too_small_shares_are_reported(tmp_path: Path) -> None:
    expected = r"a control group in .*/cpu expected, found No such file or directory; run this as root on Linux"
    with pytest.raises(SlowCoreError, match=expected), CpuQuota(0.2, tmp_path):
        pass
    with pytest.raises(SlowCoreError, match=r"at least 0\.2 of a core expected, found 0\.1"):
        CpuQuota(0.1, tmp_path)


def test_actuator_of_a_run_is_found_and_no_other() -> None:
    waits = [sys.executable, "-c", "input()", "-m", "sextant.services.actuator", "--parent"]
    stop = [sys.executable, "-c", "input()", "-m", "sextant.services.actuator.estop", "--parent", "77"]
    started = [subprocess.Popen(words, stdin=subprocess.PIPE) for words in ([*waits, "77"], [*waits, "78"], stop)]
    try:
        assert actuator_of(77) == started[0].pid
        assert actuator_of(79) == 0
    finally:
        for process in started:
            process.kill()
            process.communicate()


@pytest.mark.live
@pytest.mark.rare
def test_slow_core_command_walks(tmp_path: Path) -> None:
    if os.geteuid():
        pytest.skip("control groups need root")
    assert cli.main(["slow-core", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "slow-core.json").read_text(encoding="utf-8"))
    assert found["success"] is True
    assert found["period_p50_ms"] == pytest.approx(20.0, abs=1.0)
