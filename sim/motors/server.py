"""Serves emulated drives to other processes, in real time, on any channel that frames can come from."""

import time
from collections.abc import Callable, Sequence
from typing import Protocol

import can

from robotctl.hal.clock import Clock
from robotctl.hal.errors import BusError
from robotctl.sim.motors.bench import Bench
from robotctl.sim.motors.drive import EmulatedDrive

POLL_S = 0.0005
"""Longest wait for a frame before time is let pass."""

LATE_NS = 10_000_000
"""A round that takes longer counts as this long: the drives stand still while this process does not get to run, for
otherwise their watchdogs would bite although the frames that feed them are waiting in a queue."""

_SEND_TIMEOUT_S = 0.002
_BATCH = 64
_FAILURES = 200


class Port(Protocol):
    """Where frames come from and replies go to."""

    @property
    def name(self) -> str:
        """What a client opens, e.g. slcan:/dev/pts/3."""
        ...

    @property
    def fd(self) -> bool:
        """Whether CAN FD frames pass."""
        ...

    @property
    def bitrate(self) -> int | None:
        """Nominal bit rate of the hosts, bit/s; None where the channel has none, or does not tell."""
        ...

    @property
    def carries_errors(self) -> bool:
        """Whether hosts can be sent error frames, as their controller would."""
        ...

    @property
    def garbage(self) -> int:
        """How much came in that was no frame."""
        ...

    def receive(self, timeout_s: float) -> list[can.Message]:
        """Return the frames that have arrived; wait for the first one, but not longer than `timeout_s`.

        Raises:
            BusError: if the channel is gone.
        """
        ...

    def send(self, frame: can.Message) -> bool:
        """Send a reply; return whether it left."""
        ...

    def close(self) -> None:
        """Release the channel."""
        ...


class BusPort:
    """A python-can bus as a port. Nothing that arrives ends it: only an interface that stays broken does."""

    bitrate = None
    carries_errors = True

    def __init__(self, name: str, bus: can.BusABC, fd: bool) -> None:
        self.name = name
        self.fd = fd
        self.garbage = 0
        self._bus = bus
        self._failures = 0

    def receive(self, timeout_s: float) -> list[can.Message]:
        frames: list[can.Message] = []
        while len(frames) < _BATCH:
            try:
                frame = self._bus.recv(0.0 if frames else timeout_s)
            except (can.CanError, OSError, ValueError, IndexError) as error:
                self._failed(error)
                return frames
            if frame is None:
                break
            frames.append(frame)
        self._failures = 0
        return frames

    def send(self, frame: can.Message) -> bool:
        try:
            self._bus.send(frame, _SEND_TIMEOUT_S)
        except (can.CanError, OSError, ValueError):
            return False
        return True

    def close(self) -> None:
        self._bus.shutdown()

    def _failed(self, error: Exception) -> None:
        self.garbage += 1
        self._failures += 1
        if self._failures >= _FAILURES:
            raise BusError(f"lost {self.name}: {error}", "check that the interface exists and is up") from error
        time.sleep(POLL_S)


class Pace:
    """Lets time pass for drives as it does for their hosts: for those of all buses of a robot together."""

    def __init__(self, clock: Clock, advance: Callable[[int], None], start_ns: int) -> None:
        """Take a clock, and what lets time pass until a time in ns of the drives' own, now at `start_ns`."""
        self._clock = clock
        self._advance = advance
        self._drives_ns = start_ns
        self._round_ns = clock.now_ns()

    def begin(self) -> None:
        """Forget the time until now."""
        self._round_ns = self._clock.now_ns()

    def catch_up(self) -> None:
        """Let the time pass that has passed since the last call."""
        now = self._clock.now_ns()
        self._drives_ns += min(now - self._round_ns, LATE_NS)
        self._round_ns = now
        self._advance(self._drives_ns)


class Server:
    """A bench behind a port. Any number of clients may share the port; all of them see every reply, as on a bus."""

    def __init__(self, bench: Bench, port: Port, pace: Pace) -> None:
        self.received = 0
        self.answered = 0
        self.lost = 0
        """Replies that did not leave: CAN FD on a classic channel, or a queue that was full."""
        self.on_status: Callable[[EmulatedDrive, object, float], None] | None = None
        """Called when a drive's status changes: the drive, its old status, seconds since it last heard a frame."""
        self.on_frame: Callable[[can.Message], None] | None = None
        """Called for every frame in either direction, with the drives' time of it."""
        self._bench = bench
        self._port = port
        self._pace = pace
        self._statuses = [drive.status for drive in bench.drives]

    def step(self) -> None:
        """Wait for frames, let time pass, and answer."""
        frames = self._port.receive(POLL_S)
        self._pace.catch_up()
        bench = self._bench
        for frame in frames:
            if frame.is_error_frame or frame.is_remote_frame or frame.is_extended_id:
                continue
            self.received += 1
            if self.on_frame is not None:
                frame.timestamp = bench.now_ns * 1e-9
                self.on_frame(frame)
            if self._port.bitrate is not None:
                bench.nominal = self._port.bitrate
            bench.receive(frame.arbitration_id, frame.data)
        self._report_errors()
        replies = bench.replies
        while replies:
            arbitration_id, data, fd, stamp_ns = replies.popleft()
            reply = can.Message(
                timestamp=stamp_ns * 1e-9,
                arbitration_id=arbitration_id,
                is_extended_id=False,
                data=data,
                is_fd=fd,
                bitrate_switch=fd,
                is_rx=False,
            )
            if self.on_frame is not None:
                self.on_frame(reply)
            if (fd and not self._port.fd) or not self._port.send(reply):
                self.lost += 1
            else:
                self.answered += 1
        if self.on_status is not None:
            self._watch(self.on_status)

    def _report_errors(self) -> None:
        """Tell the hosts what their controllers would have seen, where the channel carries it."""
        errors = self._bench.errors
        while errors:
            error = errors.popleft()
            if self._port.carries_errors:
                self._port.send(can.Message(arbitration_id=error.error_class, is_error_frame=True, data=error.data))

    def _watch(self, report: Callable[[EmulatedDrive, object, float], None]) -> None:
        for index, drive in enumerate(self._bench.drives):
            if drive.status != self._statuses[index]:
                before, self._statuses[index] = self._statuses[index], drive.status
                report(drive, before, (self._bench.now_ns - drive.fed_ns) * 1e-9)


def serve(servers: Sequence[Server], pace: Pace, is_over: Callable[[], bool]) -> None:
    """Serve several buses until `is_over()`.

    Raises:
        BusError: if a channel is gone.
    """
    pace.begin()
    while not is_over():
        for server in servers:
            server.step()
