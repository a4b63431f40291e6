"""Six legs of three joints in a robot description: which joints they are, and their kinematics in a profile's convention.

A leg turns about a vertical coxa axis; femur and tibia axes are horizontal and parallel. Lengths, signs and zero angles follow
from where these axes are at joint angles zero.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sextant.shared.geometry import Array, apply, exp_so3, rotation_z, transform
from sextant.shared.robot.description.robot_description import DescribedJoint, DescribedLink, DescriptionError, RobotDescription
from sextant.shared.robot.profile import JOINTS, LEGS
from sextant.shared.spelling import hint

FORWARD = {"x": 0.0, "y": np.pi / 2, "-x": np.pi, "-y": -np.pi / 2}  # [rad] direction of the robot's front, about z from x
_AXIS_TOLERANCE = 0.02  # [rad] by which an axis may deviate from vertical, horizontal or parallel
_PLANE_TOLERANCE_M = 0.003  # [m] by which knee and foot may be off the plane of their leg
_FOOT = re.compile(r"foot|feet|toe|tip|end_?effector|\bee\b", re.IGNORECASE)
_SERVO_RANGE = np.radians(150.0)  # [rad] in both directions: the limits of a joint without limits
_SIDE_M = 0.003  # [m] least distance of a coxa axis from the plane between left and right
_LIKE_DEGREES = (7.0, 360.0)  # a limit between them is in degrees rather than radians
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class DescribedLeg:
    """A leg in the convention of `sextant.shared.robot.profile`; its joint angle is sign * described angle + zero."""

    joints: tuple[str, str, str]  # names in the description
    mount: Array  # (3,) [m] {body} coxa axis, at the height of the femur axis
    yaw: float  # [rad] of the leg at a described coxa angle of zero
    lengths: Array  # (3,) [m] coxa, femur, tibia
    signs: Array  # (3,) 1 or -1
    zeros: Array  # (3,) [rad]
    limits: Array  # (3, 2) [rad] of the profile's joint angles
    masses: Array  # (3,) [kg] coxa, femur, tibia
    inertias: Array  # (3,) [kg m^2] of them about their centres of mass, around the axes across the link; 0: not stated
    foot_radius: float  # [m]; 0 if no sphere or capsule shows it


class DescribedBodies:
    """Rigid bodies of a description: links that fixed joints connect. Frames are {body} at joint angles zero."""

    def __init__(self, description: RobotDescription, forward: float = 0.0, movable: frozenset[str] | None = None):
        """Assemble the bodies.

        Args:
            description: Links and joints.
            forward: [rad] direction of the robot's front about z.
            movable: Names of the hinges that move; the others are fixed at zero. None: all move.

        Raises:
            DescriptionError: The links do not form one tree.
        """
        self.description = description
        children: dict[str, list[DescribedJoint]] = {}
        for joint in description.joints:
            for end in (joint.parent, joint.child):
                if end not in description.links:
                    raise DescriptionError(f"joint {joint.name}: no link {end!r}; {hint(end, list(description.links))}")
            children.setdefault(joint.parent, []).append(joint)
        self.above = {joint.child: joint for joint in description.joints}  # joint above each link
        roots = [name for name in description.links if name not in self.above]
        if len(roots) != 1:
            found = f"{len(roots)}: {', '.join(roots[:5])}" if roots else "none"
            raise DescriptionError(f"one link without a parent expected, found {found}")
        above_trunk = []  # links such as a world in which the robot floats
        while len(below := children.get(roots[0], [])) == 1 and below[0].other and below[0].child not in above_trunk:
            above_trunk.append(roots[0])
            roots = [below[0].child]
        self.root, self.forward = roots[0], forward
        self.pose = {self.root: transform(rotation_z(-forward), np.zeros(3))}  # (4, 4) T_body_link of each link
        self.members: dict[str, list[str]] = {self.root: [self.root]}  # links of each rigid body, by its first link
        self.hinges: dict[str, list[DescribedJoint]] = {}  # hinges that begin at each rigid body
        self.still: list[DescribedJoint] = []  # joints below the trunk that could move, and are fixed at zero
        waiting = [(self.root, self.root)]
        while waiting:
            link, body = waiting.pop()
            for joint in children.get(link, ()):
                if joint.child in self.pose:
                    raise DescriptionError(f"joint {joint.name}: a tree of links expected, found a second way to {joint.child}")
                self.pose[joint.child] = self.pose[link] @ joint.T_parent_child
                moves = joint.axis is not None and (movable is None or joint.name in movable)
                if moves:
                    self.hinges.setdefault(body, []).append(joint)
                    self.members[joint.child] = []
                elif joint.axis is not None or joint.other:
                    self.still.append(joint)
                first = joint.child if moves else body
                self.members[first].append(joint.child)
                waiting.append((joint.child, first))
        if len(self.pose) + len(above_trunk) != len(description.links):
            raise DescriptionError("one tree of links expected, found a loop of joints")

    def links(self, body: str) -> Iterator[tuple[DescribedLink, Array]]:
        """Yield the links of a rigid body with T_body_link (4, 4)."""
        for name in self.members[body]:
            yield self.description.links[name], self.pose[name]

    def mass(self, body: str) -> float:
        """Return the mass [kg] of a rigid body."""
        return sum(link.mass for link, _ in self.links(body))

    def centre_of_mass(self, body: str) -> Array:
        """Return the centre of mass (3,) [m] of a rigid body with a mass."""
        moment = sum((link.mass * apply(T, link.centre) for link, T in self.links(body)), np.zeros(3))
        return np.asarray(moment / self.mass(body))

    def inertia(self, body: str) -> Array:
        """Return the inertia (3, 3) [kg m^2] of a rigid body about its centre of mass.

        It is zero if a link with a mass states none.
        """
        total = np.zeros((3, 3))
        if any(link.mass > 0.0 and not link.inertia.any() for link, _ in self.links(body)) or self.mass(body) <= 0.0:
            return total
        centre = self.centre_of_mass(body)
        for link, T in self.links(body):
            d = apply(T, link.centre) - centre
            total += T[:3, :3] @ link.inertia @ T[:3, :3].T + link.mass * (d @ d * np.eye(3) - np.outer(d, d))
        return total

    def axis(self, joint: DescribedJoint) -> tuple[Array, Array]:
        """Return a point (3,) [m] and the direction (3,) of a hinge."""
        T = self.pose[joint.child]
        assert joint.axis is not None
        return apply(T, joint.anchor), T[:3, :3] @ joint.axis


def chains_of(bodies: DescribedBodies) -> list[tuple[DescribedJoint, ...]]:
    """Return the six chains of three hinges that begin at the trunk; others, such as those of a head, are left out.

    Raises:
        DescriptionError: There are not six.
    """
    chains = []
    for first in bodies.hinges.get(bodies.root, []):
        chain = [first]
        while len(following := bodies.hinges.get(chain[-1].child, [])) == 1:
            chain.append(following[0])
        chains.append(tuple(chain))
    legs = [chain for chain in chains if len(chain) == len(JOINTS) and chain[-1].child not in bodies.hinges]
    if len(legs) == len(LEGS):
        return legs
    for last in (chain[-1].child for chain in chains):
        if last in bodies.hinges:
            names = ", ".join(joint.name for joint in bodies.hinges[last])
            raise DescriptionError(f"link {last}: one joint of a leg expected, found {names}")
    found = "; ".join("-".join(joint.name for joint in chain) for chain in chains) or "no hinge at the first link"
    others = f"; of other kinds: {still_joints(bodies)}" if bodies.still else ""
    ways = "name the 18 joints in a table with --joints"
    raise DescriptionError(f"six legs of three joints at the trunk expected, found {len(chains)} ({found}{others}); {ways}")


def still_joints(bodies: DescribedBodies) -> str:
    """Return the names of the joints that are fixed at zero, with the kinds of those that are no hinges."""
    return ", ".join(f"{joint.name} ({joint.other})" if joint.other else joint.name for joint in bodies.still)


def named_chains(bodies: DescribedBodies, names: Mapping[str, Sequence[str]]) -> list[tuple[DescribedJoint, ...]]:
    """Return the chains of a table of joint names by leg, in the order of the legs.

    Raises:
        DescriptionError: A joint is not in the description, or a leg is not one chain from the trunk.
    """
    by_name = {joint.name: joint for joint in bodies.description.joints if joint.axis is not None}
    found = []
    for leg in LEGS:
        unknown = [name for name in names[leg] if name not in by_name]
        if unknown:
            raise DescriptionError(f"{leg} leg: no hinge {unknown[0]!r}; {hint(unknown[0], list(by_name))}")
        chain = tuple(by_name[name] for name in names[leg])
        at = bodies.root
        for joint in chain:
            if joint not in bodies.hinges.get(at, []):
                raise DescriptionError(
                    f"{leg} leg: joints in their order from the trunk expected, found {', '.join(names[leg])}"
                )
            at = joint.child
        found.append(chain)
    return found


def ordered(bodies: DescribedBodies, chains: Sequence[tuple[DescribedJoint, ...]]) -> list[tuple[DescribedJoint, ...]]:
    """Return chains in the order of the legs, guessed from where they are: three on each side, front to rear.

    Raises:
        DescriptionError: There are not three on each side.
    """
    places = np.array([bodies.axis(chain[0])[0] for chain in chains])
    left, right = _sides(places, 0.0)
    if len(left) != 3 or len(right) != 3:
        turns = [word for word, angle in FORWARD.items() if list(map(len, _sides(places, angle - bodies.forward))) == [3, 3]]
        options = " or ".join(f"--forward {word}" for word in turns)
        ways = f"state the robot's front with {options}" if turns else "name its legs with --joints"
        raise DescriptionError(
            f"three legs on the left of the robot and three on the right expected, found {len(left)} and {len(right)}; {ways}"
        )
    of_side = {
        side: dict(zip(("front", "middle", "rear"), sorted(legs, key=lambda k: -places[k][0]), strict=True))
        for side, legs in (("left", left), ("right", right))
    }
    return [chains[of_side[side][place]] for side, place in (leg.split() for leg in LEGS)]


def _sides(places: Array, front: float) -> tuple[list[int], list[int]]:
    """Return which of the places (n, 3) [m] are on the left and on the right of a direction [rad about z from x]."""
    to_left = places @ [-np.sin(front), np.cos(front), 0.0]
    return np.flatnonzero(to_left > _SIDE_M).tolist(), np.flatnonzero(to_left < -_SIDE_M).tolist()


def leg_of(bodies: DescribedBodies, name: str, chain: Sequence[DescribedJoint], foot: Array | None) -> DescribedLeg:
    """Return the kinematics of a leg.

    Args:
        bodies: The rigid bodies.
        name: Name of the leg, for errors.
        chain: Coxa, femur and tibia joint.
        foot: (3,) [m] {last link} centre of the foot; None: from the description.

    Raises:
        DescriptionError: An axis is not as in the module's description, the foot is unknown, or limits are in degrees.
    """
    _verify_joints(bodies, name, chain)
    (p_coxa, a_coxa), (p_femur, a_femur), (p_tibia, a_tibia) = (bodies.axis(joint) for joint in chain)
    place = f"{name} leg"
    _expect_axis(f"{place}, joint {chain[0].name}", "a vertical coxa axis", abs(a_coxa[2]) > np.cos(_AXIS_TOLERANCE), a_coxa)
    for joint, axis in zip(chain[1:], (a_femur, a_tibia), strict=True):
        _expect_axis(f"{place}, joint {joint.name}", "a horizontal axis", abs(axis[2]) < np.sin(_AXIS_TOLERANCE), axis)
    parallel = np.linalg.norm(np.cross(a_femur, a_tibia)) < np.sin(_AXIS_TOLERANCE)
    _expect_axis(f"{place}, joint {chain[2].name}", f"an axis parallel to that of {chain[1].name}", parallel, a_tibia)
    p_foot, radius = _foot_of(bodies, name, chain[-1], foot, p_tibia)

    out = np.cross(a_femur * [1.0, 1.0, 0.0], _UP)
    out /= np.linalg.norm(out)
    far = p_femur - p_coxa if abs((p_femur - p_coxa) @ out) > 1e-3 else p_foot - p_coxa
    out *= np.sign(far @ out)
    aside = np.cross(_UP, out)  # the leg's left
    offset = abs(float((p_foot - p_coxa) @ aside))
    if offset > _PLANE_TOLERANCE_M:
        words = f"a foot in the plane of coxa axis and leg expected, found it {1e3 * offset:.0f} mm off it"
        frames = "" if foot is None else "; where the last links have different frames, state each foot in [feet] of --joints"
        raise DescriptionError(f"{place}: {words}; a profile has no such offset{frames}")

    def in_plane(vector: Array) -> tuple[float, float]:
        return float(vector @ out), float(vector[2])

    (coxa, _), femur, tibia = in_plane(p_femur - p_coxa), in_plane(p_tibia - p_femur), in_plane(p_foot - p_tibia)
    femur_angle, tibia_angle = (float(np.arctan2(part[1], part[0])) for part in (femur, tibia))
    bend = float((tibia_angle - femur_angle + np.pi) % (2 * np.pi) - np.pi)
    # A positive angle about -aside lifts the leg.
    signs = np.array([np.sign(a_coxa[2]), -np.sign(a_femur @ aside), -np.sign(a_tibia @ aside)])
    zeros = np.array([0.0, femur_angle, bend])
    bounds = np.array([joint.limits or (-_SERVO_RANGE, _SERVO_RANGE) for joint in chain])
    along = (p_femur[2] - p_coxa[2]) / a_coxa[2]
    return DescribedLeg(
        joints=(chain[0].name, chain[1].name, chain[2].name),
        mount=p_coxa + along * a_coxa,
        yaw=float(np.arctan2(out[1], out[0])),
        lengths=np.array([coxa, np.hypot(*femur), np.hypot(*tibia)]),
        signs=signs,
        zeros=zeros,
        limits=np.sort(signs[:, None] * bounds, axis=1) + zeros[:, None],
        masses=np.array([bodies.mass(joint.child) for joint in chain]),
        inertias=np.array(
            [
                _across(bodies.inertia(joint.child), end - start)
                for joint, start, end in zip(chain, (p_coxa, p_femur, p_tibia), (p_femur, p_tibia, p_foot), strict=True)
            ]
        ),
        foot_radius=radius,
    )


def _verify_joints(bodies: DescribedBodies, name: str, chain: Sequence[DescribedJoint]) -> None:
    """Raise DescriptionError if a leg has a joint that is no hinge, above its last hinge, or limits in degrees."""
    link = chain[-1].child
    while link != bodies.root:
        joint = bodies.above[link]
        if joint.other:
            raise DescriptionError(f"{name} leg, joint {joint.name}: a hinge or a fixed joint expected, found {joint.other}")
        if joint.limits and _LIKE_DEGREES[0] < max(map(abs, joint.limits)) <= _LIKE_DEGREES[1]:
            found = " and ".join(f"{limit:g}" for limit in joint.limits)
            ways = "which look like degrees; divide the limits of all joints by 57.3"
            raise DescriptionError(f"{name} leg, joint {joint.name}: limits in radians expected, found {found}, {ways}")
        link = joint.parent


def _across(inertia: Array, along: Array) -> float:
    """Return the mean moment of inertia [kg m^2] around the axes across a link, of its inertia (3, 3)."""
    along = along / np.linalg.norm(along)
    return float(np.trace(inertia) - along @ inertia @ along) / 2


def foot_position(bodies: DescribedBodies, chain: Sequence[DescribedJoint], p_foot: Array, angles: Array) -> Array:
    """Return where a foot (3,) [m] {body} goes that is at `p_foot` with all angles zero.

    `angles` (3,) [rad] are those of the description. It uses the joints of the description alone, to verify a profile.
    """
    for joint, angle in zip(reversed(chain), reversed(angles.tolist()), strict=True):
        point, direction = bodies.axis(joint)
        p_foot = point + exp_so3(angle * direction) @ (p_foot - point)
    return p_foot


def foot_at_zero(bodies: DescribedBodies, name: str, chain: Sequence[DescribedJoint], foot: Array | None) -> Array:
    """Return the centre (3,) [m] {body} of a leg's foot at joint angles zero; arguments as in `leg_of`."""
    return _foot_of(bodies, name, chain[-1], foot, bodies.axis(chain[-1])[0])[0]


def _expect_axis(place: str, expected: str, holds: bool, axis: Array) -> None:
    if not holds:
        found = ", ".join(f"{part:.3f}" for part in axis.tolist())
        raise DescriptionError(f"{place}: {expected} expected, found ({found}) in the trunk's frame")


def _foot_of(bodies: DescribedBodies, name: str, last: DescribedJoint, foot: Array | None, knee: Array) -> tuple[Array, float]:
    """Return the centre (3,) [m] {body} of a foot and its radius [m], 0 if unknown.

    The centre is, in this order: the given point, a link or a named point that is called a foot, the farthest sphere, the far
    end of the farthest other shape.
    """
    links = list(bodies.links(last.child))
    shapes = [(shape, T @ shape.T_link_shape) for link, T in links for shape in link.shapes]
    ends = [(_far_end(shape.kind, shape.half_size, T, knee), shape) for shape, T in shapes]
    spheres = [(T[:3, 3], shape.half_size[0]) for shape, T in shapes if shape.kind == "sphere"]
    if foot is not None:
        return apply(bodies.pose[last.child], foot), max((radius for _, radius in spheres), default=0.0)
    marks = [(T[:3, 3], link.name) for link, T in links if link.name != last.child]
    marks += [(apply(T, point), mark) for link, T in links for mark, point in link.marks.items()]
    named = [point for point, mark in marks if _FOOT.search(mark)]

    def distance(point: Array) -> float:
        return float(np.linalg.norm(point - knee))

    if named:
        point = max(named, key=distance)
        near = [radius for centre, radius in spheres if np.linalg.norm(centre - point) < radius]
        return point, max(near, default=0.0)
    if spheres:
        return max(spheres, key=lambda sphere: distance(sphere[0]))
    if ends:
        (point, radius), _ = max(ends, key=lambda end: distance(end[0][0]))
        return point, radius
    ways = "give the foot's centre in the frame of that link with --foot X,Y,Z"
    raise DescriptionError(f"{name} leg: a foot at link {last.child} expected, found meshes or nothing; {ways}")


def _far_end(kind: str, half_size: tuple[float, float, float], T: Array, knee: Array) -> tuple[Array, float]:
    """Return the end of a shape farthest from the knee (3,) [m], and the radius of a round end."""
    long = int(np.argmax(half_size))
    radius = half_size[0] if kind == "capsule" else 0.0
    ends = [T[:3, 3] + sign * (half_size[long] - radius) * T[:3, long] for sign in (1.0, -1.0)]
    return max(ends, key=lambda end: float(np.linalg.norm(end - knee))), radius
