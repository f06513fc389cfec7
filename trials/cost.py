"""What the layers of safety cost: every call of shapers and guard is timed where it is made, under hostile policies.

In processor time, so that other work on the machine counts only by what it does to the caches.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from robotctl.control.session import LockstepSession
from robotctl.hal.arm import Inspector
from robotctl.hal.robot import Robot
from robotctl.trials.policies import outward, random
from robotctl.trials.soak import POLICY_S, put_action

POLICIES = {"random": random, "outward": outward}
MODES = {"velocity": "_shaper", "torque": "_torque_shaper"}
"""Modes, and the shaper that a motion has for each."""
_WARM_UP = 200


class Stopwatch:
    """Times calls."""

    def __init__(self) -> None:
        self.spent: list[int] = []

    def around(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return `call`, timed."""

        def timed(*arguments: Any) -> Any:
            begun = time.thread_time_ns()
            result = call(*arguments)
            self.spent.append(time.thread_time_ns() - begun)
            return result

        return timed

    def report(self) -> dict[str, float]:
        """Return median and 99th percentile, us, without the first calls."""
        p50, p99 = np.percentile(self.spent[_WARM_UP:], (50, 99)) / 1e3
        return {"calls": len(self.spent), "p50": round(float(p50), 1), "p99": round(float(p99), 1)}


class TimedGuard:
    """An inspector that asks another one, and times it."""

    def __init__(self, guard: Inspector, stopwatch: Stopwatch) -> None:
        self.frames = stopwatch.around(guard.frames)
        self.command = stopwatch.around(guard.command)
        self.enabling = guard.enabling


def bench_safety(robot: Robot, backend: str, mode: str, policy: str, ticks: int, seed: int = 0) -> dict[str, Any]:
    """Time the shaper of a mode, and the guard, for `ticks` servo periods in lockstep.

    Raises:
        Stopped: if a protection stops the arm.
    """
    shaping, guarding = Stopwatch(), Stopwatch()
    with LockstepSession(robot, backend) as session:
        session.prepare()
        motion = session.loop._motion
        shaper = getattr(motion, MODES[mode])
        call = "step" if mode == "velocity" else "push"
        setattr(shaper, call, shaping.around(getattr(shaper, call)))
        session._rig.arm.inspect_with(TimedGuard(session.loop._guard, guarding))
        act = POLICIES[policy](robot, np.random.default_rng(seed))
        begun = session.clock.now_ns()
        session.begin()
        for seq in range(1, 1 + round(ticks * robot.period_ns * 1e-9 / POLICY_S)):
            action = act((session.clock.now_ns() - begun) * 1e-9, session.latest()["position"])
            put_action(session, mode, seq, action)
            session.advance(POLICY_S)
        session.end()
    return {"backend": backend, "mode": mode, "policy": policy, "shaper": shaping.report(), "guard": guarding.report()}
