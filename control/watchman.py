"""P27: the watchman, a process beside every control process, which takes the drives when that one falls silent.

It sees the loop in the ring of ticks, whose head moves in every tick, and the process in /proc. When that is gone
without having switched its drives off, or its loop misses its beats for `safety.watchman_s` while it holds them, the
watchman ends it for good, so that it can never wake up and send another frame, and does the profile's category 0
action in its place. It outlives the operator's process; it ends when the control process has.

Drives that live in the control process, as the twin's and emulated ones do, go with it: then all there is to do is
to sound the alarm.
"""

import json
import signal
import sys
from dataclasses import asdict, dataclass

from robotctl.control import registry
from robotctl.control.legacy import Legacy, sound
from robotctl.control.other_process import OtherProcess
from robotctl.control.process_tools import WATCHMAN_PRIORITY, go_real_time, leave_real_time, name_process
from robotctl.control.pulse import Pulse
from robotctl.control.rescue import Rescue
from robotctl.control.shared import Link, Power
from robotctl.hal.backend import open_backend
from robotctl.hal.can.channel import is_shared, prepare_channel
from robotctl.hal.clock import Clock, MonotonicClock
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.machine import State

_LOOK_MS = 5
"""Between two looks at the loop and its process."""
LONGEST_RESCUE_S = 9
"""A bus can block whoever writes to it. Nobody may be left to end a watchman that hangs, so it ends by itself."""


@dataclass(frozen=True, slots=True)
class WatchmanConfig:
    """What a watchman is told at its start."""

    robot: str
    overrides: list[str]
    backend: str
    channel: str
    mailbox_fd: int
    board_fd: int
    slots: int
    control: int
    """Pid of the control process."""
    control_fd: int
    """Pidfd of the same."""
    operator: int
    """Pid of the operator's process."""

    def to_json(self) -> str:
        return json.dumps(asdict(self))


class Watchman:
    """Watches one loop until its process has ended. Without a `rescue` it can do no more than tell."""

    def __init__(self, robot: Robot, link: Link, clock: Clock, rescue: Rescue | None) -> None:
        self._link = link
        self._clock = clock
        self._rescue = rescue
        self._patience_ns = round(robot.profile.safety.watchman_s * 1e9)
        self._pulse = Pulse()
        self._silence_ns = 0

    def watch(self, control: OtherProcess) -> None:
        """Return once the control process is over, and its drives are off if that is in anybody's power."""
        while not control.is_over(_LOOK_MS):
            self._link.watch.beat()
            if not self.has_fallen_silent():
                continue
            what = f"the loop has stood still for {self._silence_ns / 1e6:.0f} ms"
            if self._rescue is None:
                sound(f"P27: {what}; its drives live in the same process")
                continue
            onset = self._clock.now_ns() - self._silence_ns + self._patience_ns
            control.kill()  # it must not wake up and send another frame
            _run(self._rescue, f"{what}, and its process was ended", onset)
            return
        if self._link.watch.power is not Power.OFF:
            self._mourn()

    def has_fallen_silent(self) -> bool:
        """Look at the loop, and return whether its time to show itself has just run out."""
        link, before = self._link, self._silence_ns
        power = link.watch.power
        silence = self._pulse.silence_ns((power, link.ticks.head), self._clock.now_ns())
        self._silence_ns = silence if power is Power.ON else 0
        return before < self._patience_ns <= self._silence_ns

    def _mourn(self) -> None:
        """Act on the end of a process that still held its drives."""
        legacy = Legacy(self._link, self._clock)
        ago = (self._clock.now_ns() - legacy.stamp_ns) / 1e6
        what = f"the control process died {ago:.0f} ms after its last tick"
        if self._rescue is not None:
            _run(self._rescue, what, legacy.stamp_ns)
            return
        legacy.trip(f"{what}, and its drives with it", legacy.stamp_ns)
        legacy.tick(State.FAULT)


def _run(rescue: Rescue, cause: str, onset_ns: int) -> None:
    signal.alarm(LONGEST_RESCUE_S)
    rescue.run(cause, onset_ns)
    signal.alarm(0)


def main(text: str) -> int:
    """Watch one control process to its end and return the exit status."""
    config = WatchmanConfig(**json.loads(text))
    name_process("robotctl-watch")
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1):
        signal.signal(number, signal.SIG_IGN)  # while there is a control process, somebody has to watch it
    robot = load_robot(config.robot, config.overrides)
    link = Link.attach(config.mailbox_fd, config.board_fd, robot.dof, config.slots)
    control, clock = OtherProcess(config.control, config.control_fd), MonotonicClock()
    rescue = None
    if is_shared(config.channel):
        prepare_channel(config.channel)
        rescue = Rescue(robot, link, clock, open_backend(config.backend, robot, clock, config.channel))
    name = robot.profile.name
    entry = registry.register(name, config.backend, config.channel, config.operator, watches=config.control)
    try:
        go_real_time(WATCHMAN_PRIORITY)
        Watchman(robot, link, clock, rescue).watch(control)
    finally:
        leave_real_time()
        registry.unregister(config.control)  # one that was killed could not do it itself
        entry.unlink(missing_ok=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
