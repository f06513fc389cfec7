"""A recording: tick records and events as an MCAP file, which Foxglove, Rerun and PlotJuggler open.

| channel           | schema                | holds                                                             |
|-------------------|-----------------------|-------------------------------------------------------------------|
| `/state/joints`   | foxglove.JointStates  | measured position, velocity, effort                               |
| `/state/tool`     | foxglove.Point3InFrame| tool point of the measured position, frame `base`                 |
| `/command/joints` | foxglove.JointStates  | what the drives were asked to do                                  |
| `/wanted`         | JSON                  | what policy or routine asked for, before the limits               |
| `/truth/joints`   | foxglove.JointStates  | true position and velocity, where the backend knows them          |
| `/truth/tool`     | foxglove.Point3InFrame| true tool point, where the backend knows it                       |
| `/safety`         | JSON                  | supervisor's state, epoch, clip flags and timing of every tick    |
| `/event`          | JSON                  | every event as the loop wrote it                                  |
| `/log`            | foxglove.Log          | the events that have a text                                       |
| `/can/frames`     | robotctl.Frames       | black boxes only: raw frames of the bus, see `frame_ring`         |

Everything is timed in wall clock: the monotonic stamp plus one offset, taken once. `/safety` and `/event` keep the
monotonic stamp as `stamp_ns`; for the others it is the log time less the metadata's `wall_offset_ns`.
"""

import io
import json
import math
import os
import struct
import time
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import foxglove
from foxglove.channels import JointStatesChannel, LogChannel, Point3InFrameChannel
from foxglove.mcap import MCAPWriteOptions
from foxglove.messages import (
    JointState,
    JointStates,
    Log,
    LogLevel,
    Point3,
    Point3InFrame,
    Timestamp,
)
from numpy.typing import NDArray

import robotctl
from robotctl.hal.clock import Clock, MonotonicClock
from robotctl.hal.robot import Robot
from robotctl.safety.machine import State
from robotctl.safety.shaper import Clip

BASE_FRAME = "base"
METADATA = "robotctl"
"""Name of the file's metadata record."""
_SECOND_NS = 1_000_000_000

_LEVELS = {"trip": LogLevel.Error, "page": LogLevel.Error, "error": LogLevel.Fatal, "dropped": LogLevel.Warning}
"""How loud a type of event is in the log; anything else is information."""


FRAMES_TOPIC = "/can/frames"
FRAMES_SCHEMA = "robotctl.Frames"
_FRAMES_PER_MESSAGE = 10_000


def _schema(title: str, **properties: dict[str, object]) -> dict[str, object]:
    return {"title": title, "type": "object", "properties": properties}


_INTEGER: dict[str, object] = {"type": "integer"}
_NUMBER: dict[str, object] = {"type": "number"}
_TEXT: dict[str, object] = {"type": "string"}

_SAFETY_SCHEMA = _schema(
    "robotctl.Safety",
    tick=_INTEGER,
    stamp_ns={**_INTEGER, "description": "monotonic"},
    state=_TEXT,
    epoch=_INTEGER,
    seq={**_INTEGER, "description": "of the target in force"},
    clip={"type": "array", "items": _TEXT, "description": "limits that changed the wanted motion"},
    lateness_us=_NUMBER,
    duration_us=_NUMBER,
)
_WANTED_SCHEMA = _schema(
    "robotctl.Wanted",
    values={"type": "array", "items": _NUMBER, "description": "per joint: rad/s of a velocity target, Nm of a torque"},
)
_EVENT_SCHEMA = _schema("robotctl.Event", type=_TEXT, stamp_ns={**_INTEGER, "description": "monotonic"}, text=_TEXT)


def wall_offset_ns(clock: Clock | None = None) -> int:
    """Return what turns a stamp of `clock` (the machine's monotonic one if None) into nanoseconds since 1970."""
    return time.time_ns() - (clock or MonotonicClock()).now_ns()


class Recording:
    """One MCAP file being written. A context manager; made by `open`.

    A file that cannot be written any further shows in `take`, `flush` or `close`: it is noticed when a chunk goes
    out, not with the record that filled it. What is in the file by then stays readable.
    """

    def __init__(self, file: "_File", robot: Robot, offset_ns: int) -> None:
        self.path = file.path
        self.ticks = 0
        """Tick records taken."""
        self._file = file
        self._offset_ns = offset_ns
        self._names = [joint.name for joint in robot.profile.joints]
        self._context = foxglove.Context()
        # Without seeking, a chunk goes out in one piece: a process killed at any moment leaves whole chunks behind.
        options = MCAPWriteOptions(disable_seeking=True, compression_threads=0)
        self._writer = foxglove.open_mcap(file, context=self._context, writer_options=options)
        self._state_joints = self._joints("/state/joints")
        self._state_tool = self._point("/state/tool")
        self._command_joints = self._joints("/command/joints")
        self._wanted = self._json("/wanted", _WANTED_SCHEMA)
        self._truth_joints = self._joints("/truth/joints")
        self._truth_tool = self._point("/truth/tool")
        self._safety = self._json("/safety", _SAFETY_SCHEMA)
        self._event = self._json("/event", _EVENT_SCHEMA)
        self._log = LogChannel("/log", context=self._context)

    @classmethod
    def open(
        cls, path: str | os.PathLike[str], robot: Robot, about: Mapping[str, object], offset_ns: int | None = None
    ) -> Self:
        """Create the file, and write what it is about into it.

        Args:
            path: must not exist.
            robot: whose ticks are recorded; its profile is attached, as written and as in force.
            about: what else the file should say of itself, such as backend and seed.
            offset_ns: of `wall_offset_ns`; by default that of the machine's monotonic clock, taken now.

        Raises:
            FileExistsError: if the file exists.
            OSError: if it cannot be created or written to.
        """
        offset_ns = wall_offset_ns() if offset_ns is None else offset_ns
        file = _File(Path(path))
        try:
            recording = cls(file, robot, offset_ns)
            recording._introduce(robot, about)
            recording.flush()
        except BaseException:
            file.close()
            file.path.unlink(missing_ok=True)
            raise
        return recording

    def take(self, records: NDArray[Any], events: Iterable[Mapping[str, Any]] = ()) -> None:
        """Write tick records and events, each in their order.

        Raises:
            OSError: if the file cannot be written to.
        """
        if len(records):
            self._take_ticks(records)
        for event in events:
            self._take_event(event)
        self._file.check()

    def take_frames(self, slots: NDArray[Any], description: Mapping[str, Any]) -> None:
        """Write raw frames, and what they are decoded with.

        Args:
            slots: of `frame_ring.FRAME_DTYPE`, in their order.
            description: in terms of JSON.

        Raises:
            OSError: if the file cannot be written to.
        """
        schema = foxglove.Schema(name=FRAMES_SCHEMA, encoding="", data=b"")
        channel = foxglove.Channel(FRAMES_TOPIC, schema=schema, message_encoding=FRAMES_SCHEMA, context=self._context)
        head = json.dumps(description).encode()
        for begin in range(0, len(slots), _FRAMES_PER_MESSAGE):
            part = slots[begin : begin + _FRAMES_PER_MESSAGE]
            message = struct.pack("<I", len(head)) + head + part.tobytes()
            channel.log(message, log_time=int(part["stamp_ns"][-1]) + self._offset_ns)
        self._file.check()

    def flush(self) -> None:
        """Bring everything taken so far into the file.

        Raises:
            OSError: if the file cannot be written to.
        """
        self._writer.flush()
        self._file.check()

    def close(self) -> None:
        """Finish the file. Harmless when already closed.

        Raises:
            OSError: if the file cannot be written to.
        """
        if self._file.closed:
            return
        try:
            self._writer.close()
            self._file.sync()
            self._file.check()
        finally:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -- channels -------------------------------------------------------------------------------------------------

    def _joints(self, topic: str) -> JointStatesChannel:
        return JointStatesChannel(topic, context=self._context)

    def _point(self, topic: str) -> Point3InFrameChannel:
        return Point3InFrameChannel(topic, context=self._context)

    def _json(self, topic: str, schema: dict[str, object]) -> foxglove.Channel:
        return foxglove.Channel(topic, schema=schema, context=self._context)

    # -- conversion -----------------------------------------------------------------------------------------------

    def _introduce(self, robot: Robot, about: Mapping[str, object]) -> None:
        now = time.time_ns()
        facts = {
            "robot": robot.profile.name,
            "version": robotctl.__version__,
            "wall_offset_ns": self._offset_ns,
            "servo_hz": robot.profile.servo_hz,
            **about,
        }
        texts = {
            key: value if isinstance(value, str) else json.dumps(value, default=str) for key, value in facts.items()
        }
        self._writer.write_metadata(METADATA, texts)
        in_force = robot.profile.model_dump_json(indent=1).encode()
        for name, kind, data in (
            ("profile.yaml", "application/yaml", robot.source.read_bytes()),
            ("profile.json", "application/json", in_force),
        ):
            self._writer.attach(log_time=now, create_time=now, name=name, media_type=kind, data=data)

    def _take_ticks(self, records: NDArray[Any]) -> None:
        # One conversion per column is many times cheaper than one per value.
        column = {name: records[name].tolist() for name in records.dtype.names or ()}
        nothing = [None] * len(self._names)
        for row, stamp_ns in enumerate(column["stamp_ns"]):
            at = stamp_ns + self._offset_ns
            stamp = _timestamp(at)
            state = column["position"][row], column["velocity"][row], column["effort"][row]
            command = column["command_position"][row], column["command_velocity"][row], column["command_effort"][row]
            self._state_joints.log(self._joint_states(stamp, *state), log_time=at)
            self._command_joints.log(self._joint_states(stamp, *command), log_time=at)
            self._state_tool.log(_point(stamp, column["tool"][row]), log_time=at)
            if column["has_truth"][row]:
                truth = column["true_position"][row], column["true_velocity"][row], nothing
                self._truth_joints.log(self._joint_states(stamp, *truth), log_time=at)
                self._truth_tool.log(_point(stamp, column["true_tool"][row]), log_time=at)
            self._wanted.log({"values": [_plain(value) for value in column["wanted"][row]]}, log_time=at)
            safety = {
                "tick": column["tick"][row],
                "stamp_ns": stamp_ns,
                "state": _state_name(column["state"][row]),
                "epoch": column["epoch"][row],
                "seq": column["seq"][row],
                "clip": _clip_names(column["clip"][row]),
                "lateness_us": column["lateness_ns"][row] / 1e3,
                "duration_us": column["duration_ns"][row] / 1e3,
            }
            self._safety.log(safety, log_time=at)
        self.ticks += len(records)

    def _take_event(self, event: Mapping[str, Any]) -> None:
        at = int(event.get("stamp_ns", 0)) + self._offset_ns
        self._event.log(dict(event), log_time=at)
        text = event.get("text")
        if not text:
            return
        kind = str(event.get("type", ""))
        level = LogLevel.Warning if event.get("ok") is False else _LEVELS.get(kind, LogLevel.Info)
        self._log.log(Log(timestamp=_timestamp(at), level=level, message=str(text), name=kind), log_time=at)

    def _joint_states(
        self, stamp: Timestamp, position: list[float], velocity: list[float], effort: list[float] | list[None]
    ) -> JointStates:
        joints = [
            JointState(name=name, position=q, velocity=v, effort=f)
            for name, q, v, f in zip(self._names, position, velocity, effort, strict=True)
        ]
        return JointStates(timestamp=stamp, joints=joints)


class _File:
    """The file below the SDK's writer. It never fails towards the SDK, and shows the first error in `check`.

    foxglove-sdk 0.30 does not pass write errors on to whoever logs a message: it drops the message, and some writes
    later its writer panics. So after an error this takes all bytes and keeps none.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._raw = io.FileIO(path, "xb")
        self._position = 0
        self._error: OSError | None = None

    @property
    def closed(self) -> bool:
        return self._raw.closed

    def write(self, data: bytes | bytearray) -> int:
        self._position += len(data)
        rest = memoryview(data)
        try:
            while self._error is None and not self.closed and len(rest):
                rest = rest[self._raw.write(rest) :]
        except OSError as error:
            self._error = error
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Tell the position; the writer was told not to move."""
        wanted = self._position + offset if whence == os.SEEK_CUR else offset
        if whence == os.SEEK_END or wanted != self._position:
            raise io.UnsupportedOperation("this file is only appended to")
        return self._position

    def flush(self) -> None:
        """Nothing is held back here."""

    def sync(self) -> None:
        """Have the disk keep it, too."""
        try:
            os.fsync(self._raw.fileno())
        except OSError as error:
            self._error = self._error or error

    def check(self) -> None:
        """Raise the first error there was."""
        if self._error is not None:
            raise OSError(self._error.errno, self._error.strerror, str(self.path))

    def close(self) -> None:
        self._raw.close()


def _timestamp(at: int) -> Timestamp:
    return Timestamp(sec=at // _SECOND_NS, nsec=at % _SECOND_NS)


def _point(stamp: Timestamp, point: list[float]) -> Point3InFrame:
    x, y, z = point
    return Point3InFrame(timestamp=stamp, frame_id=BASE_FRAME, point=Point3(x=x, y=y, z=z))


def _plain(value: float) -> float | None:
    """Return what JSON can say of a number."""
    return value if math.isfinite(value) else None


@cache
def _state_name(number: int) -> str:
    try:
        return State(number).name
    except ValueError:
        return f"UNKNOWN({number})"


@cache
def _clip_names(flags: int) -> list[str]:
    return [flag.name for flag in Clip if flag & flags and flag.name is not None]
