"""`emulated`: a python-can bus that ends in emulated drives, in the same process and without a thread.

Time is the clock's that it was opened with: the plant stands still between two calls and catches up in the next one.
So the same bus runs in real time and in lockstep, and the same calls at the same times give the same answers.
"""

import errno
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import can

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.error_frames import ERROR_CONTROLLER, PASSIVE_DATA, RECOVERED_DATA, UNACKNOWLEDGED
from robotctl.hal.clock import Clock
from robotctl.hal.robot import Robot
from robotctl.sim.motors.bench import Bench
from robotctl.sim.motors.shared_plant import SharedPlant

_POLL_NS = 1_000_000

QUEUE = 64
"""Frames that wait while nobody acknowledges them: the transmit queue that docs/can.md asks for."""


class _Witness:
    """Fulfils `Witness`: sees what leaves for the drives."""

    def __init__(self, witnesses: "list[_Witness]") -> None:
        self.seen: deque[can.Message] = deque()
        self._witnesses = witnesses
        witnesses.append(self)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self.seen.popleft() if self.seen else None

    def shutdown(self) -> None:
        self._witnesses.remove(self)


class EmulatedBus(can.BusABC):  # type: ignore[misc]
    """The bus between a host and the drives of a `Bench`, which is the host's `Outbox` as well.

    Replies of CAN FD are lost unless `fd`. While no drive has power, or somebody else keeps the bus, frames wait.
    """

    def __init__(
        self, bench: Bench, clock: Clock, fd: bool = True, advance: Callable[[int], None] | None = None
    ) -> None:
        """Take the drives; `advance` lets time pass until a time in ns, by default for this bus alone."""
        super().__init__(channel="emulated")
        self.channel_info = "emulated drives"
        self.bench = bench
        self.failure: Exception | None = None
        """Raised by every send while it is set: an adapter that was unplugged, a queue that is full."""
        self.occupied = False
        """Whether a node that goes first, by its ids, leaves no room for anybody else."""
        self.purges = True
        """Whether `purge` does what it says; on a host it may fail without a word."""
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._witnesses: list[_Witness] = []
        self._errors: deque[can.Message] = deque()
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self._fd = fd
        self._clock = clock
        self._now = clock.now_ns
        self.advance = advance or bench.advance
        self._receive = bench.receive
        self._replies = bench.replies
        self._wire_errors = bench.errors

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand a frame to the drives. Never waits.

        Raises:
            can.CanOperationError: for a CAN FD frame on a classic bus.
        """
        self.advance(self._now())
        if self.failure is not None:
            raise self.failure
        if msg.is_fd and not self._fd:
            raise can.CanOperationError("a CAN FD frame cannot be sent on a classic bus")
        if msg.is_extended_id or msg.is_remote_frame or msg.is_error_frame:
            return
        if self._is_blocked():
            self._wait(msg)
            return
        if self._witnesses:
            self._show(msg.arbitration_id, msg.data)
        self._receive(msg.arbitration_id, msg.data)

    # --- the outbox -------------------------------------------------------------------------------------------------

    def waiting(self) -> bool:
        self.advance(self._now())
        return self._is_blocked() and bool(self._waiting)

    def purge(self) -> None:
        if self.purges:
            self._waiting.clear()

    def witness(self) -> _Witness:
        return _Witness(self._witnesses)

    def _is_blocked(self) -> bool:
        """Return whether no frame leaves now. When that is over, those that have waited leave first."""
        if self.occupied or not self.bench.hears:
            return True
        if self._waiting:
            self.report(ERROR_CONTROLLER, RECOVERED_DATA)
            while self._waiting:
                arbitration_id, data = self._waiting.popleft()
                self._show(arbitration_id, data)
                self._receive(arbitration_id, data)
        return False

    def _wait(self, msg: can.Message) -> None:
        if len(self._waiting) >= QUEUE:
            raise can.CanOperationError("no buffer space available", errno.ENOBUFS)
        if not self.occupied:
            self._wire_errors.append(UNACKNOWLEDGED)
            if not self._waiting:
                # After 16 tries of the first frame, which take 2 ms.
                self.report(ERROR_CONTROLLER, PASSIVE_DATA)
        self._waiting.append((msg.arbitration_id, bytes(msg.data)))

    def _show(self, arbitration_id: int, data: bytes) -> None:
        for witness in self._witnesses:
            witness.seen.append(can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False))

    def report(self, error_class: int, data: bytes = bytes(8)) -> None:
        """Let the host receive an error frame of its controller, in SocketCAN's terms (linux/can/error.h)."""
        self._errors.append(can.Message(arbitration_id=error_class, is_error_frame=True, data=data))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next reply, or None when none comes within `timeout` seconds of the clock; None waits for ever."""
        self.advance(self._now())
        if self._waiting:
            self._is_blocked()
        message = self._pop()
        if message is not None or timeout == 0.0:
            return message
        deadline = None if timeout is None else self._now() + int(timeout * 1e9)
        while message is None:
            now = self._now()
            if deadline is not None and now >= deadline:
                return None
            self._clock.sleep_until(now + _POLL_NS if deadline is None else min(now + _POLL_NS, deadline))
            self.advance(self._now())
            message = self._pop()
        return message

    def _pop(self) -> can.Message | None:
        if self._errors:
            return self._errors.popleft()
        if self._wire_errors:
            self.report(*self._wire_errors.popleft())
            return self._errors.popleft()
        replies = self._replies
        while replies:
            arbitration_id, data, fd, stamp_ns = replies.popleft()
            if fd and not self._fd:
                continue
            message = can.Message(
                stamp_ns * 1e-9, arbitration_id, False, False, False, None, len(data), data, fd, True, fd
            )
            if self._filters is None or self._matches_filters(message):
                return message
        return None


def open_emulated(robot: Robot, clock: Clock) -> Channel:
    """Return the emulated drives of a robot. Entry point `emulated` of the group `robotctl.channels`.

    Where they are on several buses, the first one's channel holds the others.

    Raises:
        ConfigError: if the robot has no CAN drives.
    """
    fd = robot.profile.can is not None and robot.profile.can.fd
    if robot.profile.buses == 1:
        return _channel(EmulatedBus(Bench(robot, clock.now_ns()), clock, fd), fd)
    shared = SharedPlant(robot, clock.now_ns())
    first, *others = (_channel(EmulatedBus(bench, clock, fd, shared.advance), fd) for bench in shared.benches)
    return replace(first, others=tuple(others))


def _channel(bus: EmulatedBus, fd: bool) -> Channel:
    return Channel(bus, fd, truth=bus.bench.plant.truth, simulated=True, outbox=bus)
