"""Rehearsals: a reset routine runs in the MuJoCo twin first, from where the real arm was measured."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from robotctl.control.operator import Verb
from robotctl.control.session import LockstepSession, Session, Stopped
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


def rehearse(robot: Robot, start: Vector, routine: Verb, argument: int = 0) -> Rehearsal:
    """Run a reset routine in the twin, as fast as the machine allows, and say how it went.

    The twin knows the arm's limits, regions and dynamics, and nothing of what stands around it. It wakes up in the
    measured pose; where tracking has left that a hair outside the limits, it is led back inside first.

    Args:
        start: measured joints (n,), rad.
    """
    twin = robot.profile.twin.model_copy(update={"start": start.tolist()})
    there = replace(robot, profile=robot.profile.model_copy(update={"twin": twin}))
    with LockstepSession(there, _BACKEND) as session:
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
    began, before = session.clock.now_ns(), session.latest()["command_position"]
    while session.state is State.RESET:
        session.advance(0.05)
        if session.clock.now_ns() - began >= _STALL_S * 1e9:
            position = session.latest()["command_position"]
            if np.abs(position - before).max() < _STALL:
                held = Clip(int(session.latest()["clip"])).name
                return f"it got no further, held back by {held}"
            began, before = session.clock.now_ns(), position
    return "" if session.state is State.ARMED else session.trips[-1]["text"]
