"""Lead the robot along a course from one of the testbed's machines.

python -m benchmarks.net_testbed.leader ENDPOINT NAMESPACE COURSE

It waits for a pose without a timeout. It ends when its standard input is closed. If it gives up, it prints the reason and exits
with status 1.
"""

import math
import sys
import threading

from sextant.evaluation.observers.operator import Operator
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.zenoh_runner import run_live
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire.transport import Endpoints, ZenohLink

_LOOK_S = 0.2


def main() -> int:
    """Lead until standard input ends."""
    endpoint, namespace, course = sys.argv[1:]
    stop = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        stop.set()

    threading.Thread(target=wait, daemon=True).start()
    scenario = load_scenario(course)
    operator = Operator(load_profile(scenario.robot), scenario, no_pose_s=math.inf)

    def wait_for_its_end() -> None:
        while not stop.wait(_LOOK_S):
            if operator.finished:
                stop.set()

    threading.Thread(target=wait_for_its_end, daemon=True).start()
    with ZenohLink(Endpoints((endpoint,), namespace=namespace)) as link:
        run_live(operator, link, stop)
    if operator.finished:
        sys.stderr.write(f"{operator.reason}\n")
    return int(operator.finished)


if __name__ == "__main__":
    sys.exit(main())
