"""Two machines that only a radio joins: the commands of docs/two_machines.md, and what becomes of a walk whose radio is cut."""

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from deploy.bed.bed import Bed
from deploy.bed.cuts import HOLD_S, OLDEST_S
from deploy.bed.namespace import BedError
from deploy.bed.two_machines import TwoMachines
from deploy.process_table import ROUTER_ENDPOINT
from shared.scenario import Link
from tests.support.commands import PATIENCE_S, ROOT, Command, write_course

pytestmark = pytest.mark.live


@pytest.fixture
def bed() -> Iterator[Bed]:
    with contextlib.ExitStack() as stack:
        try:
            made = stack.enter_context(Bed(Link(20.0, 20.0, 0.0)))
        except BedError as error:
            pytest.skip(str(error))
        yield made


def test_two_bare_machines_walk_by_the_commands_of_the_docs(bed: Bed, tmp_path: Path) -> None:
    with Command("keys", "new", "keys", "--robot-address", bed.robot_address, cwd=tmp_path) as new:
        assert new.status() == 0
    course = str(write_course(tmp_path, "beyond", 0.3))
    with TwoMachines(bed, tmp_path / "keys", course, 1000) as halves:
        halves.meet(PATIENCE_S)
        client = bed.on_base(sys.executable, "-I", str(ROOT / "docs" / "walk_client.py"), ROUTER_ENDPOINT)

        def walked() -> bool:  # a servo of a busy machine may answer late: then it refuses to stand
            subprocess.run(client, capture_output=True, check=True, timeout=PATIENCE_S)
            return len({heard.step for heard in halves.heard if heard.walks}) > 2

        halves.until(walked, PATIENCE_S, "a walk that is led from the base")
        assert bed.carried().from_robot > 0


@pytest.mark.usefixtures("bed")
def test_a_robot_whose_radio_is_cut_holds_and_walks_on_by_itself(tmp_path: Path) -> None:
    """How soon is measured by the same command with more cuts; here the machine may be busy."""
    words = ("bench", "link", "--cuts", "2", "--longest", "0.9", "--seed", "1000", "--out", str(tmp_path / "out"))
    with Command(*words, cwd=tmp_path) as bench:
        assert bench.status() == 0
        bench.gone()
        assert "2 cuts of" in bench.text()
    found = json.loads((tmp_path / "out" / "cuts.json").read_text(encoding="utf-8"))
    assert "network namespaces" in found["bed"]
    assert len(found["cuts"]) == 2
    for cut in found["cuts"]:
        assert cut["held_s"] is not None or cut["lasted_s"] <= HOLD_S
        assert cut["back_s"] is not None
        assert cut["oldest_s"] <= OLDEST_S, "no plan is taken that is stale"
