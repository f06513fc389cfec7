"""P10, P11, P23, P27, P28, P30 with real processes under real signals."""

import os
import resource
import signal
import time
from contextlib import suppress

from robotctl.hal.robot import Robot
from robotctl.safety.trip import Category, Protection
from robotctl.trials.live import LATE_S, Live, Strike, live_stop_scenario, live_tolerated_scenario
from robotctl.trials.scenario import Scenario
from robotctl.trials.stops import Expected

_POLICY_S = 0.05
_BREATH_S = 0.3
_SMALL = 200_000
"""Bytes that a recorder may write once its disk is full."""


def _send(part: str, *numbers: signal.Signals, wait_s: float = 0.0) -> Strike:
    """Return the strike that sends a process of the run some signals, with a wait between them."""

    def strike(live: Live) -> None:
        pid = live.pids[part]
        os.kill(pid, numbers[0])
        for number in numbers[1:]:
            live.session.advance(wait_s)
            with suppress(ProcessLookupError):  # it may have been ended meanwhile
                os.kill(pid, number)

    return strike


def _fall_silent(_live: Live) -> None:
    """This process, the operator's, is suspended."""
    time.sleep(1.5)


def _fill_disk(live: Live) -> None:
    limit = (_SMALL, _SMALL)
    resource.prlimit(live.pids["recorder"], resource.RLIMIT_FSIZE, limit)
    live.session.advance(1.0)


def scenarios(robot: Robot, _backend: str) -> list[Scenario]:
    safety = robot.profile.safety
    silent = Expected(
        protection=Protection.HEARTBEAT,
        category=Category.BRAKE_HOLD,
        within_s=safety.heartbeat_s + _POLICY_S + LATE_S,
    )
    estop = Expected(protection=Protection.ESTOP, category=Category.BRAKE_OFF, within_s=LATE_S)
    watched = Expected(protection=Protection.WATCHMAN, category=Category.BRAKE_HOLD, within_s=1.0 + LATE_S)
    operator = Expected(protection=Protection.OPERATOR, category=Category.BRAKE_HOLD, within_s=1.1 + LATE_S)
    stood_still = Expected(
        protection=Protection.OVERRUN,
        category=Category.BRAKE_OFF,
        within_s=0.06 + LATE_S,
        rest_s=0.4,
        excused=frozenset({"position", "velocity", "sphere"}),  # nobody led the drives meanwhile
    )
    kill, stop, go = signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT
    return [
        live_stop_scenario(10, "killed", "kill -9 of the policy", _send("policy", kill), silent, 2),
        live_stop_scenario(10, "suspended", "SIGSTOP of the policy", _send("policy", stop), silent),
        live_tolerated_scenario(
            10,
            "process back in time",
            "the policy is suspended for 0.3 s",
            _send("policy", stop, go, wait_s=_BREATH_S),
            trips=("P10",),
        ),
        live_stop_scenario(
            11,
            "suspended",
            "the control process is suspended for 30 ms",
            _send("control", stop, go, wait_s=0.03),
            stood_still,
        ),
        live_stop_scenario(
            23, "robotctl stop", "the signal of `robotctl stop`", _send("control", signal.SIGUSR1), estop
        ),
        live_stop_scenario(27, "watchman killed", "kill -9 of the watchman", _send("watchman", kill), watched),
        live_tolerated_scenario(28, "recorder killed", "kill -9 of the recorder", _send("recorder", kill), "signal 9"),
        live_tolerated_scenario(
            28, "recorder suspended", "the recorder is suspended for 1 s", _send("recorder", stop, go, wait_s=1.0)
        ),
        live_tolerated_scenario(28, "disk full", "the recorder may write no more", _fill_disk, "File too large"),
        live_stop_scenario(30, "suspended", "the operator's process is suspended", _fall_silent, operator),
    ]
