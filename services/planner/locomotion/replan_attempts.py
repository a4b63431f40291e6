"""What is left to try when the actuator refuses the next step: once more the same, shorter, with other legs, nothing."""

Way = tuple[int, int]  # which of the commands it is by, and which way of taking a step by it, see `StridePlanner.choose`


class Refusals:
    """The refusals of one step that the robot is to take, forgotten when it takes it or is asked for something else."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin anew: nothing has been refused."""
        self.count = 0
        self._ways: frozenset[Way] = frozenset()
        self.reason = ""  # of the last refusal, in words
        self.given_up = False  # until something changes; it is tried again now and then all the same

    def of(self, command: int) -> frozenset[int]:
        """Ways that need not be tried by one of the commands."""
        return frozenset(way for by, way in self._ways if by == command)

    def add(self, way: Way, reason: str) -> None:
        """Note that a way was refused. The first time the same may pass, by newer estimates."""
        self.count += 1
        self.reason = reason
        if self.count > 1:
            self._ways |= {way}

    def give_up(self) -> None:
        """Note that no way is left; the next attempt may take any."""
        self.given_up, self._ways = True, frozenset()

    def words(self) -> str:
        """Why nothing goes on."""
        return f"the actuator refuses every step that the ground allows: {self.reason}"
