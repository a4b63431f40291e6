"""Registration of a recorded depth sequence: the camera's path, and its error where the true path is known.

python examples/register_recording.py FOLDER

FOLDER is a recording in the TUM RGB-D layout; `sextant run steps --lockstep --record-depth FOLDER` makes one.
"""

import sys
from pathlib import Path

import numpy as np

import sextant

recording = sextant.read_recording(Path(sys.argv[1]))
registration = sextant.Registration(recording.camera.intrinsics, recording.camera.sensor)
covariance = np.diag([0.02, 0.02, 0.02, 0.02, 0.02, 0.02]) ** 2  # [m, rad] of the motion between two images

before = T = np.eye(4)
if recording.truth is not None and (start := recording.truth.at(int(recording.stamps_ns[0]))) is not None:
    before = T = start  # else the path begins at the origin
errors, refused = [], 0
for stamp_ns, depth in recording.frames():
    expected = T @ np.linalg.inv(before) @ T  # constant velocity; on a robot its legs' odometry
    found = registration.update(depth, stamp_ns, expected, covariance)
    before, T = T, found.T_world_camera
    if not found.ok:
        refused += 1
        print(f"{stamp_ns * 1e-9:.3f} s: {found.reason}")
    true = recording.truth.at(stamp_ns) if recording.truth is not None else None
    if true is not None:
        errors.append(np.linalg.norm(T[:3, 3] - true[:3, 3]))

print(f"{len(recording)} images, {refused} refused; the camera ends at {T[:3, 3].round(3)} m")
if errors:
    print(f"position error: rms {1000 * np.sqrt(np.mean(np.square(errors))):.1f} mm, at the end {1000 * errors[-1]:.1f} mm")
