"""Two machines that only a radio joins: the commands of docs/two_machines.md, and what becomes of a walk whose radio is cut."""

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from deploy.bed.bed import Bed
from deploy.bed.namespace import BedError
from deploy.bed.two_machines import TwoMachines
from deploy.bench import link
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


def test_a_robot_whose_radio_is_cut_holds_and_walks_on_by_itself() -> None:
    """How soon is measured by `sextant bench link --cuts`; here the machine may be busy."""
    said: list[str] = []
    try:
        found = link.cuts(2, 1000, 3.0, said.append)
    except BedError as error:
        pytest.skip(str(error))
    assert len(found) == len(said) == 2
    for cut in found:
        assert cut.held_s is not None or not cut.must_hold
        assert cut.back_s is not None
        assert cut.oldest_s <= 0.7, "no plan is taken that is stale"
    assert f"{len(found)} cuts of" in link.cuts_in_words(found)
