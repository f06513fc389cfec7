"""Rehearsals: a reset routine runs in the MuJoCo twin first, from where the real arm was measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotctl.control.operator import Verb
from robotctl.control.session import LockstepSession, Session, Stopped
from robotctl.control.task_reset import Step
from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.machine import State
from robotctl.safety.shaper import Clip

_BACKEND = "sim"
_STALL_S = 5.0
"""Simulated time in which a routine has to get on; one that does not would only be tried again."""
_STALL = 1e-2
"""rad"""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """What a rehearsal found."""

    failure: str
    """Why the routine did not arrive, with the trip that stopped it; empty if it did."""
    duration_s: float
    """From the routine's start to its end, simulated."""
    violations: Mapping[str, int]
    """Ticks beyond each bound, judged on the twin's true state."""
    tool_speed: float
    """Largest true speed of the tool, m/s."""

    @property
    def objection(self) -> str:
        """Return why the real arm must not do the same; empty if it may."""
        broken = [f"{key} in {ticks} ticks" for key, ticks in self.violations.items() if ticks]
        return "; ".join([self.failure] * bool(self.failure) + [f"it violated {each}" for each in broken])


def rehearse(robot: Robot, start: Vector, routine: Verb, argument: int = 0, reset: Sequence[Step] = ()) -> Rehearsal:
    """Run a reset routine in the twin, as fast as the machine allows, and say how it went.

    The twin knows the arm's limits, regions and dynamics, and nothing of what stands around it. It wakes up in the
    measured pose; where tracking has left that a hair outside the limits, it is led back inside first.

    Args:
        start: measured joints (n,), rad.
        reset: the steps of TASK_RESET. The twin has nothing to push or to hold, so they take the whole way.
    """
    twin = robot.profile.twin.model_copy(update={"start": start.tolist()})
    there = replace(robot, profile=robot.profile.model_copy(update={"twin": twin}))
    with LockstepSession(there, _BACKEND, reset=reset) as session:
        session.request(Verb.ARM)
        session.advance(robot.period_ns * 1e-9)
        failure = ""
        if session.latest()["clip"] & Clip.RECOVERY and routine is not Verb.RETREAT:
            failure = _run(session, Verb.RETREAT, 0)
        began_ns = session.clock.now_ns()
        failure = failure or _run(session, routine, argument)
        duration_s = (session.clock.now_ns() - began_ns) * 1e-9
        records, _, _ = session.link.ticks.since(0)
        steps = np.diff(records["true_tool"], axis=0) * robot.profile.servo_hz
        speed = float(np.linalg.norm(steps, axis=1).max())
        return Rehearsal(failure, duration_s, dict(session.judge.violations), speed)


def _run(session: Session, routine: Verb, argument: int) -> str:
    """Run one routine, once. Returns why it did not arrive."""
    try:
        session.request(routine, argument)
    except Stopped as error:
        return error.what
    ring, window = session.link.ticks, round(_STALL_S * session.robot.profile.servo_hz)
    first = ring.head
    while session.state is State.RESET:
        session.advance(0.05)
        if ring.head - first >= window:
            records, first, _ = ring.since(first)
            if np.abs(records[-1]["command_position"] - records[0]["command_position"]).max() < _STALL:
                held = Clip(int(np.bitwise_or.reduce(records["clip"])))
                return f"it got no further, held back by {held.name}"
    return "" if session.state is State.ARMED else session.trips[-1]["text"]
