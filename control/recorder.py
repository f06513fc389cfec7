"""The recorder: a process of its own that follows a session's ring and writes a recording.

It holds a read-only view of the board, so nothing it does, nor its death, reaches the loop. It ends when something
comes in on stdin, or its end; when it is sent SIGTERM; or when its parent dies. Each time it first takes what is in
the ring, then finishes the file. Its last words are one line of JSON on stdout.
"""

import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from robotctl.control.process_tools import name_process, signal_on_parent_death
from robotctl.control.recording import Recording
from robotctl.control.shared import Board
from robotctl.hal.errors import ConfigError, RobotctlError
from robotctl.hal.robot import Robot, load_robot

_POLL_S = 0.05
_FLUSH_STEPS = 20
"""Steps between flushes: a recorder that is killed takes no more than the last second with it."""
_STOP_TIMEOUT_S = 30.0
"""A full ring of 60 s takes about 3 s on an idle core."""


@dataclass(frozen=True, slots=True)
class RecorderConfig:
    """What a recorder is told at its start."""

    robot: str
    """Name, or path of the profile."""
    overrides: list[str]
    board_fd: int
    slots: int
    path: str
    about: dict[str, object]
    parent: int
    """Pid of the process that started it."""

    def to_json(self) -> str:
        return json.dumps(asdict(self))


class Follower:
    """Takes what is new on a board into a recording."""

    def __init__(self, board: Board, recording: Recording) -> None:
        self.dropped = 0
        """Ticks that were overwritten before they were taken."""
        self._board = board
        self._recording = recording
        self._tick_cursor = 0
        self._event_cursor = 0
        self._steps = 0

    def step(self) -> None:
        """Take what is new.

        Raises:
            OSError: if the recording cannot be written to.
        """
        records, self._tick_cursor, dropped = self._board.ticks.since(self._tick_cursor)
        begin = self._event_cursor
        try:
            events, self._event_cursor = self._board.events.since(begin)
        except ValueError:  # one was overwritten while it was read: go on behind it
            events, self._event_cursor = [], begin + 1
        dropped_events = self._event_cursor - begin - len(events)
        if dropped or dropped_events:
            self.dropped += dropped
            stamp = int(records["stamp_ns"][0]) if len(records) else 0
            events.insert(0, _dropped(stamp, dropped, dropped_events))
        self._recording.take(records, events)
        self._steps += 1
        if self._steps % _FLUSH_STEPS == 0:
            self._recording.flush()


def _dropped(stamp_ns: int, ticks: int, events: int) -> dict[str, Any]:
    text = f"the recorder fell behind: {ticks} ticks and {events} events are missing here"
    return {"type": "dropped", "stamp_ns": stamp_ns, "ticks": ticks, "events": events, "text": text}


def main(text: str) -> int:
    """Run one recorder to its end and return its exit status."""
    ending: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: ending.append(number))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the operator process's business
    name_process("robotctl-rec")
    config = RecorderConfig(**json.loads(text))
    signal_on_parent_death(signal.SIGTERM, config.parent)
    try:
        _say(_record(config, ending))
    except (OSError, RobotctlError) as error:
        _say({"error": str(error)})
        return 1
    return 0


def _record(config: RecorderConfig, ending: list[int]) -> dict[str, object]:
    robot = load_robot(config.robot, config.overrides)
    board = Board.attach(config.board_fd, robot.dof, config.slots)
    with Recording.open(config.path, robot, config.about) as recording:
        follower = Follower(board, recording)
        while not ending and not select.select([sys.stdin], [], [], _POLL_S)[0]:
            follower.step()
        follower.step()
    return {"recorded": recording.ticks, "dropped": follower.dropped, "path": config.path}


def _say(words: Mapping[str, object]) -> None:
    with suppress(BrokenPipeError):  # nobody is left to listen
        os.write(sys.stdout.fileno(), json.dumps(words).encode() + b"\n")


class RecorderProcess:
    """The parent's end of a recorder. Made by `start`; `stop` it after the session has ended."""

    def __init__(self, process: subprocess.Popen[bytes], path: Path, complaints: Any) -> None:
        self.path = path
        self._process = process
        self._complaints = complaints
        self._summary: dict[str, Any] | None = None

    @classmethod
    def start(
        cls,
        robot: Robot,
        board_fd: int,
        slots: int,
        path: str | os.PathLike[str],
        about: Mapping[str, object],
        overrides: Sequence[str] = (),
    ) -> Self:
        """Start recording a board, from the oldest tick that it remembers.

        To be called from the main thread: a recorder takes the end of the thread that started it for its parent's.

        Args:
            robot: whose board it is.
            board_fd: descriptor of the board; it stays the caller's.
            slots: how many ticks the board remembers.
            path: of the file, which must not exist.
            about: what the file should say of itself, in terms of JSON.
            overrides: those that `robot` was loaded with.

        Raises:
            ConfigError: if there already is such a file, or it has no folder.
        """
        path = Path(path).absolute()
        if path.exists():
            raise ConfigError(f"{path} already exists", "record to another file; recordings are never overwritten")
        if not path.parent.is_dir():
            raise ConfigError(f"there is no folder {path.parent} to record to", "create it first")
        source, parent = str(robot.source.absolute()), os.getpid()
        fd = Board.read_only(board_fd)
        complaints = tempfile.TemporaryFile()  # noqa: SIM115 - closed in stop()
        try:
            config = RecorderConfig(source, list(overrides), fd, slots, str(path), dict(about), parent)
            process = subprocess.Popen(
                [sys.executable, "-m", "robotctl.control.recorder", config.to_json()],
                pass_fds=(fd,),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=complaints,
                start_new_session=True,  # Ctrl-C in the terminal must not reach it
            )
        except BaseException:
            complaints.close()
            raise
        finally:
            os.close(fd)
        return cls(process, path, complaints)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether it still records."""
        return self._process.poll() is None

    def stop(self, timeout_s: float = _STOP_TIMEOUT_S) -> dict[str, Any]:
        """End it, and return its last words: `recorded`, `dropped` and `path`, or `error`. Never raises for its sake.

        Called again, it returns the same.
        """
        if self._summary is not None:
            return self._summary
        process = self._process
        process.send_signal(signal.SIGCONT)  # one that was suspended has all of the ring to catch up with
        try:
            # A byte, too: a forked child of ours may hold the pipe open.
            words, _ = process.communicate(b"\n", timeout=timeout_s)
        except subprocess.TimeoutExpired:
            process.kill()
            words, _ = process.communicate()
        self._complaints.seek(0)
        complaint = self._complaints.read().decode(errors="replace").strip()
        self._complaints.close()
        self._summary = _last_words(words, process.returncode, complaint)
        return self._summary


def _last_words(words: bytes, status: int, complaint: str) -> dict[str, Any]:
    for line in reversed(words.splitlines()):
        with suppress(ValueError):
            summary: dict[str, Any] = json.loads(line)
            return summary
    how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
    return {"error": f"the recorder {how}" + (f"\n{complaint}" if complaint else "")}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
