"""slcan adapters on pseudo-terminals: serial devices that any program can open, without a kernel that knows CAN."""

import os
import pty
import select
import termios
import time
import tty

import can

from robotctl.hal.errors import BusError
from robotctl.sim.motors.slcan import SlcanAdapter

_CHUNK = 4096
_BACKLOG = 1 << 16
"""Bytes kept for a host that does not read; beyond that, frames are lost as in a real adapter's memory."""


class SlcanPort:
    """Adapters side by side on one bus: what the host of one sends, the drives and the hosts of the others receive."""

    carries_errors = False

    def __init__(self, count: int = 1, bitrate: int = 1_000_000) -> None:
        """Open `count` pseudo-terminals, set to `bitrate` until a host sets another.

        Raises:
            BusError: if there are none to be had.
        """
        self.bitrate: int | None = bitrate
        """Of the latest frame from a host: adapters at another neither hear it nor what answers it."""
        self._terminals: dict[int, _Terminal] = {}
        self._poll = select.poll()
        for _ in range(count):
            terminal = _Terminal()
            self._terminals[terminal.descriptor] = terminal
            self._poll.register(terminal.descriptor, select.POLLIN)

    @property
    def paths(self) -> list[str]:
        """The devices that hosts open."""
        return [terminal.path for terminal in self._terminals.values()]

    @property
    def name(self) -> str:
        return ", ".join(f"slcan:{path}" for path in self.paths)

    @property
    def fd(self) -> bool:
        """Whether any host has set its adapter to CAN FD."""
        return any(terminal.adapter.fd for terminal in self._terminals.values())

    @property
    def garbage(self) -> int:
        """Commands that were refused."""
        return sum(terminal.refused for terminal in self._terminals.values())

    def receive(self, timeout_s: float) -> list[can.Message]:
        frames: list[can.Message] = []
        awake = False
        for descriptor, events in self._poll.poll(timeout_s * 1e3):
            terminal = self._terminals[descriptor]
            if events & select.POLLIN:
                awake = True
                for frame in terminal.read():
                    self.bitrate = terminal.adapter.bitrate
                    self._deliver(frame, terminal)
                    frames.append(frame)
            else:
                terminal.hang_up()
        if not awake:
            # A terminal that no host has open wakes the poll at once, for ever.
            time.sleep(timeout_s if self._any_hung_up else 0.0)
        for terminal in self._terminals.values():
            terminal.flush()
        return frames

    def send(self, frame: can.Message) -> bool:
        return self._deliver(frame, None)

    def close(self) -> None:
        for terminal in self._terminals.values():
            os.close(terminal.descriptor)
        self._terminals.clear()

    @property
    def _any_hung_up(self) -> bool:
        return any(terminal.is_hung_up for terminal in self._terminals.values())

    def _deliver(self, frame: can.Message, sender: "_Terminal | None") -> bool:
        """Hand a frame to every adapter but the sender's; return whether all that are open could take it."""
        taken = True
        for terminal in self._terminals.values():
            adapter = terminal.adapter
            if terminal is not sender and adapter.is_open and adapter.bitrate == self.bitrate:
                taken &= terminal.write(adapter.encode(frame))
        return taken


class _Terminal:
    def __init__(self) -> None:
        try:
            self.descriptor, host = pty.openpty()
        except OSError as error:
            raise BusError(f"cannot open a pseudo-terminal: {error}", "is /dev/pts mounted?") from error
        # Raw, so that nothing is echoed or translated even if the host's program does not ask for it.
        tty.setraw(host, termios.TCSANOW)
        self.path = os.ttyname(host)
        os.close(host)
        os.set_blocking(self.descriptor, False)
        self.adapter = SlcanAdapter(None)
        self.refused = 0
        self.is_hung_up = False
        self._backlog = bytearray()

    def read(self) -> list[can.Message]:
        self.is_hung_up = False
        try:
            data = os.read(self.descriptor, _CHUNK)
        except OSError:
            # Readable and hung up at once, with nothing left to read.
            self.hang_up()
            return []
        answers, frames = self.adapter.feed(data)
        self.refused += answers.count(b"\a")
        self.write(answers)
        return frames

    def write(self, data: bytes) -> bool:
        if len(self._backlog) + len(data) > _BACKLOG:
            return False
        self._backlog += data
        self.flush()
        return True

    def flush(self) -> None:
        if not self._backlog or self.is_hung_up:
            return
        try:
            del self._backlog[: os.write(self.descriptor, self._backlog)]
        except BlockingIOError:
            return
        except OSError:
            self.hang_up()

    def hang_up(self) -> None:
        if not self.is_hung_up:
            self.is_hung_up = True
            self.adapter.reset()
            self._backlog.clear()
