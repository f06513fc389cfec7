"""The guard: the last look at everything that leaves for the drives. It passes it on or refuses it; it never alters.

It knows the profile, the state, the time and what was measured, and nothing of what makes commands. On CAN it reads
the encoded frames, on an arm without a wire the command. A refusal in normal work means a bug in whatever made the
command, so the arm is stopped on account of the limit that was passed (P1, P2, P6, P7, P16 or P21).
"""

import math
from collections.abc import Callable, Sequence

from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, CommandMode, Sample
from robotctl.safety.asked import EXACT, Asked, Kind, Move, Refusal
from robotctl.safety.joint_guard import JointGuard
from robotctl.safety.machine import ENABLED, State
from robotctl.safety.trip import Protection
from robotctl.safety.wire import reading_of

_LONGEST = 26
"""Periods that a motion may make up for: as many as the loop does after a gap, and its own."""
_WINDOW_NS = 250_000_000
_SURPLUS = 1.5
"""Motion messages may come at this multiple of the servo rate, counted over a window ..."""
_RETRIES = 50
"""... with so many more for what bring-up repeats."""

_OPEN = frozenset(State) - {State.OFF}
PERMITTED: dict[Kind, frozenset[State]] = {
    Kind.READ: _OPEN,
    # Whatever else happens, torque may be taken away.
    Kind.DISABLE: _OPEN,
    Kind.MODE: frozenset({State.SILENT}),
    Kind.START: frozenset({State.SILENT, State.ARMED}),
    Kind.ENABLE: frozenset({State.ARMED}),
    Kind.TRACK: ENABLED,
    Kind.TORQUE: frozenset({State.RUN}),
    Kind.DAMP: ENABLED | {State.DISABLED, State.FAULT},
    # What the gripper holds is not let go while the arm is damped.
    Kind.GRIP: ENABLED | {State.DISABLED, State.FAULT},
    # Faults and zeros are a person's business, at a service tool, never that of a running arm.
    Kind.CLEAR: frozenset(),
    Kind.ZERO: frozenset(),
    Kind.STORE: frozenset(),
}
"""The states in which each kind of message may leave."""

_RATED = ENABLED - {State.STOPPING}
"""The states in which motions are counted: a stop is never kept back because of what came before it."""
_STANDING = frozenset({State.ARMED, State.HOLD})


class Guard:
    """Guards one arm. Fulfils `hal.arm.Inspector`: what judges returns "" or the reason to keep a message back."""

    def __init__(self, robot: Robot, state: Callable[[], State]) -> None:
        """Take the robot, and where to look up the supervisor's present state."""
        profile = robot.profile
        self._state = state
        self._period_ns = robot.period_ns
        self._power = profile.safety.power
        self._most = round(_SURPLUS * _WINDOW_NS / robot.period_ns) + _RETRIES
        self._joints = [JointGuard(joint, profile.safety) for joint in profile.joints]
        self._wire = reading_of(profile)
        self._gains = [(joint.gains.kp, joint.gains.kd) for joint in profile.joints]
        self._measured = [(math.nan, math.nan)] * robot.dof
        self._now_ns: int | None = None
        self._time_ns = 0
        """Wall time that the next motion has: since the last one, and up to a period that that one left over."""
        self._passed = False
        self._window_ns = 0
        self._cycles = [0] * robot.dof
        self._refusal: Refusal | None = None

    def observe(self, sample: Sample, now_ns: int, late_ns: int = 0) -> None:
        """Begin a tick, at `now_ns`, so much later than it was due; `sample` is what was measured."""
        self._measured = list(zip(sample.position.tolist(), sample.velocity.tolist(), strict=True))
        period = self._period_ns
        if self._passed:
            self._time_ns = min(max(self._time_ns - period, 0), period)
            self._passed = False
        since = period + min(late_ns, period) if self._now_ns is None else now_ns - self._now_ns
        self._time_ns = min(self._time_ns + since, _LONGEST * period)
        self._now_ns = now_ns
        if now_ns - self._window_ns >= _WINDOW_NS:
            self._window_ns, self._cycles = now_ns, [0] * len(self._cycles)
        if self._state() not in ENABLED:
            self._time_ns = period
            for joint in self._joints:
                joint.forget()

    def take(self) -> Refusal | None:
        """Return the first refusal since the last call, if there was one."""
        refusal, self._refusal = self._refusal, None
        return refusal

    @property
    def passed(self) -> bool:
        """Whether a motion has left since the tick began."""
        return self._passed

    # -- what may leave -------------------------------------------------------------------------------------------

    def enabling(self) -> str:
        return self._permit(Kind.ENABLE)

    def command(self, command: Command) -> str:
        n = len(self._joints)
        gains = self._gains if command.mode is CommandMode.TRACK else [(0.0, 0.0)] * n
        if command.mode is CommandMode.DAMP:
            gains = [(0.0, kd) for _, kd in self._gains]
        still = [0.0] * n
        velocity = command.velocity.tolist() if command.mode is CommandMode.TRACK else still
        fields = zip(command.position.tolist(), velocity, gains, command.effort.tolist(), strict=True)
        return self._motion([Move(i, Asked.of(p, v, kp, kd, t), EXACT) for i, (p, v, (kp, kd), t) in enumerate(fields)])

    def frames(self, frames: Sequence[tuple[int, bytes]]) -> str:
        motions = []
        for found in self._wire.read(frames, self._measured):
            if isinstance(found, Move):
                motions.append(found)
            elif isinstance(found, str):
                return self._refuse(Refusal(Protection.FRAMES, found))
            else:
                refusal = self._permit(found)
                if refusal:
                    return refusal
        return self._motion(motions) if motions else ""

    # -- inside ---------------------------------------------------------------------------------------------------

    def _permit(self, kind: Kind) -> str:
        state = self._state()
        if state in PERMITTED[kind]:
            return ""
        return self._refuse(Refusal(Protection.FRAMES, f"{kind.name} is not permitted in state {state.name}"))

    def _motion(self, motions: Sequence[Move]) -> str:
        """Judge what joints are asked together; all of it leaves, or nothing."""
        state = self._state()
        standing = state in _STANDING
        seconds = self._time_ns * 1e-9
        power = 0.0
        for index, asked, step in motions:
            if state not in PERMITTED[asked.kind]:
                return self._permit(asked.kind)
            self._cycles[index] += 1
            if self._cycles[index] > self._most and state in _RATED:
                return self._refuse(Refusal(Protection.FRAMES, f"more than {self._most} motions within 0.25 s"))
            position, velocity = self._measured[index]
            refusal = self._joints[index].refuse(asked, step, position, velocity, seconds, standing=standing)
            if refusal is not None:
                return self._refuse(refusal)
            power += abs(asked.effort * asked.velocity)
        if power > self._power:
            return self._refuse(Refusal(Protection.TORQUE, f"a power of {power:.0f} W, {self._power:g} W are allowed"))
        for index, asked, _ in motions:
            self._joints[index].keep(asked)
        self._passed = True
        return ""

    def _refuse(self, refusal: Refusal) -> str:
        self._refusal = self._refusal or refusal
        return refusal.text
