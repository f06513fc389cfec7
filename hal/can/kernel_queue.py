"""The transmit queue of a kernel CAN interface: how much of ours waits in it, and how it is emptied.

The kernel empties it when the interface goes down, and at no other time.
"""

import shutil
import socket
import struct
import subprocess

import can

from robotctl.hal.can.outbox import Witness
from robotctl.hal.errors import BusError

_SO_MEMINFO = 55
"""Linux, asm-generic/socket.h; Python has no name for it."""
_WRITE_ALLOC = 2
"""SK_MEMINFO_WMEM_ALLOC of linux/sock_diag.h: bytes of frames that this socket has sent and no driver has finished."""
_MEMINFO = struct.Struct("9I")
_COMMAND_S = 5.0


class KernelQueue:
    """Fulfils `Outbox` for a socket of python-can's."""

    def __init__(self, interface: str, bus: can.BusABC) -> None:
        self._interface = interface
        self._socket: socket.socket = bus.socket

    def waiting(self) -> bool:
        memory = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
        return int(_MEMINFO.unpack(memory)[_WRITE_ALLOC]) > 0

    def purge(self) -> None:
        for state in ("down", "up"):
            self._set(state)
        # Every open socket has been told that the interface went down; that is over, and no news.
        self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)

    def witness(self) -> Witness:
        try:
            witness: Witness = can.Bus(interface="socketcan", channel=self._interface, fd=True, ignore_config=True)
        except (can.CanError, OSError) as error:
            raise BusError(f"cannot listen on {self._interface}: {error}", "check that the interface is up") from error
        return witness

    def _set(self, state: str) -> None:
        command = [shutil.which("ip", path="/sbin:/usr/sbin:/bin:/usr/bin") or "ip", "link", "set", self._interface]
        try:
            done = subprocess.run([*command, state], capture_output=True, timeout=_COMMAND_S, check=False)
            said = done.stderr.decode(errors="replace").strip()
            problem = said or "it does not say why" if done.returncode else ""
        except (OSError, subprocess.SubprocessError) as error:
            problem = str(error)
        if problem:
            raise BusError(
                f"old frames may wait in the kernel and would be sent when the power returns: {self._interface} could "
                f"not be set {state}: {problem}",
                f"leave the power of the drives off, and run `ip link set {self._interface} down; ip link set "
                f"{self._interface} up` as root; robotctl does it itself where it has CAP_NET_ADMIN",
            )
