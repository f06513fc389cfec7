"""P1, P2, P6, P7, P16, P21: bugs on purpose in what makes commands, met by the guard."""

from collections.abc import Callable

import numpy as np

from robotctl.control.operator import Verb
from robotctl.hal.can.arm import CanArm
from robotctl.hal.can.cia402.codec import Mode, Service, Setpoint, encode_setpoint
from robotctl.hal.can.cia402.machine import Word
from robotctl.hal.can.damiao.codec import Special, encode_special
from robotctl.hal.can.joined import JoinedArm
from robotctl.hal.errors import HardwareError
from robotctl.hal.profile import Cia402Drive
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, Sent
from robotctl.safety.trip import Category, Protection
from robotctl.sim.trouble import Garble, Trouble
from robotctl.trials.bench import Bench
from robotctl.trials.clearing import Clears
from robotctl.trials.faults import Planted, between, fastest
from robotctl.trials.policies import against_limit, before_limit, velocities
from robotctl.trials.scenario import Scenario
from robotctl.trials.stops import Expected, Start, running, stop_scenario

_HOME_OFFSET = bytes((0x23, 0x7C, 0x60, 0, 1, 0, 0, 0))
"""SDO request that writes object 0x607C."""
_OVER = 1.02
"""Times a cap: just enough for what the wire rounds."""


def _garbled(
    field: str, change: Callable[[Bench, np.ndarray, int], float], times: float = 1
) -> Callable[[Bench], Planted]:
    """Return the fault that changes one value of a command, that of the fastest joint."""

    def plant(bench: Bench) -> Planted:
        axis = fastest(bench)

        def alter(command: Command) -> Command:
            values = getattr(command, field).copy()
            values[axis] = change(bench, values, axis)
            return command._replace(**{field: values})

        return between(bench, Garble(alter, times))

    return plant


def _too_fast(bench: Bench, values: np.ndarray, axis: int) -> float:
    return _OVER * float(bench.robot.limits.velocity[axis]) * (1.0 if values[axis] >= 0.0 else -1.0)


def _jump(_bench: Bench, values: np.ndarray, axis: int) -> float:
    return float(values[axis]) + 0.05


def _too_hard(bench: Bench, values: np.ndarray, axis: int) -> float:
    # Towards zero, so that the velocity cap has nothing to say.
    change = 20.0 * bench.robot.limits.acceleration[axis] * bench.robot.period_ns * 1e-9
    return float(values[axis] - np.sign(values[axis]) * change)


def _too_strong(bench: Bench, _values: np.ndarray, axis: int) -> float:
    return _OVER * float(bench.robot.limits.torque[axis])


def _too_sudden(bench: Bench, values: np.ndarray, axis: int) -> float:
    return (1.0 if values[axis] < 0.0 else -1.0) * 0.98 * float(bench.robot.limits.torque[axis])


def _no_number(_bench: Bench, _values: np.ndarray, _axis: int) -> float:
    return float("nan")


def _shaper_that_does_not_stop(bench: Bench) -> Planted:
    """The shaper forgets the soft limits: what the limiter made smooth goes out as it is."""
    box = bench.loop._motion._shaper._box  # the bug is planted where it would be
    edge = box._edge.copy()
    box._edge = edge + 1.0
    box._free = box._free + 1.0

    def undo() -> None:
        box._edge = edge
        box._free = box._free - 1.0

    # A sound shaper brakes before the guard has anything to say.
    return Planted(undo, lambda: bench.trips[0]["protection"] == Protection.SOFT_LIMIT.label)


def _burst(bench: Bench) -> Planted:
    """A command goes out many times."""

    class Burst(Trouble):
        def on_write(self, command: Command) -> Command | Sent:
            self.acted += 1
            for _ in range(300 if self.acted == 1 else 0):
                bench.arm.arm.write(command)
            return command

    return between(bench, Burst())


def _stray(identifier: int, data: bytes) -> Callable[[Bench], Planted]:
    """Return the fault that sends a frame which no driver of ours would."""

    def plant(bench: Bench) -> Planted:
        arm = bench.arm.arm
        if isinstance(arm, JoinedArm):
            arm = arm.arms[0]
        assert isinstance(arm, CanArm)
        before = bench.count("withheld")
        arm._require_open().send(identifier, data)
        return Planted(lambda: None, lambda: bench.count("withheld") > before)

    return plant


def _forbidden(robot: Robot) -> tuple[tuple[int, bytes], tuple[int, bytes]]:
    """Return the frames (id, data) that would set the zero of the first drive, and clear its fault."""
    drive = robot.profile.joints[0].drive
    assert drive is not None
    if isinstance(drive, Cia402Drive):
        reset = encode_setpoint(Setpoint(Word.FAULT_RESET, Mode.POSITION, 0))
        return (Service.SDO + drive.id, _HOME_OFFSET), (Service.RPDO1 + drive.id, reset)
    return (drive.id, encode_special(Special.SET_ZERO)), (drive.id, encode_special(Special.CLEAR_ERROR))


def _enabled_too_early(bench: Bench) -> Planted:
    try:
        bench.arm.arm.enable()
    except HardwareError:
        refused = True
    else:
        refused = False
    return Planted(lambda: None, lambda: refused)


def _pushing(bench: Bench) -> None:
    bench.place(before_limit(bench))
    bench.start(velocities(against_limit(bench)))
    bench.run(0.05)


def _elsewhere(bench: Bench) -> Planted:
    def alter(command: Command) -> Command:
        return command._replace(position=command.position + 0.1)

    planted = between(bench, Garble(alter))
    bench.demand(Verb.ARM)
    return planted


def _ready(_bench: Bench) -> None:
    """Armed by the fault itself."""


def scenarios(robot: Robot, backend: str) -> list[Scenario]:
    def bug(
        protection: Protection, name: str, provoked: str, fault: Callable[[Bench], Planted], start: Start = running
    ) -> Scenario:
        stop = Category.BRAKE_OFF
        expected = Expected(protection=protection, category=stop, ends=stop, clears=Clears.POWER)
        return stop_scenario(protection.value, name, f"a bug: {provoked}", fault, expected, start)

    # On the wire the drives hold from the moment on at which they come on, so that it is a jump like any other.
    elsewhere = Expected(
        protection=Protection.BUMP if backend == "sim" else Protection.VELOCITY,
        category=Category.BRAKE_OFF,
        clears=Clears.ACK if backend == "sim" else Clears.POWER,
        within_s=0.1,
    )
    found = [
        bug(Protection.VELOCITY, "guard, speed", "2 % above a velocity cap", _garbled("velocity", _too_fast)),
        bug(Protection.VELOCITY, "guard, jump", "a position 0.05 rad further at once", _garbled("position", _jump)),
        stop_scenario(
            2,
            "guard, limit",
            "a bug: the shaper forgets the soft limits under a policy that pushes",
            _shaper_that_does_not_stop,
            Expected(
                protection=Protection.SOFT_LIMIT,
                category=Category.BRAKE_OFF,
                clears=Clears.POWER,
                within_s=3.0,
                rest_s=0.5,  # braking that rounds to more than the guard allows is cut off
                excused=frozenset({"position"}),  # the guard lets pass what the shaper keeps free for tracking
            ),
            _pushing,
        ),
        bug(Protection.ACCELERATION, "guard, step", "20 times an acceleration cap", _garbled("velocity", _too_hard)),
        bug(Protection.TORQUE, "guard, torque", "2 % above a torque cap", _garbled("effort", _too_strong)),
        bug(
            Protection.TORQUE,
            "guard, torque rate",
            "from one torque to nearly the cap on the other side",
            _garbled("effort", _too_sudden),
        ),
        bug(Protection.FRAMES, "burst", "a command goes out 300 times at once", _burst),
        stop_scenario(
            21,
            "start elsewhere",
            "a bug: the first command after enabling is 0.1 rad away",
            _elsewhere,
            elsewhere,
            _ready,
        ),
    ]
    if backend == "can":
        zero, clearing = _forbidden(robot)
        found += [
            bug(Protection.FRAMES, "foreign id", "a frame with an id that is not on the list", _stray(0x123, bytes(8))),
            bug(Protection.FRAMES, "zero under way", "a frame that sets a drive's zero", _stray(*zero)),
            bug(Protection.FRAMES, "fault cleared under way", "a frame that clears a drive's fault", _stray(*clearing)),
        ]
    return found
