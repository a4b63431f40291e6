"""Description of a robot by links and joints, as URDF and MJCF state it, and the reader of URDF.

Meshes are ignored. Lengths are in metres, angles in radians.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal
from xml.etree import ElementTree as ET

import numpy as np

from sextant.shared.errors import SextantError
from sextant.shared.geometry import Array, from_xyz_rpy

_MOST_BODIES = 2000  # links of a file; a robot has some dozens
_LARGEST = 1e6  # largest plausible number, in any unit
_OTHER_KINDS = ("prismatic", "floating", "planar")  # of joints
_XACRO = (
    "URDF expected, found Xacro; expand it first with the program xacro, of ROS or `pip install xacro`: "
    "`xacro FILE > robot.urdf`, and import robot.urdf"
)


class DescriptionError(SextantError, ValueError):
    """A robot description cannot be used; the message tells what was expected, what was found, and what to do."""


@dataclass(frozen=True, slots=True)
class Shape:
    """A simple shape of a link; a cylinder and a capsule are along z of their frame."""

    kind: Literal["sphere", "cylinder", "capsule", "box"]
    T_link_shape: Array  # (4, 4)
    half_size: tuple[float, float, float]  # [m] half extents along x, y, z of its frame, a capsule's with its hemispheres


@dataclass(frozen=True, slots=True)
class DescribedLink:
    """A link."""

    name: str
    mass: float = 0.0  # [kg]
    centre: Array = field(default_factory=lambda: np.zeros(3))  # (3,) [m] {link} centre of mass
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))  # [kg m^2] about it, in axes of {link}; zeros: not stated
    shapes: tuple[Shape, ...] = ()
    marks: Mapping[str, Array] = field(default_factory=dict)  # (3,) [m] {link} named points, such as sites


@dataclass(frozen=True, slots=True)
class DescribedJoint:
    """A joint: fixed, a hinge, or of another kind."""

    name: str
    parent: str  # link
    child: str  # link
    T_parent_child: Array  # (4, 4) at joint angle zero
    axis: Array | None = None  # (3,) {child} unit vector of a hinge; None: no hinge
    anchor: Array = field(default_factory=lambda: np.zeros(3))  # (3,) [m] {child} a point of the axis
    limits: tuple[float, float] | None = None  # [rad]; None: unlimited
    effort: float = 0.0  # [N m] largest torque; 0: not stated
    speed: float = 0.0  # [rad/s] largest speed; 0: not stated
    friction: float | None = None  # [N m] dry friction
    armature: float | None = None  # [kg m^2]
    other: str = ""  # kind of a joint that is neither fixed nor a hinge, such as "prismatic"


@dataclass(frozen=True, slots=True)
class RobotDescription:
    """Links and joints of a robot."""

    name: str
    links: Mapping[str, DescribedLink]
    joints: tuple[DescribedJoint, ...]


def read_urdf(text: str) -> RobotDescription:
    """Read URDF.

    Raises:
        DescriptionError: It is not URDF, or a value is invalid.
    """
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise DescriptionError(_XACRO if "<xacro:" in text else f"XML expected: {error}") from None
    if any("xacro" in part.tag or any("${" in value for value in part.attrib.values()) for part in root.iter()):
        raise DescriptionError(_XACRO)
    if root.tag != "robot":
        raise DescriptionError(f"a <robot> of URDF expected, found <{root.tag}>")
    links = {link.name: link for link in map(_link, root.findall("link"))}
    joints = tuple(_joint(element) for element in root.findall("joint"))
    if len(links) > _MOST_BODIES:
        raise DescriptionError(f"at most {_MOST_BODIES} links expected, found {len(links)}")
    return RobotDescription(root.get("name", "robot"), links, joints)


def _link(element: ET.Element) -> DescribedLink:
    name = element.get("name", "")
    inertial = element.find("inertial")
    mass, centre, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    if inertial is not None:
        mass = _number(inertial.find("mass"), "value", f"link {name}", 0.0)
        T = _pose(inertial, f"link {name}")
        centre, inertia = T[:3, 3], T[:3, :3] @ _inertia(inertial.find("inertia"), f"link {name}") @ T[:3, :3].T
    collision, visual = (tuple(_shapes(element, kind, name)) for kind in ("collision", "visual"))
    return DescribedLink(name, mass, centre, inertia, collision or visual)


def _inertia(element: ET.Element | None, place: str) -> Array:
    """Return the inertia (3, 3) [kg m^2] of a link about its centre of mass, zeros if it is not stated."""
    xx, xy, xz, yy, yz, zz = (_number(element, key, place, 0.0) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _shapes(link: ET.Element, kind: str, name: str) -> Iterator[Shape]:
    for part in link.findall(kind):
        place, T = f"{kind} of link {name}", _pose(part, f"{kind} of link {name}")
        geometry = part.find("geometry")
        for shape in () if geometry is None else geometry:
            if shape.tag == "sphere":
                radius = _number(shape, "radius", place)
                yield Shape("sphere", T, (radius, radius, radius))
            elif shape.tag in ("cylinder", "capsule"):
                radius, half = _number(shape, "radius", place), _number(shape, "length", place) / 2
                round_end = radius if shape.tag == "capsule" else 0.0
                yield Shape("cylinder" if shape.tag == "cylinder" else "capsule", T, (radius, radius, half + round_end))
            elif shape.tag == "box":
                x, y, z = (_vector(shape, "size", place, (0.0, 0.0, 0.0)) / 2).tolist()
                yield Shape("box", T, (x, y, z))


def _joint(element: ET.Element) -> DescribedJoint:
    name, kind = element.get("name", ""), element.get("type", "")
    place = f"joint {name}"
    parent, child = (element.find(end) for end in ("parent", "child"))
    if parent is None or child is None:
        raise DescriptionError(f"{place}: <parent> and <child> expected")
    T, links = _pose(element, place), (parent.get("link", ""), child.get("link", ""))
    if kind == "fixed":
        return DescribedJoint(name, *links, T)
    if kind in _OTHER_KINDS:
        return DescribedJoint(name, *links, T, other=kind)
    if kind not in ("revolute", "continuous"):
        raise DescriptionError(f"{place}: a type of URDF expected, such as revolute or fixed, found {kind!r}")
    axis = _vector(element.find("axis"), "xyz", place, (1.0, 0.0, 0.0))
    if np.linalg.norm(axis) < 1e-9:
        raise DescriptionError(f"{place}: an axis expected, found {axis.tolist()}")
    limit, dynamics = element.find("limit"), element.find("dynamics")
    bounds = None
    if kind == "revolute":
        bounds = (_number(limit, "lower", place, 0.0), _number(limit, "upper", place, 0.0))
        if bounds[0] >= bounds[1]:
            raise DescriptionError(
                f"{place}: a lower limit below the upper one expected, found {bounds[0]:g} and {bounds[1]:g}"
            )
    return DescribedJoint(
        name,
        *links,
        T,
        axis / np.linalg.norm(axis),
        limits=bounds,
        effort=_number(limit, "effort", place, 0.0),
        speed=_number(limit, "velocity", place, 0.0),
        friction=None if dynamics is None else _number(dynamics, "friction", place, 0.0),
    )


def _pose(element: ET.Element, place: str) -> Array:
    origin = element.find("origin")
    zero = (0.0, 0.0, 0.0)
    return from_xyz_rpy(_vector(origin, "xyz", place, zero), _vector(origin, "rpy", place, zero))


def _vector(element: ET.Element | None, key: str, place: str, default: tuple[float, float, float]) -> Array:
    text = None if element is None else element.get(key)
    if text is None:
        return np.array(default)
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        values = np.array([np.nan])
    if values.shape != (3,) or not (np.abs(values) <= _LARGEST).all():
        raise DescriptionError(f"{place}: three numbers of at most {_LARGEST:g} expected in {key}, found {text[:60]!r}")
    return values


def _number(element: ET.Element | None, key: str, place: str, default: float | None = None) -> float:
    text = None if element is None else element.get(key)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = np.nan
    if not abs(value) <= _LARGEST:
        raise DescriptionError(f"{place}: a number of at most {_LARGEST:g} expected in {key}, found {text!r}")
    return value
