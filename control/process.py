"""The control process: the loop in real time, alone, with nothing beside it that could make it late.

It is started by `control.process_session` and shares memory with it. It imports nothing that draws, learns, logs to
disk or serves a page. It ends when asked to, and stops the arm and ends by itself when its operator's process dies.
"""

import json
import os
import signal
import sys
from dataclasses import asdict, dataclass
from typing import Any

from robotctl.control import registry
from robotctl.control.frame_ring import FrameRing
from robotctl.control.loop import Loop
from robotctl.control.operator import Verb
from robotctl.control.process_tools import go_real_time, leave_real_time, name_process, signal_on_parent_death
from robotctl.control.shared import Link, Power
from robotctl.control.task_reset import parse
from robotctl.hal.backend import open_backend
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.errors import ConfigError, RobotctlError
from robotctl.hal.limits_text import difference
from robotctl.hal.robot import load_robot
from robotctl.safety.machine import State

_CLOSABLE = (State.READY, State.SILENT, State.FAULT)


@dataclass(frozen=True, slots=True)
class ProcessConfig:
    """What a control process is told at its start."""

    robot: str
    overrides: list[str]
    backend: str
    channel: str
    mailbox_fd: int
    board_fd: int
    slots: int
    frames_fd: int | None
    """Of the ring of raw frames; None for a backend without a bus."""
    frame_slots: int
    operator: int
    """Pid of the operator's process."""
    limits: str
    """The limits that the operator's process has seen: `Robot.limits_text`."""
    reset: list[dict[str, Any]]
    """The steps of TASK_RESET."""

    def to_json(self) -> str:
        return json.dumps(asdict(self))


def main(text: str) -> int:
    """Run one control process to its end and return its exit status."""
    config = ProcessConfig(**json.loads(text))
    name_process("robotctl-ctl")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the operator process's business
    try:
        robot = load_robot(config.robot, config.overrides)
        if robot.limits_text != config.limits:
            changes = difference(config.limits, robot.limits_text)
            raise ConfigError(f"{robot.source}: limits changed while it was being started:\n{changes}", "start again")
        link = Link.attach(config.mailbox_fd, config.board_fd, robot.dof, config.slots)
        clock = MonotonicClock()
        rig = open_backend(config.backend, robot, clock, config.channel)
        frames = None if config.frames_fd is None else FrameRing.attach(config.frames_fd, config.frame_slots)
        loop = Loop(robot, rig, clock, link, parse(config.reset), frames)
    except RobotctlError as error:
        print(error, file=sys.stderr)  # noqa: T201 - the memory is not mapped yet; the operator reads this
        return 2 if isinstance(error, ConfigError) else 4
    signal.signal(signal.SIGUSR1, lambda *_: loop.estop("robotctl stop"))
    signal.signal(signal.SIGTERM, lambda *_: loop.estop("SIGTERM"))
    entry = registry.register(robot.profile.name, config.backend, config.channel, config.operator)
    try:
        return _run(loop, link, clock, config)
    finally:
        leave_real_time()
        entry.unlink(missing_ok=True)


def _run(loop: Loop, link: Link, clock: MonotonicClock, config: ProcessConfig) -> int:
    try:
        loop.bring_up()
        missing = go_real_time()
        text = f"real time without {' and '.join(missing)}" if missing else "real time: SCHED_FIFO, memory locked"
        link.events.write({"type": "log", "stamp_ns": clock.now_ns(), "text": text})
        signal_on_parent_death(signal.SIGTERM, config.operator)
        _pace(loop, clock, config.operator)
    except RobotctlError as error:
        kind = "config" if isinstance(error, ConfigError) else "hardware"
        link.events.write({"type": "error", "stamp_ns": clock.now_ns(), "kind": kind, "text": str(error)})
        return 2 if kind == "config" else 4
    finally:
        statistics = loop.bus_statistics()
        try:
            if not (link.watch.beats and link.watch.power is Power.ON):  # else the watchman brings the arm down gently
                loop.shut_down()
        except RobotctlError as error:
            text = f"the arm was not left as it should be: {error}"
            link.events.write({"type": "error", "stamp_ns": clock.now_ns(), "kind": "hardware", "text": text})
            return 4
        finally:
            link.events.write({"type": "bus", "stamp_ns": clock.now_ns(), "statistics": statistics})
    return 0


def _pace(loop: Loop, clock: MonotonicClock, operator: int) -> None:
    """Tick at absolute deadlines until the loop is closed. Missed deadlines are skipped.

    The loop is told before it ticks how many: so its reference has made as many steps as periods have passed, and
    never runs ahead of wall time.
    """
    period = loop.robot.period_ns
    deadline = clock.now_ns() + period
    while not loop.closed:
        clock.sleep_until(deadline)
        loop.lateness_ns = clock.now_ns() - deadline
        loop.skipped = loop.lateness_ns // period
        loop.tick()
        if os.getppid() != operator and loop.supervisor.state in _CLOSABLE:
            loop.request(Verb.CLOSE)  # nobody is left who could ask for it
        deadline += period * (1 + loop.skipped)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
