"""Reader of MJCF as a robot description; MuJoCo parses and compiles it without its meshes."""

import logging
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sextant.shared.geometry import rotation_from_quaternion, transform
from sextant.shared.robot.description.robot_description import (
    DescribedJoint,
    DescribedLink,
    DescriptionError,
    RobotDescription,
    Shape,
)

_LOG = logging.getLogger(__name__)
_LEAST_MASS, _LEAST_INERTIA = 1e-9, 1e-12  # [kg], [kg m^2] of bodies that have meshes only
_SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
}

_KINDS = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
}


def read_mjcf(path: Path) -> RobotDescription:
    """Read the robot of an MJCF file: the body without a hinge that most hinges are below of, and all below it.

    Raises:
        DescriptionError: The file is not MJCF, or has no robot.
    """
    mujoco.set_mju_user_warning(_LOG.debug)  # otherwise MuJoCo writes MUJOCO_LOG.TXT to the working folder
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        _drop_meshes(spec)
        return _description(spec.compile(), spec.modelname)
    except DescriptionError:
        raise
    except (ValueError, OSError) as error:  # also for names that are not UTF-8
        words = " ".join(str(error).split())
        raise DescriptionError(f"MJCF expected: {words[:300]}") from None
    finally:
        mujoco.set_mju_user_warning(None)


def _drop_meshes(spec: Any) -> None:
    """Delete meshes and all that needs a file or refers to other elements, because only bodies, joints and shapes count."""
    of_files = (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD)
    for geom in [geom for geom in spec.geoms if geom.type in of_files or geom.meshname]:
        spec.delete(geom)
    for kind in ("keys", "sensors", "materials", "textures", "skins", "hfields", "meshes", "excludes", "pairs"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    for geom in spec.geoms:
        geom.material = ""
    spec.compiler.boundmass, spec.compiler.boundinertia = _LEAST_MASS, _LEAST_INERTIA


def _description(model: Any, name: str) -> RobotDescription:
    root = _trunk(model)
    below = [body for body in range(model.nbody) if _is_below(model, body, root)]
    names = {body: model.body(body).name or f"body {body}" for body in below}
    links = {names[body]: _link(model, body, names[body], body == root) for body in below}
    joints = tuple(_joint(model, body, names) for body in below if body != root)
    return RobotDescription(name or names[root], links, joints)


def _trunk(model: Any) -> int:
    """Return the body without a hinge that most hinges are below of."""
    hinges = [int(model.jnt_bodyid[j]) for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    still = [body for body in range(1, model.nbody) if body not in hinges]
    if not hinges or not still:
        raise DescriptionError("a trunk and hinges below it expected, found no hinge")
    return max(still, key=lambda body: (sum(_is_below(model, hinge, body) for hinge in hinges), -body))


def _is_below(model: Any, body: int, root: int) -> bool:
    while body > root:
        body = int(model.body_parentid[body])
    return body == root


def _link(model: Any, body: int, name: str, is_root: bool) -> DescribedLink:
    first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
    geoms = range(first, first + count) if count else range(0)
    shapes = tuple(shape for geom in geoms if (shape := _shape(model, geom)) is not None)
    sites = [site for site in range(model.nsite) if model.site_bodyid[site] == body]
    marks = {model.site(site).name: np.array(model.site_pos[site]) for site in sites if model.site(site).name}
    mass = float(model.body_mass[body])
    if mass <= 2 * _LEAST_MASS:
        return DescribedLink(name, shapes=shapes, marks=marks)
    R = rotation_from_quaternion(model.body_iquat[body])
    inertia = R @ np.diag(model.body_inertia[body]) @ R.T
    return DescribedLink(name, mass, np.array(model.body_ipos[body]), inertia, shapes, marks)


def _shape(model: Any, geom: int) -> Shape | None:
    kind = _SHAPES.get(int(model.geom_type[geom]))
    if kind is None:
        return None
    x, y, z = model.geom_size[geom].tolist()
    half = {"sphere": (x, x, x), "capsule": (x, x, y + x), "cylinder": (x, x, y), "box": (x, y, z)}[kind]
    T = transform(rotation_from_quaternion(model.geom_quat[geom]), model.geom_pos[geom])
    return Shape(kind, T, half)  # type: ignore[arg-type]


def _joint(model: Any, body: int, names: dict[int, str]) -> DescribedJoint:
    parent = names[int(model.body_parentid[body])]
    T = transform(rotation_from_quaternion(model.body_quat[body]), model.body_pos[body])
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    if count == 0:
        return DescribedJoint(f"{names[body]} mount", parent, names[body], T)
    joint_name = model.joint(first).name or f"{names[body]} joint"
    if count > 1 or model.jnt_type[first] != mujoco.mjtJoint.mjJNT_HINGE:
        kinds = [_KINDS[int(model.jnt_type[joint])] for joint in range(first, first + count)]
        return DescribedJoint(joint_name, parent, names[body], T, other=" and ".join(kinds))
    dof = int(model.jnt_dofadr[first])
    damping = float(model.dof_damping[dof].flat[0])
    torque = _torque(model, first)
    reference = float(model.qpos0[model.jnt_qposadr[first]])
    low, high = (model.jnt_range[first] - reference).tolist()
    return DescribedJoint(
        joint_name,
        parent,
        names[body],
        T,
        np.array(model.jnt_axis[first]),
        np.array(model.jnt_pos[first]),
        limits=(low, high) if model.jnt_limited[first] else None,
        effort=torque,
        speed=torque / damping if torque and damping else 0.0,
        friction=float(model.dof_frictionloss[dof]) or None,
        armature=float(model.dof_armature[dof]) or None,
    )


def _torque(model: Any, joint: int) -> float:
    """Return the torque limit [N m] of a joint or of its actuator, 0 if there is none."""
    if model.jnt_actfrclimited[joint]:
        return float(np.abs(model.jnt_actfrcrange[joint]).max())
    for actuator in range(model.nu):
        if model.actuator_trnid[actuator, 0] == joint and model.actuator_forcelimited[actuator]:
            return float(np.abs(model.actuator_forcerange[actuator]).max())
    return 0.0
