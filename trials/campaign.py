"""The campaign: every scenario of a robot on a backend, and what came of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter

from robotctl.hal.robot import Robot
from robotctl.trials.scenario import TITLES, Scenario, Trial


@dataclass(slots=True)
class Row:
    """A scenario with its trials."""

    scenario: Scenario
    trials: list[Trial] = field(default_factory=list)
    seconds: float = 0.0
    """What it took of the machine's time."""

    @property
    def problems(self) -> list[str]:
        """What was wrong, each thing once."""
        return list(dict.fromkeys(problem for trial in self.trials for problem in trial.problems))

    @property
    def passed(self) -> bool:
        return bool(self.trials) and not self.problems


@dataclass(slots=True)
class Campaign:
    """All rows of one robot on one backend."""

    robot: Robot
    backend: str
    rows: list[Row] = field(default_factory=list)
    missing: list[int] = field(default_factory=list)
    """Protections without a scenario."""

    @property
    def passed(self) -> bool:
        return bool(self.rows) and not self.missing and all(row.passed for row in self.rows)


def run_campaign(
    robot: Robot,
    backend: str,
    scenarios: Sequence[Scenario],
    on_trial: Callable[[Row], None] = lambda _: None,
    only: int | None = None,
) -> Campaign:
    """Run scenarios, one trial after the other.

    Args:
        scenarios: all there are.
        on_trial: told of a row before its first trial and after every one.
        only: number of the one protection to try; the others do not count as missing then.
    """
    wanted = [scenario for scenario in scenarios if only in (None, scenario.number)]
    numbers = {scenario.number for scenario in wanted}
    campaign = Campaign(robot, backend, missing=sorted(({only} if only else set(TITLES)) - numbers))
    for scenario in wanted:
        row = Row(scenario)
        campaign.rows.append(row)
        on_trial(row)
        begun = perf_counter()
        for seed in range(scenario.repeats):
            row.trials.append(_try(scenario, robot, backend, seed))
            row.seconds = perf_counter() - begun
            on_trial(row)
    return campaign


def _try(scenario: Scenario, robot: Robot, backend: str, seed: int) -> Trial:
    try:
        return scenario.run(robot, backend, seed)
    except Exception as error:  # noqa: BLE001 - a loop that dies of a fault is a finding like any other
        return Trial([f"{type(error).__name__}: {error}"])
