"""Shared memory between the control process and its neighbours: nothing in it can block, back up or be left behind.

The memory is anonymous (memfd) and handed down as a file descriptor, so it has no name and vanishes with its last
user, however that one dies. The policy gets two descriptors: its mailbox, and a read-only view of the rest.

Latest values are guarded by a version that is odd while a write is in progress; rings by a head that moves after
the slot is complete. Single writer each; x86 and ARM64 both keep aligned 8-byte stores whole. Words that others wait
for are stored through a memoryview: `struct.pack_into` clears its target first, and a reader would see the zero.
"""

import fcntl
import json
import mmap
import os
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from robotctl.hal.types import Vector
from robotctl.safety.target import FreeDrive, Hold, JointTorque, JointVelocity, Target

MAX_VALUES = 16
"""Most values a target may carry through a mailbox."""

_HEADER = 128
"""Bytes of a board before its rings."""

Buffer = mmap.mmap | bytearray
_TARGET = struct.Struct(f"<Qqqqii{MAX_VALUES}d")
"""version, epoch, seq, deadline, kind, count, values"""
_BODY = struct.Struct(_TARGET.format.replace("Q", "", 1))
_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW
_KINDS: dict[int, type[Target]] = {1: JointVelocity, 2: JointTorque, 3: Hold, 4: FreeDrive}
_NUMBERS = {kind: number for number, kind in _KINDS.items()}


def _words(buffer: Buffer, offset: int, count: int = 1) -> "memoryview[int]":
    """Return aligned 64-bit words of a buffer, each of which is stored and loaded as a whole."""
    return memoryview(buffer)[offset : offset + 8 * count].cast("q")


class Mailbox:
    """The latest target of one policy. The policy puts, the control process takes; neither ever waits."""

    SIZE = _TARGET.size

    def __init__(self, buffer: Buffer) -> None:
        self._buffer = buffer
        self._shared_version = _words(buffer, 0)
        self._version = 0
        self._seen = 0

    def put(self, target: Target) -> None:
        """Publish a target, replacing the last one.

        Raises:
            ValueError: if it carries more values than fit.
        """
        values = getattr(target, "values", None)
        flat = [] if values is None else np.asarray(values, dtype=np.float64).ravel().tolist()
        if len(flat) > MAX_VALUES:
            raise ValueError(f"a target has at most {MAX_VALUES} values, got {len(flat)}")
        padded = flat + [0.0] * (MAX_VALUES - len(flat))
        self._version += 2
        self._shared_version[0] = self._version - 1
        body = (target.epoch, target.seq, target.deadline_ns, _NUMBERS[type(target)], len(flat), *padded)
        _BODY.pack_into(self._buffer, 8, *body)
        self._shared_version[0] = self._version

    def take(self) -> Target | None:
        """Return the target if it is new and whole, else None."""
        version = self._shared_version[0]
        if version == self._seen or version & 1:
            return None
        _, epoch, seq, deadline, number, count, *values = _TARGET.unpack_from(self._buffer, 0)
        if self._shared_version[0] != version:
            return None
        self._seen = version
        kind = _KINDS.get(number)
        if kind is JointVelocity or kind is JointTorque:
            return kind(np.array(values[: max(0, min(count, MAX_VALUES))]), epoch, seq, deadline)
        if kind is Hold or kind is FreeDrive:
            return kind(epoch, seq, deadline)
        # Not something a mailbox of ours wrote: let admission complain about its shape.
        return JointVelocity(np.empty(0), epoch, seq, deadline)


class Desk:
    """Requests of the operator to the control process, one at a time, each with its answer; and the emergency stop.

    `ask` and `stop` are used by the operator's side, `pending`, `answer` and `take_stop` by the control process. The
    emergency stop has a word of its own: pressed in another thread, it must neither lose nor replace a request.
    """

    SIZE = 56
    """Words: asked, answered, verb, stops, beats, grip, argument. The answer's text goes through the event ring."""

    def __init__(self, buffer: Buffer, offset: int = 0) -> None:
        self._words = _words(buffer, offset, self.SIZE // 8)
        self._stops = 0

    def ask(self, verb: int, argument: int = 0) -> int:
        """Post a request and return its number. For one thread only."""
        number = self._words[0] + 1
        self._words[2] = verb
        self._words[6] = argument
        self._words[0] = number
        return number

    def answered(self, number: int) -> bool:
        return self._words[1] >= number

    def pending(self) -> tuple[int, int] | None:
        """Return (number, verb) of a request that waits, else None."""
        asked = self._words[0]
        return (asked, self._words[2]) if asked != self._words[1] else None

    @property
    def argument(self) -> int:
        """What the request that waits was asked with."""
        return self._words[6]

    def answer(self, number: int) -> None:
        self._words[1] = number

    def stop(self) -> None:
        """Post an emergency stop. May be called from any thread, at any time."""
        self._words[3] += 1

    def beat(self) -> None:
        """Show that the operator's process is alive. For one thread only."""
        self._words[4] += 1

    @property
    def beats(self) -> int:
        """Number of beats so far; 0 where the operator's process shows no life, as in lockstep."""
        return self._words[4]

    def hold(self, grip: int) -> None:
        """Tell how the deadman's switch is held. May be called from any thread."""
        self._words[5] = grip

    @property
    def grip(self) -> int:
        """How the deadman's switch is held."""
        return self._words[5]

    def take_stop(self) -> bool:
        """Return whether an emergency stop was posted since the last call."""
        before, self._stops = self._stops, self._words[3]
        return self._stops != before


class Power(IntEnum):
    """What a loop has of its drives."""

    OFF = 0
    """They are off, and have confirmed it."""
    CHANGING = 1
    """They come on or go off; the loop may stand still over it."""
    ON = 2
    """They are on, and the loop feeds them in every tick."""


class Watch:
    """Between a loop and its watchman: the loop says what it has of its drives, the watchman shows that it is alive."""

    OFFSET = Desk.SIZE
    SIZE = 16
    """Words: power, beats."""

    def __init__(self, buffer: Buffer, offset: int = 0) -> None:
        self._words = _words(buffer, offset, self.SIZE // 8)

    @property
    def power(self) -> Power:
        return Power(self._words[0])

    @power.setter
    def power(self, power: Power) -> None:
        self._words[0] = power

    def beat(self) -> None:
        """Show that the watchman is alive."""
        self._words[1] += 1

    @property
    def beats(self) -> int:
        """Number of beats so far; 0 where there is no watchman, as in lockstep."""
        return self._words[1]


TICK_HEAD = struct.Struct("<qqqqqqqq")
"""The integer fields of a record, in order."""


def tick_dtype(dof: int) -> np.dtype[Any]:
    """Return the record that every tick leaves behind: integers first, then one run of doubles."""
    joints = (np.float64, (dof,))
    return np.dtype(
        [
            ("tick", np.int64),
            ("stamp_ns", np.int64),
            ("lateness_ns", np.int64),
            ("epoch", np.int64),
            ("seq", np.int64),
            ("state", np.int64),
            ("clip", np.int64),
            ("has_truth", np.int64),
            ("position", *joints),
            ("velocity", *joints),
            ("effort", *joints),
            ("wanted", *joints),
            ("command_position", *joints),
            ("command_velocity", *joints),
            ("command_effort", *joints),
            ("tool", np.float64, (3,)),
            ("true_position", *joints),
            ("true_velocity", *joints),
            ("true_tool", np.float64, (3,)),
            ("duration_ns", np.int64),
        ]
    )


class TickRing:
    """The last ticks, one record each: latest state for the policy, history for recorder and black box."""

    def __init__(self, buffer: Buffer, offset: int, dof: int, slots: int) -> None:
        self._buffer = buffer
        self._offset = offset
        self._head = _words(buffer, offset)
        self.slots = slots
        self.dtype = tick_dtype(dof)
        self.records: NDArray[Any] = np.frombuffer(buffer, self.dtype, slots, offset + 64)
        # The run of doubles of each record: joints nine times, the tool point twice.
        words = self.dtype.itemsize // 8
        self._doubles = np.frombuffer(buffer, np.float64, slots * words, offset + 64).reshape(slots, words)[:, 8:-1]

    @staticmethod
    def size(dof: int, slots: int) -> int:
        return 64 + tick_dtype(dof).itemsize * slots

    @property
    def head(self) -> int:
        """Number of records written so far."""
        return self._head[0]

    def fill(self, number: int, head: tuple[int, ...], vectors: tuple[Vector, ...]) -> None:
        """Write the fields of record `number`, in the order of `tick_dtype`, all but the last; not yet visible."""
        slot = number % self.slots
        TICK_HEAD.pack_into(self._buffer, self._offset + 64 + slot * self.dtype.itemsize, *head)
        np.concatenate(vectors, out=self._doubles[slot])

    def publish(self, number: int, duration_ns: int) -> None:
        """Complete record `number` with how long its tick took, and make it visible."""
        end = self._offset + 64 + (number % self.slots + 1) * self.dtype.itemsize
        struct.pack_into("<q", self._buffer, end - 8, duration_ns)
        self._head[0] = number + 1

    def append(self, record: np.void) -> None:
        """Write a whole record behind the last one, and make it visible."""
        number = self.head
        self.records[number % self.slots] = record
        self._head[0] = number + 1

    def latest(self) -> np.void | None:
        """Return a copy of the newest record, or None before the first."""
        head = self.head
        return self.records[(head - 1) % self.slots].copy() if head else None

    def since(self, cursor: int) -> tuple[NDArray[Any], int, int]:
        """Return the records from number `cursor` on, the new cursor, and how many were overwritten unread."""
        head = self.head
        # The writer may be in the slot that is oldest; leave a little room.
        first = max(cursor, head - self.slots + 64)
        dropped = max(0, first - cursor)
        if head <= first:
            return self.records[:0].copy(), max(cursor, head), dropped
        begin, end = first % self.slots, head % self.slots
        if begin < end:
            part = self.records[begin:end].copy()
        else:
            part = np.concatenate([self.records[begin:], self.records[:end]])
        return part, head, dropped


class EventRing:
    """The last events (state changes, trips, answers, log lines) as JSON texts."""

    SLOT = 4096
    SLOTS = 128
    SIZE = 8 + SLOT * SLOTS

    def __init__(self, buffer: Buffer, offset: int) -> None:
        self._buffer = buffer
        self._offset = offset
        self._head = _words(buffer, offset)

    def write(self, event: dict[str, object]) -> None:
        """Append one event; of one that is too long for a slot, its `text` is cut, or all but the type is lost."""
        data = json.dumps(event).encode()
        room = self.SLOT - 4
        if len(data) > room:
            text = str(event.get("text", ""))[: room // 8]
            data = json.dumps({**event, "text": text}).encode()
        if len(data) > room:
            short = {"type": event["type"], "stamp_ns": event.get("stamp_ns", 0), "text": "(too long to be kept)"}
            data = json.dumps(short).encode()
        head = self._head[0]
        at = self._offset + 8 + head % self.SLOTS * self.SLOT
        struct.pack_into("<I", self._buffer, at, len(data))
        self._buffer[at + 4 : at + 4 + len(data)] = data
        self._head[0] = head + 1

    def since(self, cursor: int) -> tuple[list[dict[str, Any]], int]:
        """Return the events from number `cursor` on, and the new cursor."""
        head = self._head[0]
        events = []
        for number in range(max(cursor, head - self.SLOTS + 1), head):
            at = self._offset + 8 + number % self.SLOTS * self.SLOT
            (length,) = struct.unpack_from("<I", self._buffer, at)
            events.append(json.loads(bytes(self._buffer[at + 4 : at + 4 + length])))
        return events, head


@dataclass(slots=True)
class Link:
    """Everything a control process shares. `fds` are the mailbox's and the board's, or None within one process."""

    mailbox: Mailbox
    desk: Desk
    watch: Watch
    events: EventRing
    ticks: TickRing
    fds: tuple[int, int] | None = None

    @classmethod
    def create(cls, dof: int, slots: int) -> Self:
        """Create fresh shared memory for an arm with `dof` joints, remembering `slots` ticks."""
        fds = []
        for name, size in (("mailbox", Mailbox.SIZE), ("board", cls._board_size(dof, slots))):
            fd = os.memfd_create(f"robotctl-{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            os.ftruncate(fd, size)
            # Who holds the mailbox could otherwise shrink it, and the control process would die of its next look.
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
            fds.append(fd)
        return cls.attach(fds[0], fds[1], dof, slots)

    @classmethod
    def attach(cls, mailbox_fd: int, board_fd: int, dof: int, slots: int, *, read_only: bool = False) -> Self:
        """Map the memory behind two descriptors; with `read_only` the board cannot be written to."""
        mailbox = mmap.mmap(mailbox_fd, Mailbox.SIZE)
        access = mmap.ACCESS_READ if read_only else mmap.ACCESS_WRITE
        board = mmap.mmap(board_fd, cls._board_size(dof, slots), access=access)
        return cls._lay_out(mailbox, board, dof, slots, (mailbox_fd, board_fd))

    @classmethod
    def local(cls, dof: int, slots: int) -> Self:
        """Return the same within one process: lockstep and tests."""
        return cls._lay_out(bytearray(Mailbox.SIZE), bytearray(cls._board_size(dof, slots)), dof, slots, None)

    @classmethod
    def _lay_out(cls, mailbox: Buffer, board: Buffer, dof: int, slots: int, fds: tuple[int, int] | None) -> Self:
        return cls(
            Mailbox(mailbox),
            Desk(board, 0),
            Watch(board, Watch.OFFSET),
            EventRing(board, _HEADER),
            TickRing(board, _HEADER + EventRing.SIZE, dof, slots),
            fds,
        )

    @staticmethod
    def _board_size(dof: int, slots: int) -> int:
        return _HEADER + EventRing.SIZE + TickRing.size(dof, slots)


@dataclass(frozen=True, slots=True)
class Board:
    """The rings alone, for who only looks on: a recorder, a viewer."""

    events: EventRing
    ticks: TickRing

    @classmethod
    def attach(cls, fd: int, dof: int, slots: int) -> Self:
        """Map the board behind a descriptor, which may be read-only, so that it cannot be written to."""
        board = mmap.mmap(fd, Link._board_size(dof, slots), access=mmap.ACCESS_READ)
        return cls(EventRing(board, _HEADER), TickRing(board, _HEADER + EventRing.SIZE, dof, slots))

    @staticmethod
    def read_only(fd: int) -> int:
        """Return a new descriptor of a board that allows reading only."""
        return os.open(f"/proc/self/fd/{fd}", os.O_RDONLY | os.O_CLOEXEC)
