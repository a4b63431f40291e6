"""Leads the robot along a course from one of the bed's machines: `python -m deploy.bed.lead ENDPOINT NAMESPACE COURSE`.

It waits for a pose for as long as it takes, and ends when its standard input is closed.
"""

import math
import sys
import threading

from deploy.operator import Operator
from shared.robot import load_profile
from shared.scenario import load_scenario
from shared.service import run_live
from shared.transport import Endpoints, ZenohLink


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
    with ZenohLink(Endpoints((endpoint,), namespace=namespace)) as link:
        run_live(operator, link, stop)
    return 0


if __name__ == "__main__":
    sys.exit(main())
