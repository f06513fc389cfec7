"""The one place that sends and receives CAN frames: bounded sends, a receive path of our own, and counters.

There is no receive thread and no `can.Notifier` (whose thread dies at the first exception). The control loop reads in
every tick, which is more often than a socket buffer can fill, so `drain` takes whatever has arrived without waiting.
A thread would add nothing but contention for the interpreter: a frame that came between two ticks is of no use before
the next one. What a thread could do better, the time of arrival, the kernel's receive stamp does better still.

A full transmit queue has two causes with opposite answers: a short stall of the adapter, where the frame is dropped
and the next one goes out, and a bus on which nobody acknowledges, where motion frames would pile up and be replayed
when power returns. So a full queue is counted, the rest of the cycle is not even tried, and when it lasts for
`FAILING_LIMIT_NS` the bus is given up. Where the channel tells that frames wait, nothing more is put behind them after
`WAITING_LIMIT_NS`, however long the queue is.
"""

import errno
import select
import struct
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import can

from robotctl.hal.can.bandwidth import frame_time_ns
from robotctl.hal.can.channel import Channel
from robotctl.hal.can.error_frames import ErrorLog
from robotctl.hal.can.outbox import prove_empty
from robotctl.hal.can.tap import Tap
from robotctl.hal.clock import Clock
from robotctl.hal.errors import BusError

SEND_TIMEOUT_S = 0.001
"""Longest wait for room in the transmit queue. Not 0, since pyserial then truncates frames without a word."""

FAILING_LIMIT_NS = 200_000_000
"""A bus on which every send has failed for this long is given up."""

WAITING_LIMIT_NS = 4_000_000
"""If for this long there was always a frame that waited, no other joins them: so no more than two cycles at 500 Hz, or
one at 250 Hz, can ever be sent late. On the wire a cycle of eight takes 1 ms, or 2.2 on classic CAN."""

DRAIN_LIMIT = 512
"""Frames taken in one call, so that a babbling node cannot hold the loop."""

POLL_NS = 500_000
"""Step of `wait`."""

_LOST = frozenset({errno.ENODEV, errno.ENXIO, errno.ENETDOWN, errno.ENETUNREACH, errno.EBADF, errno.EIO})
_FULL = frozenset({errno.ENOBUFS, errno.EAGAIN})
_READ_ERRORS = (can.CanError, OSError, ValueError, IndexError, struct.error, AssertionError)
"""What python-can's readers raise; the latter four for frames they cannot parse."""
_READ_RETRIES = 8
_OLDEST_STAMP_S = 0.1
_LOAD_WINDOW_NS = 500_000_000

Route = Callable[[bytearray, int], bool]
"""Takes the data bytes (8 of them in `routes`) and the receive stamp in ns; returns whether they were understood."""

Listener = Callable[[int, bytes], None]
"""Takes the id and the data of a frame that no route understood."""

FrameInspector = Callable[[Sequence[tuple[int, bytes]]], str]
"""Sees the frames (id, data) that are about to leave together. Any text it returns keeps them all back."""


class RoundTrip(NamedTuple):
    """Times from a request to its reply, in microseconds, of the latest 4096 replies."""

    p50: float
    p99: float
    max: float


class Transport:
    """An open channel, with routes for what arrives and counters for what happens.

    `routes` is keyed by `route_key`, `by_id` by the id alone. All counters count from the opening.

    Raises:
        BusError: from every method but `close` and `statistics`, once the interface is gone.
    """

    def __init__(self, channel: Channel, clock: Clock, bitrate: int = 1_000_000, data_bitrate: int = 5_000_000) -> None:
        self.fd = channel.fd
        self.simulated = channel.simulated
        self.routes: dict[int, Route] = {}
        self.by_id: dict[int, Route] = {}
        """Routes of ids with one sender and frames of any length, as CANopen has them; tried after `routes`."""
        self.reply_ids: set[int] = set()
        """Ids on which only drives of ours may speak."""
        self.listener: Listener | None = None
        self.inspector: FrameInspector | None = None
        self.tap: Tap | None = None
        """Sees every frame that left or arrived."""
        self.refusal = ""
        """What the inspector said of the latest frames; empty if they went out."""
        self.sent = 0
        self.withheld = 0
        """Frames that the inspector kept back."""
        self.received = 0
        self.error_frames = 0
        self.unexpected = 0
        self.rejected = 0
        """Those of the unexpected that came on an id of ours: of a wrong length, or without sense."""
        self.send_failures = 0
        self.errors = ErrorLog()
        self.trips: deque[int] = deque(maxlen=4096)
        """Round trips in ns; drives append to it."""
        self._channel = channel
        self._outbox = channel.outbox
        self._recv = channel.bus.recv
        self._send = channel.bus.send
        self._clock = clock
        self._poll = _poll_of(channel.bus)
        self._lost = ""
        self._closed = False
        self._failing_since: int | None = None
        self._empty_ns = 0
        self._frame_ns = frame_time_ns(channel.fd, bitrate, data_bitrate)
        self._load = 0.0
        self._load_from = clock.now_ns()
        self._load_frames = 0

    @property
    def state(self) -> str:
        """What the error frames say of the controller: active, passive or bus-off; gone once it has vanished."""
        return self.errors.state

    # --- out --------------------------------------------------------------------------------------------------------

    def send(self, arbitration_id: int, data: bytes, fd: bool = False, force: bool = False) -> bool:
        """Send one frame and return whether it left the host. Classic unless `fd`; never waits beyond SEND_TIMEOUT_S.

        While the controller is bus-off nothing is tried, except with `force`: for frames that take torque away.
        """
        if self._lost:
            raise self._gone()
        if self.inspector is not None and self._is_withheld([(arbitration_id, data)]):
            return False
        if not force and self._is_closed_off():
            return False
        try:
            self._send(
                can.Message(0.0, arbitration_id, False, False, False, None, None, data, fd, False, fd), SEND_TIMEOUT_S
            )
        except (can.CanError, OSError) as error:
            self._send_failed(error)
            return False
        self.sent += 1
        if self.tap is not None:
            self.tap.sent([(arbitration_id, data)], fd, self._clock.now_ns())
        self._failing_since = None
        return True

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> int:
        """Send the frames of one cycle, FD where the channel is, and return how many left the host.

        After the first failure the others are not tried: with a full queue each would cost SEND_TIMEOUT_S.
        """
        if self._lost:
            raise self._gone()
        if self.inspector is not None and self._is_withheld(frames):
            return 0
        if self._is_closed_off():
            return 0
        count = 0
        send, fd, message = self._send, self.fd, can.Message
        try:
            for arbitration_id, data in frames:
                send(
                    message(0.0, arbitration_id, False, False, False, None, len(data), data, fd, False, fd),
                    SEND_TIMEOUT_S,
                )
                count += 1
        except (can.CanError, OSError) as error:
            self._send_failed(error)
        self.sent += count
        if count:
            self._failing_since = None
            if self.tap is not None:
                self.tap.sent(frames if count == len(frames) else frames[:count], fd, self._clock.now_ns())
        return count

    # --- in ---------------------------------------------------------------------------------------------------------

    def drain(self) -> None:
        """Take what has arrived and hand it to the routes, without waiting. Garbage is counted, never fatal."""
        if self._lost:
            raise self._gone()
        now = self._clock.now_ns()
        recv, routes, by_id, simulated, tap = self._recv, self.routes, self.by_id, self.simulated, self.tap
        wall = 0.0 if simulated else time.time()  # wall clock: the kernel stamps frames by it
        failures = 0
        for _ in range(DRAIN_LIMIT):
            try:
                message = recv(0.0)
            except _READ_ERRORS as error:
                self._receive_failed(error)
                failures += 1
                if failures == _READ_RETRIES:
                    break
                continue
            if message is None:
                # An slcan adapter's acknowledgements read as None although frames wait behind them.
                if self._poll is None or not self._poll.poll(0):
                    break
                continue
            stamp = now if simulated else _stamp(now, wall, message.timestamp)
            if tap is not None:
                tap.received(message, stamp)
            if message.is_error_frame:
                self.error_frames += 1
                self.errors.take(message.arbitration_id, message.data)
                continue
            self.received += 1
            data = message.data
            if not message.is_extended_id and not message.is_remote_frame:
                route = routes.get(message.arbitration_id << 4 | data[0] & 0xF) if len(data) == 8 else None
                route = route or by_id.get(message.arbitration_id)
                if route is not None and route(data, stamp):
                    continue
            self.unexpected += 1
            if message.arbitration_id in self.reply_ids:
                self.rejected += 1
            if self.listener is not None:
                self.listener(message.arbitration_id, bytes(data))
        self._measure_load(now)

    def wait(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Drain until `done()` or until the time is up, and return whether it is done. Not for the control loop."""
        deadline = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            self.drain()
            if done():
                return True
            now = self._clock.now_ns()
            if now >= deadline:
                return False
            self._clock.sleep_until(min(deadline, now + POLL_NS))

    # --- about ------------------------------------------------------------------------------------------------------

    def round_trip(self) -> RoundTrip:
        """Return percentiles of the request-reply times, all 0 before the first reply."""
        ordered = sorted(self.trips)
        if not ordered:
            return RoundTrip(0.0, 0.0, 0.0)
        last = len(ordered) - 1
        return RoundTrip(ordered[last // 2] * 1e-3, ordered[round(last * 0.99)] * 1e-3, ordered[last] * 1e-3)

    def statistics(self) -> dict[str, object]:
        """Return the counters, the estimated load (0 to 1) of the latest half second, and the round trips in us."""
        return {
            "sent": self.sent,
            "received": self.received,
            "error_frames": self.error_frames,
            "unexpected": self.unexpected,
            "rejected": self.rejected,
            "withheld": self.withheld,
            "send_failures": self.send_failures,
            "load": self._load,
            "errors": dict(self.errors.kinds),
            "state": self.state,
            "round_trip_us": self.round_trip()._asdict(),
        }

    # --- frames that have not left ----------------------------------------------------------------------------------

    @property
    def waiting(self) -> bool:
        """Whether frames that were sent have not left, as far as the channel tells."""
        return self._outbox is not None and not self._lost and self._outbox.waiting()

    def purge(self) -> None:
        """Take back what waits, if anything does. Not for the control loop: it may take some tens of milliseconds.

        Raises:
            BusError: if that was not possible.
        """
        if self._outbox is not None and self.waiting:
            self._outbox.purge()
            self._failing_since = None
            self.errors.state = "active"  # its controller has begun anew

    def prove_empty(self, probe: tuple[int, bytes], commands: Collection[int]) -> bool:
        """Take back what waits, and show with a probe (id, data) that nothing does; see `outbox.prove_empty`.

        Returns whether the probe was sent: where the channel tells nothing, the drives' own answers have to be proof
        enough.
        """
        self.purge()
        if self._outbox is None:
            return False
        prove_empty(self._outbox, self.send, probe, commands, self._clock)
        return True

    def close(self) -> None:
        """Shut the bus down. Harmless when closed, or when the interface is gone."""
        if self._closed:
            return
        self._closed = True
        self._lost = self._lost or "the channel was closed"
        if not self._channel.close():
            self.errors.state = "gone"

    def _is_withheld(self, frames: Sequence[tuple[int, bytes]]) -> bool:
        assert self.inspector is not None
        self.refusal = self.inspector(frames)
        if self.refusal:
            self.withheld += len(frames)
        return bool(self.refusal)

    # --- trouble ----------------------------------------------------------------------------------------------------

    def _is_closed_off(self) -> bool:
        """Return whether a frame may not be sent now, since it would leave later; counts it as failed."""
        if self.state == "bus-off":
            self.send_failures += 1
            return True
        if self._outbox is None:
            return False
        now = self._clock.now_ns()
        if not self._outbox.waiting():
            self._empty_ns = now
        if now - self._empty_ns < WAITING_LIMIT_NS:
            return False
        self.send_failures += 1
        self._keep_failing("frames wait, and do not leave")
        return True

    def _send_failed(self, error: Exception) -> None:
        self.send_failures += 1
        codes = _codes(error)
        if codes & _LOST:
            raise self._lose(error) from error
        self._keep_failing("the transmit queue stays full" if _is_full(error, codes) else str(error), error)

    def _keep_failing(self, what: str, error: Exception | None = None) -> None:
        """Give the bus up if nothing has left for too long."""
        now = self._clock.now_ns()
        if self._failing_since is None:
            self._failing_since = now
        elif now - self._failing_since > FAILING_LIMIT_NS:
            raise BusError(
                f"no frame could be sent for {FAILING_LIMIT_NS * 1e-9:g} s: {what}",
                "check motor power, termination and bit rates: nobody acknowledges. Before the power returns, see that "
                "no old frames wait: take the interface down and up, which robotctl does if it may",
            ) from error

    def _receive_failed(self, error: Exception) -> None:
        if _codes(error) & _LOST:
            raise self._lose(error) from error
        self.unexpected += 1

    def _lose(self, error: Exception) -> BusError:
        self._lost = f"the CAN interface is gone ({error})"
        return self._gone()

    def _gone(self) -> BusError:
        return BusError(self._lost, "check the adapter and that the interface is up, then connect again")

    def _measure_load(self, now: int) -> None:
        elapsed = now - self._load_from
        if elapsed >= _LOAD_WINDOW_NS:
            frames = self.sent + self.received
            self._load = (frames - self._load_frames) * self._frame_ns / elapsed
            self._load_from, self._load_frames = now, frames


def route_key(reply_id: int, motor: int) -> int:
    """Return the key of `Transport.routes`: replies are told apart by their full id and the motor's low nibble.

    The nibble counts since drives leave the factory with one and the same reply id.
    """
    return reply_id << 4 | motor & 0xF


def _stamp(now: int, wall: float, timestamp: float) -> int:
    """Return when a frame arrived, on our clock: its age by the kernel's stamp, if that is believable, before `now`.

    Only the age is taken from the wall clock, so a step of it does harm for one frame and by at most 0.1 s.
    """
    age = wall - timestamp
    return now - int(age * 1e9) if 0.0 < age < _OLDEST_STAMP_S else now


def _poll_of(bus: can.BusABC) -> "select.poll | None":
    try:
        descriptor = bus.fileno()
    except (NotImplementedError, can.CanError):
        return None
    if not isinstance(descriptor, int) or descriptor < 0:
        return None
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return poll


def _codes(error: BaseException | None) -> set[int]:
    """Return every errno in a chain of exceptions: python-can and pyserial each wrap the system's error."""
    codes = set()
    while error is not None:
        for code in (getattr(error, "error_code", None), getattr(error, "errno", None)):
            if isinstance(code, int):
                codes.add(code)
        error = error.__cause__ or error.__context__
    return codes


def _is_full(error: Exception, codes: set[int]) -> bool:
    """Return whether the queue was full: socketcan says so without an errno (select) or with ENOBUFS (write)."""
    return bool(codes & _FULL) or "buffer full" in str(error).lower()
