"""Records a session from its first tick: a recorder process in real time, the same file inline in lockstep.

Either way the black box writes out the last minute after a trip, from the operator's side, whatever became of the
recorder.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robotctl.control.black_box import BlackBox
from robotctl.control.process_session import ProcessSession
from robotctl.control.recorder import Follower, RecorderProcess
from robotctl.control.recording import Recording
from robotctl.control.session import Session
from robotctl.control.shared import Board
from robotctl.hal.errors import ConfigError


@dataclass(slots=True)
class SessionRecording:
    """What became of a recording; complete once the context has been left."""

    path: Path
    processes: dict[str, int | None] = field(default_factory=dict)
    """Pids of the session's processes, by their part."""
    black_boxes: list[Path] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def report(self) -> dict[str, Any]:
        """Return the report's entries about recording."""
        return {
            "recording": str(self.path) if self.path.exists() else None,
            "black_boxes": [str(path) for path in self.black_boxes],
            "recording_problems": self.problems,
        }


@contextmanager
def record_session(
    session: Session,
    path: Path,
    about: Mapping[str, object],
    on_trip: Callable[[dict[str, Any]], None],
    overrides: Sequence[str] = (),
) -> Iterator[SessionRecording]:
    """Record an open session until the context is left, and call `on_trip` for every trip.

    Raises:
        ConfigError: if the file exists, or its folder cannot be made.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot make the folder {path.parent}: {error.strerror}", "record elsewhere") from None
    if path.exists():
        raise ConfigError(f"{path} already exists", "record to another file; recordings are never overwritten")
    recording = SessionRecording(path)
    black_box = BlackBox(session.robot, session.link, path.with_suffix(""), about, frames=session.frames)

    def tripped(event: dict[str, Any]) -> None:
        black_box.on_trip(event)
        on_trip(event)

    session.on_trip = tripped
    try:
        if isinstance(session, ProcessSession):
            with _beside(session, recording, about, overrides):
                yield recording
        else:
            with _inline(session, recording, about):
                yield recording
    finally:
        session.on_trip = None
        recording.black_boxes = black_box.flush()
        recording.problems += black_box.problems


@contextmanager
def _beside(
    session: ProcessSession, recording: SessionRecording, about: Mapping[str, object], overrides: Sequence[str]
) -> Iterator[None]:
    recorder = RecorderProcess.start(
        session.robot, session.fds[1], session.link.ticks.slots, recording.path, about, overrides
    )
    recording.processes = {"control": session.pid, "watchman": session.watchman_pid, "recorder": recorder.pid}
    try:
        yield
    finally:
        words = recorder.stop()
        if "error" in words:
            recording.problems.append(words["error"])
        elif words["dropped"]:
            recording.problems.append(f"{words['dropped']} ticks are missing from the recording")


@contextmanager
def _inline(session: Session, recording: SessionRecording, about: Mapping[str, object]) -> Iterator[None]:
    with Recording.open(recording.path, session.robot, about) as file:
        follower = Follower(Board(session.link.events, session.link.ticks), file)
        session.on_poll = follower.step
        try:
            yield
        finally:
            session.on_poll = None
            follower.step()
