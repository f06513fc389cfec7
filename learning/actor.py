"""Who runs the policy of an episode: this process in lockstep, or a process of its own in real time."""

import json
import os
import select
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from types import TracebackType
from typing import Self

from robotctl.control.kinematics import Kinematics
from robotctl.control.process_session import ProcessSession
from robotctl.control.session import LockstepSession
from robotctl.hal.errors import ConfigError, HardwareError
from robotctl.hal.types import Vector
from robotctl.learning.policies import Die, Stall, make_policy
from robotctl.learning.policy_process import VALID_PERIODS, PolicyConfig, target_of
from robotctl.learning.task import ReachTask

_START_TIMEOUT_S = 30.0
_BEGIN_TIMEOUT_S = 2.0


class Actor(ABC):
    """Feeds a session's mailbox during episodes."""

    @abstractmethod
    def start(self) -> None:
        """Get ready to act."""

    @abstractmethod
    def begin(self, goal: Vector) -> str:
        """Begin an episode towards `goal` (3,), m. Returns why it must not take place; empty if it has begun."""

    @abstractmethod
    def step(self) -> None:
        """One policy period is about to pass."""

    @abstractmethod
    def rest(self) -> None:
        """The episode is over."""

    @abstractmethod
    def close(self) -> None:
        """Release everything. Harmless when already closed."""

    @abstractmethod
    def obituary(self) -> str:
        """Return how the policy ended, if it did; else an empty text."""

    @property
    def pid(self) -> int | None:
        """Pid of the policy's process, if it has one."""
        return None

    def __enter__(self) -> Self:
        try:
            self.start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class InlineActor(Actor):
    """The policy in this process, stepped in lockstep. A policy that stalls or dies just falls silent."""

    def __init__(self, session: LockstepSession, task: ReachTask, policy: str, seed: int) -> None:
        self._session = session
        self._kinematics = Kinematics(session.robot)
        self._policy = make_policy(policy, session.robot, self._kinematics, seed)
        self._valid_ns = round(VALID_PERIODS * 1e9 / task.policy_hz)
        self._goal: Vector | None = None
        self._step = 0
        self._seq = 0
        self._ended = ""

    def start(self) -> None:
        """Nothing to start."""

    def begin(self, goal: Vector) -> str:
        refusal = self._policy.begin()
        self._goal = None if refusal else goal
        self._step = 0
        return refusal

    def step(self) -> None:
        if self._goal is None or self._ended:
            return
        deadline = self._session.clock.now_ns() + self._valid_ns
        try:
            record = self._session.latest()
            target = target_of(self._policy, record, self._goal, self._step, self._seq, deadline)
        except Stall:
            self._ended = "the policy stopped answering"
        except Die:
            self._ended = "the policy died"
        else:
            self._session.link.mailbox.put(target)
            self._seq += 1
            self._step += 1

    def rest(self) -> None:
        self._goal = None

    def close(self) -> None:
        """Nothing to release."""

    def obituary(self) -> str:
        return self._ended


class ProcessActor(Actor):
    """The policy in a process of its own, at its own pace."""

    def __init__(
        self, session: ProcessSession, task: ReachTask, policy: str, seed: int, overrides: Sequence[str] = ()
    ) -> None:
        self._session = session
        self._task = task
        self._policy = policy
        self._seed = seed
        self._overrides = list(overrides)
        self._process: subprocess.Popen[str] | None = None

    @property
    def pid(self) -> int | None:
        return self._process.pid if self._process else None

    def start(self) -> None:
        mailbox, board = self._session.fds
        view = os.open(f"/proc/self/fd/{board}", os.O_RDONLY)
        config = PolicyConfig(
            robot=str(self._session.robot.source),
            overrides=self._overrides,
            policy=self._policy,
            seed=self._seed,
            policy_hz=self._task.policy_hz,
            mailbox_fd=mailbox,
            board_fd=view,
            slots=self._session.link.ticks.slots,
            operator=os.getpid(),
        )
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "robotctl.learning.policy_process", config.to_json()],
                pass_fds=(mailbox, view),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
        finally:
            os.close(view)
        self._await_ready()

    def begin(self, goal: Vector) -> str:
        self._tell({"goal": [float(value) for value in goal]})
        # One that does not answer is not waited for: the supervisor misses its heartbeat.
        return str(self._answer(_BEGIN_TIMEOUT_S).get("refused", ""))

    def step(self) -> None:
        """It keeps its own time."""

    def rest(self) -> None:
        self._tell({"rest": True})

    def close(self) -> None:
        process = self._process
        if process is None:
            return
        if process.stdin is not None and not process.stdin.closed:
            with suppress(BrokenPipeError):  # it was killed; there is nothing left to tell
                process.stdin.close()
        try:
            process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()

    def obituary(self) -> str:
        status = self._process.poll() if self._process else None
        if status is None:
            return ""
        return (
            f"the policy process was killed by signal {-status}"
            if status < 0
            else f"the policy process ended ({status})"
        )

    def _tell(self, request: dict[str, object]) -> None:
        if self._process is None or self._process.stdin is None:
            raise HardwareError("the policy process was not started", "use the actor as a context manager")
        # If it is gone, the supervisor misses its heartbeat, which is where this belongs.
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()

    def _await_ready(self) -> None:
        words = self._answer(_START_TIMEOUT_S)
        if "error" in words:
            raise ConfigError(str(words["error"]))
        if not words:
            raise HardwareError("the policy process did not come up", "run it with --fast to see its error")

    def _answer(self, timeout_s: float) -> dict[str, object]:
        """Return the next thing that the policy process says; nothing if it does not within the time."""
        process = self._process
        deadline = time.monotonic() + timeout_s
        while process is not None and process.stdout is not None and time.monotonic() < deadline:
            self._session.advance(0.0)
            if select.select([process.stdout], [], [], 0.05)[0]:
                line = process.stdout.readline()
                return json.loads(line) if line else {}
        return {}
