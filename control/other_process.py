"""A process that this one has not started: whether it still lives, and its end."""

import os
import select
import signal

_PF_EXITING = 0x4
"""Of the flags in /proc/PID/stat (linux/sched.h)."""
_FLAGS = 6
"""Where they stand behind the process's name."""


class OtherProcess:
    """Another process, by its pid and a pidfd of it, which make sure that no later one with the same pid is meant."""

    def __init__(self, pid: int, pidfd: int) -> None:
        self._pidfd = pidfd
        self._ended = select.poll()
        self._ended.register(pidfd, select.POLLIN)
        try:
            self._stat: int | None = os.open(f"/proc/{pid}/stat", os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            self._stat = None

    def is_over(self, wait_ms: int) -> bool:
        """Return whether it has ended or begun to: it will never run a line of its own code again.

        Waits so long for it. A process that was killed is told from the moment on that the kernel takes it apart;
        its pidfd only tells when that is done, and with hundreds of locked megabytes it takes 50 ms.
        """
        if self._ended.poll(wait_ms) or self._stat is None:
            return True
        try:
            fields = os.pread(self._stat, 1024, 0).rpartition(b")")[2].split()
        except ProcessLookupError:
            return True
        return bool(int(fields[_FLAGS]) & _PF_EXITING)

    def kill(self) -> None:
        """End it, whatever it does; stopped or late, it does not come back. Harmless when it has ended."""
        try:
            signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)
        except ProcessLookupError:
            self._stat = None
