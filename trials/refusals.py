"""Scenarios in which something must not even begin."""

from collections.abc import Callable, Sequence

from robotctl.hal.errors import RobotctlError
from robotctl.hal.robot import Robot
from robotctl.trials.scenario import Scenario, Trial


def refusal_scenario(
    number: int,
    name: str,
    provoked: str,
    attempt: Callable[[Robot, str, int], None],
    words: Sequence[str],
    repeats: int = 1,
) -> Scenario:
    """Return the scenario of an attempt that has to be refused, in words that name what is wrong.

    Args:
        number: of the protection.
        name: of the scenario.
        provoked: what is attempted, in words.
        attempt: takes robot, backend and seed, and has to raise one of this package's errors.
        words: that the error has to hold.
        repeats: with seeds 0, 1, ...
    """

    def run(robot: Robot, backend: str, seed: int) -> Trial:
        trial = Trial()
        try:
            attempt(robot, backend, seed)
        except RobotctlError as error:
            missing = [word for word in words if word not in str(error)]
            trial.require(not missing, f"refused without the words {missing}: {error}")
            trial.seen = "refused"
        else:
            trial.require(False, "was not refused")
        return trial

    return Scenario(number, name, provoked, "refused", run, repeats)
