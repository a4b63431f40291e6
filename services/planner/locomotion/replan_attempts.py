"""Ways that remain after the actuator has refused the next step.

They are, in order: the same step again, a shorter step, a step with other legs, none.
"""

StepVariant = tuple[int, int]  # index of the command, and number of the way to take a step by it, see `StepPlanner.choose`


class RefusedSteps:
    """Refusals of the next step.

    They are forgotten when the robot takes the step or receives another command.
    """

    def __init__(self) -> None:
        self.of_plugin = False  # whether a plug-in plans the steps
        self.forget()

    def forget(self) -> None:
        """Reset: no way has been refused."""
        self.count = 0
        self.tries = 0  # number of refusals since the last one after which no way was left
        self._ways: frozenset[StepVariant] = frozenset()
        self.reason = ""  # of the last refusal
        self.given_up = False  # no way was left; cleared by `forget`, while the planner still retries from time to time

    @property
    def excludes_ways(self) -> bool:
        """Whether a way must not be tried; otherwise the ground alone decides whether there is a step."""
        return bool(self._ways)

    def of(self, command: int) -> frozenset[int]:
        """Return the ways that are refused for one of the commands."""
        return frozenset(way for by, way in self._ways if by == command)

    def add(self, way: StepVariant, reason: str) -> None:
        """Note that a way was refused.

        After the first refusal the same way may be tried again, with newer estimates.
        """
        self.count += 1
        self.tries += 1
        self.reason = reason
        if self.count > 1:
            self._ways |= {way}

    def give_up(self) -> None:
        """Note that no way is left; the next attempt may use any way."""
        self.given_up, self._ways, self.tries = True, frozenset(), 0

    def words(self) -> str:
        """Return why there is no step."""
        if self.of_plugin:
            return f"the actuator refuses the steps of the plug-in: {self.reason}"
        return f"the actuator refuses every feasible step: {self.reason}"
