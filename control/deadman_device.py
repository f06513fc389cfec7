"""P22: reads a deadman's switch in a thread of the operator's process, and tells how it is held.

Two kinds: a joystick of Linux (`/dev/input/js0`; its first button is the switch), and anything that writes lines, such
as a serial port or a FIFO: `0` released, `1` held, `2` squeezed. Whatever else it says counts as released; once it
ends, it is unplugged for good.
"""

import os
import select
import struct
import threading
import tty
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

from robotctl.hal.errors import HardwareError
from robotctl.safety.deadman import Grip

_LINES = {b"0": Grip.RELEASED, b"1": Grip.HELD, b"2": Grip.SQUEEZED}
_EVENT = struct.Struct("=IhBB")
"""js_event of linux/joystick.h: time, value, type, number."""
_BUTTON = 0x01
_INITIAL = 0x80
"""Added to the type of the events that tell how things stand when it is opened."""
_POLL_MS = 100


class DeadmanDevice:
    """One switch, as a context: read from entry to exit."""

    def __init__(self, path: Path, tell: Callable[[Grip], None]) -> None:
        self._path = path
        self._tell = tell
        self._take = self._take_events if path.resolve().name.startswith("js") else self._take_lines
        self._pending = b""
        self._ended = threading.Event()

    def __enter__(self) -> Self:
        """Open the device. From here on there is a switch, released until it says otherwise.

        Raises:
            HardwareError: if it cannot be opened.
        """
        try:
            self._fd = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
        except OSError as error:
            what = f"cannot open the deadman's switch {self._path}: {error.strerror}"
            raise HardwareError(
                what, "plug it in; `ls -l /dev/input/js*` shows joysticks and who may read them"
            ) from None
        if os.isatty(self._fd):
            tty.setraw(self._fd)
        self._tell(Grip.RELEASED)
        self._thread = threading.Thread(target=self._read, name="deadman", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
        os.close(self._fd)

    def _read(self) -> None:
        events = select.poll()
        events.register(self._fd, select.POLLIN)
        while not self._ended.is_set():
            if not events.poll(_POLL_MS):
                continue
            try:
                data = os.read(self._fd, 4096)
            except OSError:  # as a joystick or a serial port answers that was pulled out
                data = b""
            if not data:
                self._tell(Grip.UNPLUGGED)
                return
            self._take(data)

    def _take_lines(self, data: bytes) -> None:
        *lines, self._pending = (self._pending + data).split(b"\n")
        for line in lines:
            self._tell(_LINES.get(line.strip(), Grip.RELEASED))

    def _take_events(self, data: bytes) -> None:
        data = self._pending + data
        whole = len(data) // _EVENT.size * _EVENT.size
        self._pending = data[whole:]
        for _, value, kind, number in _EVENT.iter_unpack(data[:whole]):
            if (kind & ~_INITIAL, number) == (_BUTTON, 0):
                self._tell(Grip.HELD if value else Grip.RELEASED)
