"""Names of the legs and joints of a robot, and words that select some of its 18 joints."""

LEGS = ("left front", "right front", "right middle", "right rear", "left rear", "left middle")
JOINTS = ("coxa", "femur", "tibia")
JOINT_NAMES = tuple(f"{leg} {joint}" for leg in LEGS for joint in JOINTS)
SIDES = ("left", "right")
SELECTS = "a side, a leg, a joint, or both of these, as 'left', 'left front', 'tibia' or 'left front tibia',"


def selected(words: str) -> tuple[int, ...]:
    """Return the joints (0 to 17) that words select; none if the words are unknown."""
    if words in JOINTS:
        return tuple(i for i, name in enumerate(JOINT_NAMES) if name.endswith(f" {words}"))
    if words in (*SIDES, *LEGS):
        return tuple(i for i, name in enumerate(JOINT_NAMES) if name.startswith(f"{words} "))
    return (JOINT_NAMES.index(words),) if words in JOINT_NAMES else ()
