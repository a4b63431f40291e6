"""Admission of scans: order, and whether scan, camera and body belong together."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.mapper.elevation.scan_admission import ScanAdmission
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.wire.messages import BodyPose, Scan

S = 1_000_000_000
NONE = np.zeros(0, dtype=np.uint8)
SCAN = Scan(10 * S, np.zeros(3), np.zeros((0, 3), dtype=np.int16), NONE, NONE, np.array([0.1, 0.0, 0.25]), np.eye(6) * 1e-6)
POSE = BodyPose(0, from_xyz_rpy((0.0, 0.0, 0.1), np.zeros(3)), np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6)))


def reason(scan: Scan = SCAN, pose: BodyPose | None = POSE, after_ns: int | None = None) -> str:
    admission = ScanAdmission()
    if after_ns is not None:
        admission.accept(after_ns)
    return admission.rejection_reason(scan, pose, scan.p_world_camera if pose is None else pose.T_world_body[:3, 3])


@pytest.mark.parametrize("pose", [POSE, None])
def test_first_scan_is_mapped(pose: BodyPose | None) -> None:
    assert reason(pose=pose) == ""


@pytest.mark.parametrize(("after_ns", "mapped"), [(10 * S - 1, True), (10 * S, False), (10 * S + 1, False), (12 * S, True)])
def test_late_scan_is_refused_but_not_one_of_another_clock(after_ns: int, mapped: bool) -> None:
    assert (reason(after_ns=after_ns) == "") is mapped


@pytest.mark.parametrize(
    ("scan", "pose", "words"),
    [
        (replace(SCAN, p_world_camera=np.array([0.0, 2.0, 0.2])), POSE, "the scan was taken 2 m away from the body"),
        (replace(SCAN, origin=np.array([0.0, 0.0, -3.0])), POSE, "the scan's origin is 3.25 m away from its camera"),
        (SCAN, replace(POSE, covariance=np.eye(6) * 1e6), "a pose's covariance of at most 10000 m^2"),
        (SCAN, replace(POSE, T_world_body=from_xyz_rpy((1e9, 0.0, 0.1), np.zeros(3))), "of the world's origin expected"),
    ],
)
def test_scan_that_does_not_belong_to_the_body_is_refused_with_reason(scan: Scan, pose: BodyPose, words: str) -> None:
    assert words in reason(scan, pose)
