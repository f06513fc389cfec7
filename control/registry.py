"""Which control processes run on this machine, so that `robotctl stop` finds them.

One small JSON file per control process in the user's runtime folder, named after its pid. A file whose process is
gone, or whose pid was given to another process since, is removed when met.
"""

import json
import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path

from robotctl.hal.can.channel import is_shared, split_channels
from robotctl.hal.errors import BusError


@dataclass(frozen=True, slots=True)
class Running:
    """One running control process."""

    pid: int
    started: int
    """Start time of the process in clock ticks since boot: tells a process from a later one with the same pid."""
    operator: int
    """Pid of the process that started it."""
    robot: str
    backend: str
    channel: str
    watches: int = 0
    """Of a watchman: pid of its control process. It counts once that is gone, while it brings the arm down."""


def folder() -> Path:
    """Return the folder of the registry, which may not exist yet.

    It depends on the user alone, so that `robotctl stop` finds an arm from any shell; `ROBOTCTL_RUNTIME_DIR` moves it.
    """
    user = os.getuid()
    runtime = Path(f"/run/user/{user}")
    base = os.environ.get("ROBOTCTL_RUNTIME_DIR") or (runtime if runtime.is_dir() else "/tmp")  # noqa: S108
    return Path(base) / f"robotctl-{user}"


def start_time(pid: int) -> int | None:
    """Return a process's start time in clock ticks since boot, or None if it is gone or a zombie."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else int(fields[19])


def register(robot: str, backend: str, channel: str, operator: int, watches: int = 0) -> Path:
    """Enter this process, and return its file, which the caller removes at its end."""
    pid = os.getpid()
    entry = Running(pid, start_time(pid) or 0, operator, robot, backend, channel, watches)
    folder().mkdir(mode=0o700, parents=True, exist_ok=True)
    path = folder() / f"{pid}.json"
    path.write_text(json.dumps(asdict(entry)))
    return path


def claim(channel: str) -> socket.socket:
    """Take a channel for this process alone, until what is returned is closed or the process has ended.

    The name is an abstract socket's: it is the machine's, not a user's, and vanishes with its process.

    Raises:
        BusError: if another process has it: two that command the same drives would fight over them.
    """
    interface, _, where = channel.partition(":")
    name = f"{interface}:{os.path.realpath(where) if where.startswith('/') else where}"
    mine = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        mine.bind(f"\0robotctl-{sha256(name.encode()).hexdigest()}")
    except OSError:
        mine.close()
        raise BusError(f"{channel} is in use by another robotctl", "end that one first") from None
    return mine


@contextmanager
def claimed(channel: str) -> Iterator[None]:
    """Have a channel, or several with commas between them, for this process alone, if others can reach what is there.

    Raises:
        BusError: if another process has it.
    """
    with ExitStack() as stack:
        for one in split_channels(channel) if is_shared(channel) else ():
            stack.enter_context(claim(one))
        yield


def unregister(pid: int) -> None:
    """Remove a process's file, if there is one."""
    with suppress(FileNotFoundError):
        (folder() / f"{pid}.json").unlink()


def running() -> list[Running]:
    """Return the control processes of this user that are alive, and the watchmen of those that are not."""
    found = []
    for path in sorted(folder().glob("*.json")):
        try:
            entry = Running(**json.loads(path.read_text()))
        except (OSError, ValueError, TypeError):
            continue  # being written, or just removed
        if start_time(entry.pid) == entry.started:
            found += [entry] if not entry.watches or start_time(entry.watches) is None else []
        else:
            unregister(entry.pid)
    return found
