"""Links, trunk and feet of a robot: their measures, masses and moments of inertia."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sextant.shared.files import config
from sextant.shared.geometry import Array

MM = "(45 mm are 0.045)"  # in errors of lengths
_MOST_INERTIA = 1e4  # [kg m^2]
_ROUNDED = 0.5 + 1e-6  # [1] largest share that one moment of inertia may have in the sum of three


def box_inertia(mass: float, size: Sequence[float]) -> Array:
    """Return the moments of inertia (3,) [kg m^2] of a uniform box about its centre.

    Args:
        mass: [kg].
        size: (3,) [m] its edges.
    """
    half = np.array(size) / 2
    return np.asarray(mass / 3.0 * (np.sum(half**2) - half**2))


def capsule_inertia(mass: float, length: float, radius: float) -> Array:
    """Return the principal inertias (3,) [kg m^2] of a uniform capsule along x about its centre.

    Args:
        mass: [kg].
        length: [m] of its cylinder, without the two hemispheres.
        radius: [m].
    """
    cylinder, ball = length, 4.0 / 3.0 * radius  # volumes per pi radius^2
    m_cylinder, m_ball = mass * cylinder / (cylinder + ball), mass * ball / (cylinder + ball)
    along = m_cylinder * radius**2 / 2 + m_ball * 0.4 * radius**2
    across = m_cylinder * (length**2 / 12 + radius**2 / 4) + m_ball * (
        0.4 * radius**2 + length**2 / 4 + 3.0 / 8.0 * length * radius
    )
    return np.array([along, across, across])


@dataclass(frozen=True, slots=True)
class LegLinks:
    """Lengths [m] of the three links of a leg.

    The coxa link goes from the coxa axis to the femur axis, the femur link from the femur axis to the tibia axis, and the tibia
    link from the tibia axis to the centre of the foot.
    """

    coxa: float  # [m] coxa axis to femur axis
    femur: float  # [m] femur axis to tibia axis
    tibia: float  # [m] tibia axis to the foot's centre

    checks = (*config.each("coxa femur tibia", lambda length: 0.001 <= length <= 10, f"a length of 0.001 to 10 m {MM}"),)

    def __post_init__(self) -> None:
        config.verify(self)


@dataclass(frozen=True, slots=True)
class Body:
    """Trunk of the robot as a box, and the masses of the robot."""

    # [m] length, width, height of the box that must not touch the ground. For a round trunk, length and width are 0.9 of its
    # diameter: the square of the same area.
    size: tuple[float, float, float]
    mass: float  # [kg] of the robot without the six legs; the coxa servos are in the trunk and count here
    leg_link_masses: tuple[float, float, float]  # [kg] coxa, femur, tibia link with the servos they carry
    # [m] {body} centre of `mass`, including battery, computer and camera. To measure it, hang up the trunk from two points.
    centre_of_mass: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # [kg m^2] moments of inertia of `mass` about its centre, around x, y and z of {body}; zeros: those of a uniform box
    inertia: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # [kg m^2] of coxa, femur and tibia link about their middle, around the axes across the link; 0: those of a uniform capsule
    leg_link_inertias: tuple[float, float, float] = (0.0, 0.0, 0.0)

    checks = (
        *config.each("size", lambda edge: 0 < edge <= 10, f"an edge of more than 0 and at most 10 m {MM}"),
        *config.each("mass leg_link_masses", lambda mass: 0 < mass <= 1000, "a mass of more than 0 and at most 1000 kg"),
        config.together(
            "size centre_of_mass",
            lambda size, centre: (
                all(2 * abs(c) <= edge for c, edge in zip(centre[:2], size[:2], strict=True)) and abs(centre[2]) <= max(size)
            ),
            "a centre of mass over or under the trunk, in metres from its middle",
        ),
        config.together(
            "inertia",
            lambda inertia: not any(inertia) or (min(inertia) > 0.0 and max(inertia) <= _ROUNDED * sum(inertia)),
            "three moments of inertia above 0, none larger than the sum of the others, or three zeros",
        ),
        *config.each("inertia leg_link_inertias", lambda inertia: 0 <= inertia <= _MOST_INERTIA, "0 to 10000 kg m^2"),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    @property
    def total_mass(self) -> float:
        """Mass of the whole robot [kg]."""
        return self.mass + 6.0 * sum(self.leg_link_masses)

    @property
    def trunk_inertia(self) -> Array:
        """Moments of inertia (3,) [kg m^2] of the trunk about its centre of mass, around the axes of {body}."""
        return np.array(self.inertia) if any(self.inertia) else box_inertia(self.mass, self.size)

    def link_inertia(self, joint: int, length: float, radius: float) -> Array:
        """Return the moments of inertia (3,) [kg m^2] of a leg's link about its middle, around itself and across.

        Args:
            joint: 0 coxa, 1 femur, 2 tibia.
            length: [m] of its capsule, without the two hemispheres.
            radius: [m] of its capsule.
        """
        along, across, _ = capsule_inertia(self.leg_link_masses[joint], length, radius)
        across = self.leg_link_inertias[joint] or across
        return np.array([min(along, 2.0 * across), across, across])


@dataclass(frozen=True, slots=True)
class Foot:
    """Foot, a sphere around the end of the tibia."""

    radius: float  # [m] of the sphere

    checks = (*config.each("radius", lambda radius: 0 < radius <= 1, f"a foot radius of more than 0 and at most 1 m {MM}"),)

    def __post_init__(self) -> None:
        config.verify(self)
