"""Listening to a bus: who speaks, how often, what it means, and when it last changed. Nothing is ever sent."""

from collections.abc import Callable
from dataclasses import dataclass

import can

from robotctl.hal.can.channel import FORMS, Channel, open_wired, options
from robotctl.hal.can.cia402.words import Words402
from robotctl.hal.can.damiao.words import DamiaoWords
from robotctl.hal.can.error_frames import ErrorLog
from robotctl.hal.can.ways import own_way
from robotctl.hal.clock import Clock
from robotctl.hal.errors import BusError, ConfigError
from robotctl.hal.robot import Robot

_WINDOW_NS = 1_000_000_000
"""Rates are those of the latest full second."""
_WAIT_S = 0.05
_FAILURES = 20

Words = Callable[[int, bytes], str]
"""Takes id and data of a frame, and returns what it says; `?` where it does not know."""

WORDS: dict[str, Callable[[Robot], Words]] = {"damiao": DamiaoWords, "cia402": Words402}
"""By protocol."""


@dataclass(slots=True)
class Heard:
    """What was heard on one id."""

    arbitration_id: int
    extended: bool
    fd: bool = False
    frames: int = 0
    rate: float = 0.0
    """1/s"""
    data: bytes = b""
    meaning: str = ""
    changed_ns: int = 0
    """When the data last became another."""
    window: int = 0


class Monitor:
    """Everything that was heard."""

    def __init__(self, words: Words, now_ns: int) -> None:
        self.errors = ErrorLog()
        self.error_frames = 0
        self.frames = 0
        self._words = words
        self._heard: dict[tuple[bool, int], Heard] = {}
        self._window_ns = now_ns

    @property
    def rows(self) -> list[Heard]:
        """By id."""
        return [self._heard[key] for key in sorted(self._heard)]

    def take(self, message: can.Message, now_ns: int) -> None:
        """Take in a frame."""
        if message.is_error_frame:
            self.error_frames += 1
            self.errors.take(message.arbitration_id, message.data)
            return
        self.frames += 1
        key = message.is_extended_id, message.arbitration_id
        heard = self._heard.get(key)
        if heard is None:
            heard = self._heard[key] = Heard(message.arbitration_id, message.is_extended_id, changed_ns=now_ns)
        data = bytes(message.data)
        if data != heard.data:
            heard.data, heard.changed_ns = data, now_ns
            heard.meaning = "?" if message.is_extended_id else self._words(message.arbitration_id, data)
        heard.fd = message.is_fd
        heard.frames += 1
        heard.window += 1

    def pass_time(self, now_ns: int) -> bool:
        """Work out the rates if a second has passed, and return whether it has."""
        elapsed = now_ns - self._window_ns
        if elapsed < _WINDOW_NS:
            return False
        for heard in self._heard.values():
            heard.rate, heard.window = heard.window * 1e9 / elapsed, 0
        self._window_ns = now_ns
        return True


def words_of(robot: Robot) -> Words:
    """Return how the frames of a robot's protocol are put in words."""
    return WORDS[robot.profile.protocol](robot)


def open_listening(name: str, robot: Robot) -> Channel:
    """Open a channel to listen. An slcan adapter is told not even to acknowledge.

    Raises:
        ConfigError: if the channel's name has no known form, or nobody else can speak on it.
        BusError: if it cannot be opened.
    """
    wiring = robot.profile.can
    if wiring is None:
        raise ConfigError(f"robot {robot.profile.name!r} has no CAN drives", "name the robot whose bus it is")
    interface, _, where = name.partition(":")
    if interface not in can.VALID_INTERFACES or not where:
        raise ConfigError(f"nothing can be overheard on {name!r}", f"use one of {FORMS}; emulated has no other users")
    way = own_way(name, wiring)
    chosen = options(interface, wiring.model_copy(update={"fd": True} if interface == "socketcan" else {}))
    if interface == "slcan":
        chosen |= {"listen_only": True}
    return Channel(open_wired(name, wiring, chosen).bus, fd=way.fd)


def listen(
    channel: Channel, monitor: Monitor, clock: Clock, until_ns: int | None, on_second: Callable[[], None]
) -> None:
    """Listen until a time, or for ever if that is None; call `on_second` once a second.

    Raises:
        BusError: if the channel is gone.
    """
    failures = 0
    while until_ns is None or clock.now_ns() < until_ns:
        try:
            message = channel.bus.recv(_WAIT_S)
            failures = 0
        except (can.CanError, OSError, ValueError, IndexError) as error:
            failures += 1
            if failures >= _FAILURES:
                raise BusError(f"the CAN interface is gone ({error})", "check the adapter and the interface") from error
            continue
        now = clock.now_ns()
        if message is not None:
            monitor.take(message, now)
        if monitor.pass_time(now):
            on_second()
