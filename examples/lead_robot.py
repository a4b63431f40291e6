"""Lead a running robot: stand up, walk to a place, look at its state, sit down.

sextant up all --scenario steps       # in another terminal, or a real robot
python examples/lead_robot.py [ENDPOINT] [X_M]
"""

import sys
import time

import sextant

endpoint = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"
x_m = float(sys.argv[2]) if len(sys.argv) > 2 else 0.5

try:
    with sextant.Client(endpoint, name="lead_robot") as robot:  # stops the robot at the end, if it still leads it
        robot.wait_until_ready()  # until it has a pose and a planner; before, status.pose is None
        robot.stand()
        print(f"standing: {robot.state.voltage:.1f} V, {robot.state.temperature:.0f} deg C")
        robot.walk(0.05)  # [m/s] forward, until the next command
        time.sleep(2.0)
        robot.goto(x_m, 0.0)  # [m] in {world}, around what it cannot cross
        if pose := robot.status.pose:
            print(f"arrived at x {pose.T_world_body[0, 3]:.2f}, y {pose.T_world_body[1, 3]:.2f} m")
        robot.sit()
        print(f"{robot.state.mode}: {robot.state.reason}")
except sextant.ClientError as error:
    sys.exit(f"the robot did not obey: {error}")
