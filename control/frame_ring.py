"""The last raw frames of a bus in shared memory: both directions, stamped in nanoseconds, with a mark per tick.

The control process writes, whoever keeps a black box reads; nothing waits, and nothing is written to disk here. A
frame of up to 16 bytes takes one slot of 32; a longer one goes on in the slots behind it. A mark says where in the
stream a tick took its sample, so that the stream can be decoded again into exactly the states that were seen.
"""

import fcntl
import json
import mmap
import os
import struct
from collections.abc import Mapping, Sequence
from enum import IntFlag
from typing import Any, Self

import can
import numpy as np
from numpy.typing import NDArray

from robotctl.control.shared import Buffer

FRAME_DTYPE = np.dtype(
    [("stamp_ns", "<i8"), ("id", "<u4"), ("flags", "u1"), ("length", "u1"), ("spare", "<u2"), ("data", "u1", (16,))]
)
"""One slot. `length` is the whole frame's; of a mark, `stamp_ns` is that of its tick and nothing else counts."""

_SLOT = struct.Struct("<qIBBH16s")
_ROOM = 16
_UNSEEN = 64
"""Slots that the writer may have begun on before its head shows it."""
_DESCRIPTION = 8192
"""Bytes for the description."""
_HEADER = 64 + _DESCRIPTION


class Flag(IntFlag):
    """What a slot holds."""

    SENT = 1
    FD = 2
    EXTENDED = 4
    ERROR = 8
    REMOTE = 16
    MARK = 32
    """No frame: here a tick took its sample."""
    MORE = 64
    """The data of the slot before goes on."""


# As plain numbers, which are several times faster than flags.
_SENT, _FD, _MARK, _MORE = int(Flag.SENT), int(Flag.FD), int(Flag.MARK), int(Flag.MORE)
_KINDS = (int(Flag.EXTENDED), int(Flag.ERROR), int(Flag.REMOTE))


class FrameRing:
    """A `Tap` for one writer, and a view for readers. Made by `local`, `create` or `attach`."""

    def __init__(self, buffer: Buffer, slots: int, fd: int | None = None) -> None:
        self.slots = slots
        self.fd = fd
        """Descriptor of the memory; None within one process."""
        self._buffer = buffer
        # Words: slots written so far, length of the description.
        self._words = memoryview(buffer)[:16].cast("q")
        self._head = self._words[0]
        self.records: NDArray[Any] = np.frombuffer(buffer, FRAME_DTYPE, slots, _HEADER)

    @classmethod
    def local(cls, slots: int) -> Self:
        """Return a ring within one process."""
        return cls(bytearray(cls._size(slots)), slots)

    @classmethod
    def create(cls, slots: int) -> Self:
        """Return a ring in fresh shared memory, whose descriptor is the caller's."""
        fd = os.memfd_create("robotctl-frames", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(fd, cls._size(slots))
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
        return cls.attach(fd, slots)

    @classmethod
    def attach(cls, fd: int, slots: int) -> Self:
        """Map the ring behind a descriptor."""
        return cls(mmap.mmap(fd, cls._size(slots)), slots, fd)

    @staticmethod
    def _size(slots: int) -> int:
        return _HEADER + FRAME_DTYPE.itemsize * slots

    # --- the writer's -----------------------------------------------------------------------------------------------

    def sent(self, frames: Sequence[tuple[int, bytes]], fd: bool, stamp_ns: int) -> None:
        flags = _SENT | _FD if fd else _SENT
        head, slots, buffer, pack = self._head, self.slots, self._buffer, _SLOT.pack_into
        for arbitration_id, data in frames:
            pack(buffer, _HEADER + head % slots * 32, stamp_ns, arbitration_id, flags, len(data), 0, data)
            head += 1
        self._head = self._words[0] = head

    def received(self, frame: can.Message, stamp_ns: int) -> None:
        data = frame.data
        flags = _FD if frame.is_fd else 0
        if frame.is_extended_id or frame.is_error_frame or frame.is_remote_frame:
            kinds = zip((frame.is_extended_id, frame.is_error_frame, frame.is_remote_frame), _KINDS, strict=True)
            flags |= sum(flag for applies, flag in kinds if applies)
        head, length = self._head, len(data)
        at = _HEADER + head % self.slots * 32
        _SLOT.pack_into(self._buffer, at, stamp_ns, frame.arbitration_id, flags, length, 0, bytes(data[:_ROOM]))
        head += 1
        for begin in range(_ROOM, length, _ROOM):
            part, at = bytes(data[begin : begin + _ROOM]), _HEADER + head % self.slots * 32
            _SLOT.pack_into(self._buffer, at, stamp_ns, frame.arbitration_id, flags | _MORE, length, 0, part)
            head += 1
        self._head = self._words[0] = head

    def mark(self, stamp_ns: int) -> None:
        """Note that the tick of this stamp took its sample from what was received so far."""
        head = self._head
        _SLOT.pack_into(self._buffer, _HEADER + head % self.slots * 32, stamp_ns, 0, _MARK, 0, 0, b"")
        self._head = self._words[0] = head + 1

    def describe(self, description: Mapping[str, Any]) -> None:
        text = json.dumps(description).encode()
        if len(text) > _DESCRIPTION:
            raise ValueError(f"a description has at most {_DESCRIPTION} bytes, got {len(text)}")
        self._words[1] = 0
        self._buffer[64 : 64 + len(text)] = text
        self._words[1] = len(text)

    # --- the readers' -----------------------------------------------------------------------------------------------

    @property
    def head(self) -> int:
        """Number of slots written so far."""
        return self._words[0]

    @property
    def description(self) -> dict[str, Any]:
        """What the frames are decoded with; empty if the writer has not said yet."""
        text = bytes(self._buffer[64 : 64 + self._words[1]])
        return dict(json.loads(text)) if text else {}

    def snapshot(self) -> NDArray[Any]:
        """Return a copy of all slots, oldest first, without those that were overwritten while they were copied."""
        head, slots = self.head, self.slots
        begin = head % slots
        copied = self.records[:head].copy()
        if head > slots:
            copied = np.concatenate([self.records[begin:], self.records[:begin]])
        oldest_whole = self.head + _UNSEEN - slots
        return copied[max(0, oldest_whole - (head - len(copied))) :]
