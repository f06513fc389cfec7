"""Raw frames from a black box: decoded again into states, and handed on in formats that other tools read."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np
from numpy.typing import NDArray

from robotctl.control.frame_ring import FRAME_DTYPE, Flag
from robotctl.control.recorded import read_recording
from robotctl.control.recording import FRAMES_TOPIC
from robotctl.hal.can.bus_ids import untag
from robotctl.hal.can.cia402.replay import Replayed402
from robotctl.hal.can.damiao.replay import ReplayedDrives
from robotctl.hal.errors import ConfigError
from robotctl.hal.types import Vector

DECODERS: dict[str, Callable[[Mapping[str, Any]], ReplayedDrives | Replayed402]] = {
    "damiao": ReplayedDrives,
    "cia402": Replayed402,
}
"""By the protocol that a description names."""
_STATES_TOPIC = "/state/joints"
EXPORTS = (".log", ".asc")
"""What `export` writes: candump's and Vector's."""


class Frame(NamedTuple):
    """A frame as it crossed the host's end of the bus."""

    stamp_ns: int
    """Monotonic: when it left, or arrived."""
    arbitration_id: int
    """With its bus; see `hal.can.bus_ids`."""
    data: bytes
    flags: Flag


class Replayed(NamedTuple):
    """The state that a tick saw. Arrays are (n,)."""

    stamp_ns: int
    """The tick's."""
    position: Vector
    velocity: Vector
    effort: Vector


class Comparison(NamedTuple):
    """What decoding the frames of a black box again came to."""

    frames: int
    sent: int
    span_s: float
    """From the first frame to the last."""
    ticks: int
    """Marks, each with a state."""
    compared: int
    """Ticks whose state stands in the file, too, and whose joints had all been heard of."""
    different: int
    """Of those, how many are not bit for bit the same: what the supervisor did not believe it had replaced."""


class FrameFile(NamedTuple):
    """The frames of a black box."""

    slots: NDArray[Any]
    """See `frame_ring.FRAME_DTYPE`."""
    description: dict[str, Any]
    wall_offset_ns: int


def read_frames(path: Path) -> FrameFile:
    """Return the raw frames in a black box's file.

    Raises:
        ConfigError: if it cannot be read, or holds none.
    """
    try:
        found = read_recording(path, [FRAMES_TOPIC])
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}", "give the file of a stop: ...-trip-N.mcap") from None
    messages = [logged.message for logged in found.topics.get(FRAMES_TOPIC, [])]
    if not messages:
        raise ConfigError(f"{path} holds no frames", "those of a stop do, where the arm was on a CAN bus")
    slots = np.concatenate([np.frombuffer(message["slots"], FRAME_DTYPE) for message in messages])
    return FrameFile(slots, messages[-1]["description"], found.wall_offset_ns)


def frames_of(slots: NDArray[Any]) -> Iterator[Frame]:
    """Yield frames and marks in their order; a frame whose begin was overwritten is left out."""
    frame: Frame | None = None
    columns = (slots[name].tolist() for name in ("stamp_ns", "id", "flags", "length"))
    for (stamp, identifier, flags, length), data in zip(zip(*columns, strict=True), slots["data"], strict=True):
        part = data.tobytes()
        if flags & Flag.MORE:
            if frame is not None:
                frame = frame._replace(data=(frame.data + part)[:length])
            continue
        if frame is not None:
            yield frame
        frame = Frame(stamp, identifier, part[:length], Flag(flags))
    if frame is not None:
        yield frame


def replay_states(slots: NDArray[Any], description: Mapping[str, Any]) -> Iterator[Replayed]:
    """Decode frames as the driver did, and yield the state at every tick's mark.

    Joints are NaN until they are heard of, as they were for the driver; in a ring that has wrapped, the first ticks
    lack what was overwritten.

    Raises:
        ConfigError: if the frames are of a protocol that is not known.
    """
    protocol = description.get("protocol", "")
    if protocol not in DECODERS:
        raise ConfigError(f"frames of the protocol {protocol!r} cannot be decoded", f"known: {', '.join(DECODERS)}")
    drives = DECODERS[protocol](description)
    for stamp_ns, identifier, data, flags in frames_of(slots):
        if flags & Flag.MARK:
            yield Replayed(stamp_ns, *drives.state())
        elif not flags & (Flag.SENT | Flag.EXTENDED | Flag.ERROR | Flag.REMOTE):
            drives.accept(identifier, data, stamp_ns)


def compare(path: Path) -> Comparison:
    """Decode a black box's frames, and compare each tick's state with the one that was recorded.

    Raises:
        ConfigError: if the file cannot be read, holds no frames, or such that cannot be decoded.
    """
    found = read_frames(path)
    recorded = {
        logged.log_time_ns - found.wall_offset_ns: logged.message
        for logged in read_recording(path, [_STATES_TOPIC]).topics.get(_STATES_TOPIC, [])
    }
    ticks = compared = different = 0
    for state in replay_states(found.slots, found.description):
        ticks += 1
        seen = recorded.get(state.stamp_ns)
        if seen is None or not np.isfinite(state.position).all():
            continue
        compared += 1
        same = all(getattr(state, name).tolist() == seen[name] for name in ("position", "velocity", "effort"))
        different += not same
    frames = [frame for frame in frames_of(found.slots) if not frame.flags & Flag.MARK]
    stamps = [frame.stamp_ns for frame in frames] or [0]
    sent = sum(bool(frame.flags & Flag.SENT) for frame in frames)
    return Comparison(len(frames), sent, (max(stamps) - min(stamps)) * 1e-9, ticks, compared, different)


def export(frames: FrameFile, path: Path) -> int:
    """Write the frames for other tools, and return how many. Their stamps are wall time, in microseconds.

    Raises:
        ConfigError: if the file's ending is none of `EXPORTS`, it exists, or it cannot be written.
    """
    if path.suffix not in EXPORTS:
        raise ConfigError(f"{path}: unknown ending", f"use one of {', '.join(EXPORTS)}")
    if path.exists():
        raise ConfigError(f"{path} already exists", "export to another file")
    count = 0
    try:
        with can.Logger(path) as writer:
            for frame in frames_of(frames.slots):
                if not frame.flags & Flag.MARK:
                    writer.on_message_received(_message(frame, frames.wall_offset_ns))
                    count += 1
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}", "check the folder and the space left") from None
    return count


def _message(frame: Frame, offset_ns: int) -> can.Message:
    flags = frame.flags
    fd = bool(flags & Flag.FD)
    bus, wire_id = untag(frame.arbitration_id)
    return can.Message(
        timestamp=(frame.stamp_ns + offset_ns) * 1e-9,
        arbitration_id=wire_id,
        is_extended_id=bool(flags & Flag.EXTENDED),
        is_error_frame=bool(flags & Flag.ERROR),
        is_remote_frame=bool(flags & Flag.REMOTE),
        is_fd=fd,
        bitrate_switch=fd,
        is_rx=not flags & Flag.SENT,
        data=frame.data,
        channel=f"can{bus}",
    )
