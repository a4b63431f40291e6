"""Depth images to an elevation map: each image is reduced to one point per cell, and fused at its true pose.

python examples/depth_to_map.py FOLDER [map.npy]

FOLDER is a recording in the TUM RGB-D layout; `sextant run steps --lockstep --record-depth FOLDER` makes one.
"""

import sys
from pathlib import Path

import numpy as np

import sextant

recording = sextant.read_recording(Path(sys.argv[1]))
camera, truth = recording.camera, recording.truth
if truth is None:
    sys.exit(f"{sys.argv[1]} has no groundtruth.txt, which places the images")

grid = sextant.ElevationGrid(size=400, resolution=0.01)  # cells, [m]
for stamp_ns, depth in recording.frames():
    T_world_camera = truth.at(stamp_ns)
    if T_world_camera is None:  # before the first pose, or in a gap
        continue
    scan = sextant.reduce_scan(depth, camera.intrinsics, camera.sensor, T_world_camera)
    position = T_world_camera[:3, 3]
    grid.move_to(position[:2])
    grid.fuse(sextant.ValidatedScan.of_millimetres(scan.origin, scan.points, scan.count, scan.spread, position))

found = grid.snapshot()
known = np.isfinite(found.elevation)
if not known.any():
    sys.exit("the images show no ground")
print(f"{len(recording)} images, {known.sum()} of {known.size} cells seen")
print(f"heights {np.nanmin(found.elevation):.3f} to {np.nanmax(found.elevation):.3f} m")
print(f"typical standard deviation {1000 * np.sqrt(np.nanmedian(found.variance)):.1f} mm")
if len(sys.argv) > 2:
    np.save(sys.argv[2], found.elevation)
