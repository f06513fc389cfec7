"""A session whose loop runs in real time, in a control process, with a watchman beside it."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from robotctl.control import registry
from robotctl.control.frame_ring import FrameRing
from robotctl.control.operator import Verb
from robotctl.control.process import ProcessConfig
from robotctl.control.rehearsal import Rehearsal, rehearse
from robotctl.control.session import Session, Stopped, frame_slots, history_slots
from robotctl.control.shared import Link
from robotctl.control.task_reset import Step, dump
from robotctl.control.watchman import LONGEST_RESCUE_S, WatchmanConfig
from robotctl.hal.can.channel import is_shared, split_channels
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.errors import ConfigError, HardwareError
from robotctl.hal.robot import Robot
from robotctl.safety.machine import State
from robotctl.safety.trip import Protection

_START_TIMEOUT_S = 30.0
_BEAT_S = 0.05
"""How often the control process is shown that this one is alive."""
_CLOSE_TIMEOUT_S = 6.0
_RESCUE_TIMEOUT_S = LONGEST_RESCUE_S + 1.0
_CLOSABLE = (State.READY, State.FAULT, State.SILENT)


class ProcessSession(Session):
    """Starts, watches and ends one control process and its watchman."""

    def __init__(
        self,
        robot: Robot,
        backend: str,
        channel: str = "",
        overrides: Sequence[str] = (),
        reset: Sequence[Step] = (),
    ) -> None:
        """Take what the control process will be told; `reset` holds the steps of TASK_RESET."""
        super().__init__(robot, MonotonicClock(), Link.create(robot.dof, history_slots(robot)))
        if backend == "can":
            self.frames = FrameRing.create(frame_slots(robot))
        self._backend = backend
        self._channel = channel
        self._overrides = list(overrides)
        self._reset = list(reset)
        self._process: subprocess.Popen[bytes] | None = None
        self._watchman: subprocess.Popen[bytes] | None = None
        self._claims: list[socket.socket] = []
        self.rehearsals: list[Rehearsal] = []
        """What the reset routines looked like in the twin, in order."""
        self._bus: dict[str, object] | None = None
        self._error: dict[str, Any] | None = None
        self._bereaved = ""
        """What the watchman said when it took the place of the loop."""
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 - closed in close()

    @property
    def pid(self) -> int | None:
        """Pid of the control process."""
        return self._process.pid if self._process else None

    @property
    def watchman_pid(self) -> int | None:
        """Pid of the watchman."""
        return self._watchman.pid if self._watchman else None

    @property
    def fds(self) -> tuple[int, int]:
        """Descriptors of the mailbox and of the board, to be handed to neighbours."""
        if self.link.fds is None:
            raise HardwareError("the session's shared memory is closed")
        return self.link.fds

    def open(self) -> None:
        mailbox, board = self.fds
        config = ProcessConfig(
            robot=str(self.robot.source),
            overrides=self._overrides,
            backend=self._backend,
            channel=self._channel,
            mailbox_fd=mailbox,
            board_fd=board,
            slots=self.link.ticks.slots,
            frames_fd=None if self.frames is None else self.frames.fd,
            frame_slots=0 if self.frames is None else self.frames.slots,
            operator=os.getpid(),
            limits=self.robot.limits_text,
            reset=dump(self._reset),
        )
        shared = [mailbox, board]
        frames = [] if self.frames is None or self.frames.fd is None else [self.frames.fd]
        if is_shared(self._channel):
            # Inherited, so that the channels are taken for as long as any of the three processes lives.
            for one in split_channels(self._channel):
                self._claims.append(registry.claim(one))
                shared.append(self._claims[-1].fileno())
        self._process = subprocess.Popen(
            [sys.executable, "-m", "robotctl.control.process", config.to_json()],
            pass_fds=[*shared, *frames],
            stdin=subprocess.DEVNULL,
            stderr=self._complaints,
            start_new_session=True,  # Ctrl-C in the terminal must not reach it
        )
        self._start_watchman(self._process.pid, shared)
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not self.link.watch.beats or self.state is not State.READY:
            self._check()
            if time.monotonic() > deadline:
                raise HardwareError("the control process did not come up", "run robotctl doctor")
            if self._watchman is not None and self._watchman.poll() is not None:
                with suppress(subprocess.TimeoutExpired):  # which it follows, a little before this process learns of it
                    self._process.wait(1.0)
                self._check()
                raise HardwareError("the watchman ended before anything had begun", "run robotctl doctor")
            time.sleep(0.01)
        self.poll()

    def advance(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while True:
            self.link.desk.beat()
            self._check()
            remaining = deadline - time.monotonic()
            if remaining <= 0.0:
                break
            time.sleep(min(_BEAT_S, remaining))
        self.poll()

    def bring_to_rest(self, verb: Verb) -> None:
        self._check()  # an arm that its watchman brought down looks like one at rest
        super().bring_to_rest(verb)

    def reset(self, routine: Verb = Verb.HOME, argument: int = 0) -> None:
        """Run a reset routine to its end, after it went well in the twin (R2): else nothing moves.

        Lockstep sessions have no rehearsal: their arm is the twin. Settling needs none.
        """
        if self.state is State.ARMED and routine is not Verb.SETTLE:
            found = rehearse(self.robot, self.latest()["position"], routine, argument, self._reset)
            self.rehearsals.append(found)
            if found.objection:
                text = f"{routine.name} was rehearsed in the twin and is refused: {found.objection}"
                self.page(text)
                raise Stopped(text, "move the arm by hand, or change the pose or the region that bars its way")
            self.advance(0.0)  # show life after the silence, before something moves
        super().reset(routine, argument)

    def close(self) -> None:
        process = self._process
        if process is not None and process.poll() is None:
            self._bring_down(process)
        if process is not None:
            registry.unregister(process.pid)
            self._await_watchman()
            self.poll()
        self._complaints.close()
        for claim in self._claims:
            claim.close()
        if self.link.fds is not None:
            for fd in self.link.fds:
                os.close(fd)
            self.link.fds = None
        if self.frames is not None and self.frames.fd is not None:
            os.close(self.frames.fd)
            self.frames.fd = None

    def _start_watchman(self, control: int, shared: list[int]) -> None:
        mailbox, board = self.fds
        control_fd = os.pidfd_open(control)  # ours until it is waited for, so that no other process can be meant
        try:
            config = WatchmanConfig(
                robot=str(self.robot.source),
                overrides=self._overrides,
                backend=self._backend,
                channel=self._channel,
                mailbox_fd=mailbox,
                board_fd=board,
                slots=self.link.ticks.slots,
                control=control,
                control_fd=control_fd,
                operator=os.getpid(),
            )
            self._watchman = subprocess.Popen(
                [sys.executable, "-m", "robotctl.control.watchman", config.to_json()],
                pass_fds=[*shared, control_fd],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # it sounds its alarm on stderr, which is ours
                start_new_session=True,
            )
        finally:
            os.close(control_fd)

    def _await_watchman(self) -> None:
        """Wait until the watchman, too, is done: the control process has ended."""
        if self._watchman is None:
            return
        try:
            self._watchman.wait(_RESCUE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._watchman.kill()
            self._watchman.wait()
        registry.unregister(self._watchman.pid)

    def bus_statistics(self) -> dict[str, object] | None:
        return self._bus

    def _take_event(self, event: dict[str, Any]) -> None:
        super()._take_event(event)
        if event["type"] == "bus":
            self._bus = event["statistics"]
        elif event["type"] == "error":
            # A second one tells what the first has left behind.
            self._error = (
                event if self._error is None else self._error | {"text": f"{self._error['text']}\n{event['text']}"}
            )
        elif (
            event["type"] == "trip" and event["protection"] == Protection.WATCHMAN.label and not event["stop_category"]
        ):
            self._bereaved = event["text"]

    def _bring_down(self, process: subprocess.Popen[bytes]) -> None:
        deadline = time.monotonic() + _CLOSE_TIMEOUT_S
        asked = stopped = False
        while process.poll() is None and time.monotonic() < deadline:
            record = self.link.ticks.latest()
            # While a request is being served, the record tells of the state before it.
            if record is not None and self.link.desk.pending() is None:
                settled = State(int(record["state"])) in _CLOSABLE
                if settled and not asked:
                    self.link.desk.ask(Verb.CLOSE)
                elif not settled and not stopped:
                    process.send_signal(signal.SIGTERM)
                    stopped = True
                asked = settled
            time.sleep(0.01)
        if process.poll() is None:
            process.kill()  # its drives have watchdogs
            process.wait()

    def _check(self) -> None:
        """Raise if the control process is gone."""
        if self._process is None:
            raise HardwareError("the session is not open", "use it as a context manager")
        status = self._process.wait() if self._bereaved else self._process.poll()
        if status is None:
            return
        self._await_watchman()
        self.poll()
        if self._error is not None:
            error = ConfigError if self._error["kind"] == "config" else HardwareError
            raise error(self._error["text"])
        self._complaints.seek(0)
        complaint = self._complaints.read().decode(errors="replace").strip()
        if status == 2:
            raise ConfigError(complaint)
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        detail = f"\n{complaint}" if complaint else ""
        what = self._bereaved or "the drives go off by their own watchdogs"
        raise HardwareError(f"the control process {how}: {what}{detail}", "look at the arm, then start again")
