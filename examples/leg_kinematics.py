"""Kinematics of a leg: the foot of joint angles, joint angles of a foot, and the reach of each leg.

python examples/leg_kinematics.py [PROFILE]
"""

import sys

import numpy as np

import sextant

profile = sextant.load_profile(sys.argv[1] if len(sys.argv) > 1 else "phantomx_mk2")

q = np.radians([10.0, 20.0, -90.0])  # coxa, femur, tibia
foot = sextant.leg_forward(q, profile.links)  # [m] from the coxa axis: outward, sideways, up
print(f"{profile.name}: joint angles {np.degrees(q).round(1)} deg place the foot at {foot.round(4)} m")

raised = foot + np.array([0.0, 0.0, 0.03])
q = sextant.leg_inverse(raised, profile.links)  # NaN where the foot is out of reach
print(f"3 cm higher they are {np.degrees(q).round(1)} deg")
beyond = foot + np.array([0.5, 0.0, 0.0])
print(f"half a metre further out they are {sextant.leg_inverse(beyond, profile.links)}")

feet = profile.rest_feet()  # [m] {body}, standing on level ground
for leg, (near, far), (low, high), place in zip(
    profile.legs, profile.leg_reach, np.degrees(profile.joint_limits[:, 0]), feet, strict=True
):
    print(
        f"{leg.name:>12}: stands at x {place[0]:+.3f}, y {place[1]:+.3f} m, "
        f"reaches {near:.3f} to {far:.3f} m from its femur axis, turns {low:+.0f} to {high:+.0f} deg"
    )
