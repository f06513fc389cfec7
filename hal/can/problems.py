"""Everything that is wrong with the drives of an arm, told at once: a person who fixes an arm fixes it once."""

from collections.abc import Iterable, Sequence

from robotctl.hal.errors import DriveError, HardwareError


class DrivesError(HardwareError):
    """Everything that is wrong with the drives of an arm, in `problems`."""

    def __init__(self, problems: Iterable[DriveError]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join([f"{len(self.problems)} problems with the drives", *map(str, self.problems)]))


def raise_problems(problems: Sequence[DriveError]) -> None:
    """Raise the one problem there is, or all of them as one; return if there is none."""
    if len(problems) == 1:
        raise problems[0]
    if problems:
        raise DrivesError(problems)
