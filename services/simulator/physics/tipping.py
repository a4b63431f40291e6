"""Boxes of the terrain that tip about the edges of a smaller base.

Such a box stands on a base and is hinged at the four edges of the base. Each hinge opens outwards only. A load over the base
presses on all hinges, so the box bears it. A load beyond an edge opens the hinge of that edge, once its moment exceeds that of
the weight of the box. Without the load, the box falls back, unless its centre of mass has passed the edge.
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sextant.services.simulator.physics.solids import Boxes
from sextant.shared.geometry import Array, quaternion_from_rotation

_ARMATURE = (
    2e-4  # [kg m^2] of each hinge; the four hinges of a box move it in three ways, so without it they are not determined
)
_DAMPING = 0.01  # [N m s/rad] of each hinge
_STOP = (0.004, 1.0)  # [s] [1] time constant and damping ratio of closed hinges: as stiff as the time step allows
_STOP_IMPEDANCE = (0.99, 0.999, 0.001, 0.5, 2.0)  # MuJoCo's solimp of closed hinges
_EDGES = ((0, 1), (0, -1), (1, 1), (1, -1))  # axis of the box and side of each edge of the base


@dataclass(frozen=True, slots=True)
class Tipping:
    """Boxes of the terrain that tip when loaded beyond their base."""

    box: NDArray[np.intp]  # (n,) indices of the terrain's boxes
    base: Array  # (n,) [m] from the middle to the edges of the square base
    mass: Array  # (n,) [kg]
    most: Array  # (n,) [rad] largest angle

    def __len__(self) -> int:
        return len(self.box)


NONE_TIPPING = Tipping(np.zeros(0, dtype=np.intp), np.zeros(0), np.zeros(0), np.zeros(0))


def add_tipping(spec: Any, boxes: Boxes, tipping: Tipping, ground: dict[str, Any]) -> None:
    """Add the tipping boxes to a specification (`mujoco.MjSpec`), with the attributes of terrain geoms.

    Their joints must be the last ones of the model.
    """
    for i, base, mass, most in zip(tipping.box, tipping.base, tipping.mass, tipping.most, strict=True):
        half, quat = boxes.half[i], quaternion_from_rotation(boxes.R[i])
        body = spec.worldbody.add_body(name=f"tipping {i}", pos=boxes.centre[i], quat=quat)
        for axis, side in _EDGES:
            place, turn = np.array([0.0, 0.0, -half[2]]), np.zeros(3)
            place[axis], turn[1 - axis] = side * base, side * (1.0 if axis == 0 else -1.0)
            hinge = body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, name=f"tipping {i} {axis} {side}", pos=place, axis=turn)
            hinge.limited, hinge.range = mujoco.mjtLimited.mjLIMITED_TRUE, [0.0, most]
            hinge.armature, hinge.damping = _ARMATURE, [_DAMPING, 0.0, 0.0]
            hinge.solref_limit, hinge.solimp_limit = _STOP, _STOP_IMPEDANCE
        body.add_geom(name=f"tipping {i}", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, mass=mass, **ground)
