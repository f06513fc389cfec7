"""P13, P27 on CAN: kill -9 of the control process, with the motors in a process of their own."""

import os
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from robotctl.control.session import Stopped
from robotctl.hal.errors import HardwareError
from robotctl.hal.profile import CLASSIC_HZ
from robotctl.hal.robot import Robot, load_robot
from robotctl.trials.emulator import Emulator
from robotctl.trials.live import ATTEMPTS, Live, under_way
from robotctl.trials.scenario import Scenario, Trial

_REPEATS = 2
_ROUNDING_S = 0.002
"""The motors look at the time once in a millisecond."""
_AFTER_S = 3.5
"""An arm without brakes is lowered first."""


def _control_killed(live: Live) -> None:
    os.kill(live.pids["control"], signal.SIGKILL)


def _both_killed(live: Live) -> None:
    for part in ("watchman", "control"):
        os.kill(live.pids[part], signal.SIGKILL)


def _taken_over(emulator: Emulator, robot: Robot, trial: Trial) -> None:
    """Require that every drive was taken before its own watchdog bit, and heard nothing but stops from then on."""
    frames = emulator.heard()
    last = max(frame.at_s for frame in frames if frame.kind == "track")
    after = [frame for frame in frames if frame.at_s > last]
    motors = {frame.motor for frame in after}
    first = [min(frame.at_s for frame in after if frame.motor == motor) - last for motor in motors]
    trial.require(len(motors) == robot.dof, f"only the motors {sorted(motors)} were taken")
    trial.require({frame.kind for frame in after} <= {"damp", "DISABLE"}, "something else than a stop was sent")
    trial.require(not emulator.lost(), f"their own watchdogs had to act: {emulator.lost()}")
    _in_time(emulator, robot, max(first, default=float("inf")), trial)
    trial.seen = "P27: the watchman switched the drives off"


def _off_by_themselves(emulator: Emulator, robot: Robot, trial: Trial) -> None:
    """Require that every drive's own watchdog acted."""
    lost = {name: after for name, after in emulator.lost().items() if name != "gripper"}
    trial.require(len(lost) == robot.dof, f"only {len(lost)} of {robot.dof} watchdogs acted")
    _in_time(emulator, robot, max(lost.values(), default=float("inf")), trial)
    trial.seen = "drives off by themselves"


def _strike(emulator: Emulator, robot: Robot, backend: str, seed: int, kill: Callable[[Live], None]) -> bool:
    """Bring an arm on the emulator under way, and kill; return whether it came so far."""
    overrides = (f"servo_hz={min(CLASSIC_HZ, robot.profile.servo_hz)}",)  # the adapter carries classic CAN
    slow = load_robot(str(robot.source), overrides)
    struck = False
    served = under_way(slow, backend, seed, lambda: emulator.channel, overrides)
    with emulator, suppress(HardwareError, Stopped), served as live:
        # Leaving it raises what has become of the control process.
        struck = not live.session.trips
        if struck:
            kill(live)
            time.sleep(_AFTER_S)
    return struck


def _in_time(emulator: Emulator, robot: Robot, reaction_s: float, trial: Trial) -> None:
    timeout = robot.profile.safety.drive_timeout_s
    trial.figures["reaction_s"] = reaction_s
    trial.require(reaction_s <= timeout + _ROUNDING_S, f"off after {1e3 * reaction_s:.0f} ms, not {1e3 * timeout:.0f}")
    trial.require(len(emulator.off() - {"gripper"}) == robot.dof, "not every drive went off")


def _bereft_scenario(
    number: int,
    name: str,
    provoked: str,
    kill: Callable[[Live], None],
    judge: Callable[[Emulator, Robot, Trial], None],
) -> Scenario:
    def run(robot: Robot, backend: str, seed: int) -> Trial:
        for attempt in range(ATTEMPTS):
            trial = Trial()
            with tempfile.TemporaryDirectory() as folder:
                emulator = Emulator(Path(folder), robot, robot.profile.safety.drive_timeout_s)
                if not _strike(emulator, robot, backend, seed + 100 * attempt, kill):
                    trial.require(False, "the machine was too busy")
                    continue
                judge(emulator, robot, trial)
            break
        return trial

    expected = "every drive off, in the time of its watchdog"
    return Scenario(number, name, f"{provoked}; in real time", expected, run, _REPEATS, real_time=True)


def scenarios(_robot: Robot, backend: str) -> list[Scenario]:
    if backend != "can":
        return []
    return [
        _bereft_scenario(
            13, "control and watchman killed", "kill -9 of control and watchman", _both_killed, _off_by_themselves
        ),
        _bereft_scenario(27, "control killed", "kill -9 of the control process", _control_killed, _taken_over),
    ]
