"""What a cycle of all drives costs, beside bare python-can on the same bus in the same run.

The drives stay off: a drive that is off answers a command with its feedback and does nothing, so this may be run on an
arm, too. A bare cycle sends ready-made bytes and takes as many frames as there are drives; ours encodes, sends, takes,
checks and decodes. Both are made in turns, so that a noisy machine hits them alike.
"""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import can
import numpy as np

from robotctl.hal.can.bandwidth import cycle_s
from robotctl.hal.can.channel import Channel
from robotctl.hal.can.damiao.codec import Status
from robotctl.hal.can.damiao.drive import Drive
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.transport import SEND_TIMEOUT_S, Transport
from robotctl.hal.clock import Clock
from robotctl.hal.errors import BusError, ConfigError
from robotctl.hal.profile import DamiaoDrive
from robotctl.hal.robot import Robot

STAGES = ("encode", "send", "first reply", "last reply", "decode")
"""Of our cycle. Replies count from the moment when all frames had been sent; decoding is of all replies."""

EDGES_US = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)
"""Upper edges of the histogram's bins; one more bin holds what is above."""

_WARM_UP = 200
_PATIENCE_S = 0.02
"""Wait for replies, after which those that are not there count as missed."""

_now = time.perf_counter_ns


def bench_bus(robot: Robot, clock: Clock, channel: Channel, cycles: int) -> dict[str, Any]:
    """Time `cycles` cycles of either kind, in turns, on an open channel.

    Returns:
        Microseconds (p50, p99, max) of both and of the stages of ours, the ratio of the medians, bins per stage
        (`EDGES_US`), replies that were missed, and the time that the frames take on a wire.

    Raises:
        DriveError: if a drive does not answer.
        ConfigError: if one is enabled, or the robot has none.
        BusError: if frames cannot be sent.
    """
    wiring = robot.profile.can
    if wiring is None:
        raise ConfigError(f"robot {robot.profile.name!r} has no CAN drives", "use a robot with drives")
    if robot.profile.protocol != "damiao":
        raise ConfigError(f"robot {robot.profile.name!r} has other drives than DAMIAO's", "use a robot with those")
    transport = Transport(channel, clock, wiring.bitrate, wiring.data_bitrate)
    wirings = [drive for drive in robot.profile.drives if isinstance(drive, DamiaoDrive) and drive.bus == 0]
    drives = [
        Drive(f"motor {each.id}", each.id, each.reply_id, MOTORS[each.motor], transport, clock) for each in wirings
    ]
    for drive in drives:
        drive.refresh()
        if drive.status == Status.ENABLED:
            raise ConfigError(f"{drive.name} is enabled", "end whatever drives the arm; this needs drives that are off")
    ours, bare = _Ours(transport, drives, clock), _Bare(channel, drives, clock)
    period_ns = robot.period_ns
    spent = np.zeros((cycles, 2))
    stages = np.zeros((cycles, len(STAGES)))
    for cycle in range(-_WARM_UP, cycles):
        spans = []
        for one in (bare.cycle, ours.cycle, ours.staged):
            clock.sleep_until(clock.now_ns() + period_ns)
            transport.drain()  # lets an emulated plant catch up, which is not to be timed
            try:
                spans.append(one())
            except can.CanError as error:
                raise BusError(f"python-can could not send: {error}", "does whoever answers keep up?") from error
        if cycle >= 0:
            spent[cycle], stages[cycle] = spans[:2], ours.stages
        else:
            ours.missed = bare.missed = 0
    return _report(len(drives), channel.fd, cycle_s(wirings, wiring, channel.fd), spent, stages) | {
        "missed": {"bare": bare.missed, "ours": ours.missed}
    }


class _Bare:
    """What nobody who uses python-can is spared."""

    def __init__(self, channel: Channel, drives: Sequence[Drive], clock: Clock) -> None:
        self.missed = 0
        self._bus = channel.bus
        self._fd = channel.fd
        self._frames = [(drive.id, drive.encode(0.0, 0.0, 0.0, drive.gains(0.0, 0.0))) for drive in drives]
        self._patience = 0.0 if channel.simulated else _PATIENCE_S

    def cycle(self) -> int:
        """Return how many ns it took."""
        bus, fd = self._bus, self._fd
        begun = _now()
        for identifier, data in self._frames:
            message = can.Message(
                arbitration_id=identifier, data=data, is_extended_id=False, is_fd=fd, bitrate_switch=fd
            )
            bus.send(message, SEND_TIMEOUT_S)
        for _ in self._frames:
            if bus.recv(self._patience) is None:
                self.missed += 1
        return _now() - begun


class _Ours:
    """The same with everything that the driver of an arm does."""

    def __init__(self, transport: Transport, drives: Sequence[Drive], clock: Clock) -> None:
        self.missed = 0
        self.stages = [0] * len(STAGES)
        self._transport = transport
        self._drives = drives
        self._simulated = transport.simulated
        self._gains = [drive.gains(0.0, 0.0) for drive in drives]
        self._clock = clock

    def cycle(self) -> int:
        """Return how many ns it took."""
        begun = _now()
        self._send(self._encode())
        self._receive()
        return _now() - begun

    def staged(self) -> int:
        """As `cycle`, and note in `stages` (ns) where the time went; noting costs some itself."""
        tap = _Stamps()
        begun = _now()
        frames = self._encode()
        encoded = _now()
        self._send(frames)
        sent = _now()
        self._transport.tap = tap
        self._receive()
        self._transport.tap = None
        ended = _now()
        arrived = tap.stamps or [ended]
        replies = [(drive, bytearray(tap.data.get(drive.reply_id, b""))) for drive in self._drives]
        decoding = _now()
        for drive, data in replies:
            if data:
                drive.accept(data, sent)
        decoded = _now()
        self.stages = [encoded - begun, sent - encoded, arrived[0] - sent, arrived[-1] - sent, decoded - decoding]
        return ended - begun

    def _encode(self) -> list[tuple[int, bytes]]:
        return [
            (drive.id, drive.encode(0.0, 0.0, 0.0, gains))
            for drive, gains in zip(self._drives, self._gains, strict=True)
        ]

    def _send(self, frames: list[tuple[int, bytes]]) -> None:
        now = self._clock.now_ns()
        self._transport.send_all(frames)
        for drive in self._drives:
            drive.reply_pending = True
            drive.sent_ns = now

    def _receive(self) -> None:
        drives, drain = self._drives, self._transport.drain
        drain()
        if not self._simulated:
            until = _now() + int(_PATIENCE_S * 1e9)
            while _pending(drives) and _now() < until:
                drain()
        self.missed += _pending(drives)


class _Stamps:
    """A `Tap` that notes when frames were taken off the bus."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.data: dict[int, bytes] = {}

    def sent(self, frames: Sequence[tuple[int, bytes]], fd: bool, stamp_ns: int) -> None:
        """Not noted."""

    def received(self, frame: can.Message, stamp_ns: int) -> None:
        self.stamps.append(_now())
        self.data[frame.arbitration_id] = frame.data

    def describe(self, description: Mapping[str, Any]) -> None:
        """Not noted."""


def _pending(drives: Sequence[Drive]) -> int:
    return sum([drive.reply_pending for drive in drives])


def _report(motors: int, fd: bool, wire_s: float, spent: Any, stages: Any) -> dict[str, Any]:
    edges = np.array([0.0, *EDGES_US, np.inf]) * 1e3
    bins = {stage: np.histogram(stages[:, i], edges)[0].tolist() for i, stage in enumerate(STAGES)}
    bare, ours = (_percentiles(spent[:, i]) for i in range(2))
    return {
        "motors": motors,
        "fd": fd,
        "cycles": len(spent),
        "wire_us": round(wire_s * 1e6, 1),
        "bare_us": bare,
        "cycle_us": ours,
        "ratio": round(ours["p50"] / bare["p50"], 2),
        "stages_us": {stage: _percentiles(stages[:, i]) for i, stage in enumerate(STAGES)},
        "histogram": {"edges_us": list(EDGES_US), "counts": bins},
    }


def _percentiles(nanoseconds: Any) -> dict[str, float]:
    p50, p99, most = np.percentile(nanoseconds, (50, 99, 100)) * 1e-3
    return {"p50": round(float(p50), 1), "p99": round(float(p99), 1), "max": round(float(most), 1)}
