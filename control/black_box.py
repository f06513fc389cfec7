"""The black box: after a trip, everything the rings remember, states and raw frames, goes into a file of its own.

It lives on the operator's side and reads the ring itself, so it needs no recorder and survives the loss of one. The
ring is copied at once; the file is written by a thread, beside whatever the operator's side does next.
"""

import os
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from robotctl.control.frame_ring import FrameRing
from robotctl.control.recording import Recording
from robotctl.control.shared import Board, Link, TickRing
from robotctl.hal.robot import Robot

_SETTLE_NS = 1_000_000_000
"""How much after the trip is to be in the file: the stop."""
_PATIENCE_S = 1.5
"""Longest wait for that, should the loop have ended."""
_POLL_S = 0.02


class BlackBox:
    """Writes `<stem>-trip-<n>.mcap` per trip, with the next free n; trips within one stop share a file.

    Give `on_trip` to `Session.on_trip`, and call `flush` before the session's memory goes.

    Args:
        robot: whose rings they are.
        link: the session's link, or a board.
        stem: path of the files up to `-trip-<n>.mcap`.
        about: what the files should say of themselves.
        offset_ns: of `recording.wall_offset_ns`; by default that of the machine's monotonic clock.
        frames: the session's ring of raw frames, if it has one.
    """

    def __init__(
        self,
        robot: Robot,
        link: Link | Board,
        stem: str | os.PathLike[str],
        about: Mapping[str, object],
        offset_ns: int | None = None,
        frames: FrameRing | None = None,
    ) -> None:
        self.paths: list[Path] = []
        """Files written so far."""
        self.problems: list[str] = []
        """What went wrong, in words."""
        self._robot = robot
        self._link = link
        self._stem = Path(stem)
        self._about = dict(about)
        self._offset_ns = offset_ns
        self._frames = frames
        self._lock = threading.Lock()
        self._hurry = threading.Event()
        self._trips: list[dict[str, Any]] = []
        self._writing: list[threading.Thread] = []

    def on_trip(self, event: Mapping[str, Any]) -> None:
        """Have a trip written down soon. Returns at once."""
        with self._lock:
            self._trips.append(dict(event))
            if len(self._trips) > 1:
                return  # the thread that waits for the first one will take this along
            # Not a daemon: an interpreter that ends waits for the file.
            thread = threading.Thread(target=self._work, name="black-box")
            self._writing = [*(other for other in self._writing if other.is_alive()), thread]
            thread.start()

    def flush(self) -> list[Path]:
        """Write what is pending now, and return the paths of all files."""
        self._hurry.set()
        for thread in list(self._writing):
            thread.join()
        self._hurry.clear()
        return list(self.paths)

    def _work(self) -> None:
        self._wait()
        with self._lock:
            trips, self._trips = self._trips, []
            records = snapshot(self._link.ticks)
            frames = None if self._frames is None else (self._frames.snapshot(), self._frames.description)
            events = self._events()
        try:
            path = self._write(records, events, trips, frames)
        except OSError as error:
            self.problems.append(f"no black box of the trip {trips[0].get('text', '')!r}: {error}")
        else:
            self.paths.append(path)

    def _wait(self) -> None:
        """Wait until the stop is in the ring, by the ring's own time: it may be simulated, and run faster."""
        ends_ns = int(self._trips[0]["stamp_ns"]) + _SETTLE_NS
        deadline = time.monotonic() + _PATIENCE_S
        while time.monotonic() < deadline:
            latest = self._link.ticks.latest()
            if (latest is not None and latest["stamp_ns"] >= ends_ns) or self._hurry.wait(_POLL_S):
                return

    def _events(self) -> list[dict[str, Any]]:
        for _ in range(3):
            try:
                return self._link.events.since(0)[0]
            except ValueError:
                time.sleep(_POLL_S)  # the oldest one was being overwritten
        self.problems.append("the black box lacks all events but the trip: the ring of events could not be read")
        return []

    def _write(
        self,
        records: NDArray[Any],
        events: list[dict[str, Any]],
        trips: list[dict[str, Any]],
        frames: tuple[NDArray[Any], dict[str, Any]] | None,
    ) -> Path:
        about = {**self._about, "trip": trips[0].get("text", "")}
        number = 1
        while True:
            path = Path(f"{self._stem}-trip-{number}.mcap")
            try:
                recording = Recording.open(path, self._robot, about, self._offset_ns)
            except FileExistsError:
                number += 1
                continue
            with recording:
                recording.take(records, events or trips)
                if frames is not None:
                    recording.take_frames(*frames)
            return path


def snapshot(ring: TickRing) -> NDArray[Any]:
    """Return all records that a ring holds, without those that were overwritten while they were copied."""
    records, head, _ = ring.since(0)
    first = head - len(records)
    overwritten = max(0, ring.head + 1 - ring.slots - first)
    return records[overwritten:]
