"""P8, P9, P10: what a policy may do wrong."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotctl.hal.robot import Robot
from robotctl.safety.target import JointVelocity, Target
from robotctl.safety.trip import Category, Protection
from robotctl.trials.bench import POLICY_S, Bench, Policy
from robotctl.trials.clearing import Clears
from robotctl.trials.faults import Planted
from robotctl.trials.policies import Act, outward, random, torques
from robotctl.trials.resuming import resuming_scenario
from robotctl.trials.scenario import Scenario
from robotctl.trials.shaping import shaped_scenario
from robotctl.trials.stops import Expected, stop_scenario


def replaced_by(make: Callable[[Bench, Policy], Policy]) -> Callable[[Bench], Planted]:
    """Return the fault of a policy that becomes another one."""

    def plant(bench: Bench) -> Planted:
        before = bench.policy
        assert before is not None
        calls: list[float] = []
        changed = make(bench, before)

        def policy(bench: Bench, time: float) -> Target | None:
            calls.append(time)
            return changed(bench, time)

        bench.policy = policy

        def undo() -> None:
            bench.policy = before

        return Planted(undo, lambda: bool(calls))

    return plant


def _once(bad: Callable[[Bench], np.ndarray], times: int = 1) -> Callable[[Bench], Planted]:
    """Return the fault of a policy that sends some malformed values, and behaves again."""

    def make(_bench: Bench, before: Policy) -> Policy:
        left = times

        def policy(bench: Bench, time: float) -> Target | None:
            nonlocal left
            if left == 0:
                return before(bench, time)
            left -= 1
            return JointVelocity(bad(bench), *bench.stamp())

        return policy

    return replaced_by(make)


def _with(value: float) -> Callable[[Bench], np.ndarray]:
    def values(bench: Bench) -> np.ndarray:
        made = np.zeros(bench.robot.dof)
        made[bench.random.integers(bench.robot.dof)] = value
        return made

    return values


def _silent(_bench: Bench, _before: Policy) -> Policy:
    return lambda _bench, _time: None


def _repeating(_bench: Bench, before: Policy) -> Policy:
    """The same target for ever: an old sequence number each time."""
    kept: list[Target | None] = []

    def policy(bench: Bench, time: float) -> Target | None:
        if not kept:
            kept.append(before(bench, time))
        return kept[0]

    return policy


def _of_yesterday(_bench: Bench, before: Policy) -> Policy:
    """Targets that had expired before they were sent."""

    def policy(bench: Bench, time: float) -> Target | None:
        target = before(bench, time)
        return None if target is None else target._replace(deadline_ns=bench.now_ns)

    return policy


def _outward(bench: Bench) -> Act:
    return outward(bench.robot, bench.random)


def _random(bench: Bench) -> Act:
    return random(bench.robot, bench.random)


def _strong(records: NDArray[Any], robot: Robot) -> bool:
    return bool((np.abs(records["wanted"]) > 0.3 * robot.limits.torque).any(axis=1).mean() > 0.1)


def scenarios(robot: Robot, _backend: str) -> list[Scenario]:
    safety = robot.profile.safety
    malformed = Expected(
        protection=Protection.MALFORMED, category=Category.BRAKE_HOLD, clears=Clears.START, within_s=0.05
    )
    repeated = replace(malformed, ends=Category.BRAKE_OFF, clears=Clears.ACK)
    silent = Expected(
        protection=Protection.HEARTBEAT,
        category=Category.BRAKE_HOLD,
        clears=Clears.START,
        within_s=safety.heartbeat_s,
    )
    later = replace(silent, within_s=safety.heartbeat_s + POLICY_S)
    bad = {
        "NaN": _with(np.nan),
        "infinity": _with(-np.inf),
        "wrong shape": lambda bench: np.zeros(bench.robot.dof + 1),
        "nothing": lambda _: np.zeros(0),
    }
    return [
        shaped_scenario(8, "outward torque", "torques push the tool out of its sphere", _outward, _strong, torques),
        shaped_scenario(8, "random torque", "random torques", _random, _strong, torques),
        *(stop_scenario(9, name, f"a policy sends {name}", _once(values), malformed) for name, values in bad.items()),
        stop_scenario(
            9, "again and again", "a policy sends NaN three times in a row", _once(_with(np.nan), 3), repeated
        ),
        stop_scenario(10, "silence", "a policy falls silent", replaced_by(_silent), silent),
        stop_scenario(10, "old targets", "a policy sends the same target again", replaced_by(_repeating), later),
        stop_scenario(10, "late targets", "a policy's targets have expired", replaced_by(_of_yesterday), silent),
        resuming_scenario(
            10, "back in time", "a policy is silent for 0.4 s", replaced_by(_silent), 0.4, (Protection.HEARTBEAT.label,)
        ),
    ]
