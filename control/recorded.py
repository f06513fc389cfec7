"""What stands in a recording: messages by topic, as plain Python values; of an unfinished one, what can be had."""

import json
import os
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from robotctl.control.recording import FRAMES_SCHEMA, METADATA


class Logged(NamedTuple):
    """One message of a recording."""

    log_time_ns: int
    """Wall clock, since 1970."""
    message: dict[str, Any]
    """A JSON message as it is; of JointStates `name`, `position`, `velocity` and `effort` as lists; of
    Point3InFrame `frame_id` and `point`; of Log `level`, `name` and `message`; of Frames `description` and `slots`."""


@dataclass(slots=True)
class Recorded:
    """What stands in a recording."""

    metadata: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    topics: dict[str, list[Logged]] = field(default_factory=dict)
    """In the order of the file."""
    is_complete: bool = False
    """False if the file was never finished; then its last second or so may be missing."""

    @property
    def wall_offset_ns(self) -> int:
        """What to take from a log time for the monotonic stamp."""
        return int(self.metadata["wall_offset_ns"])


def read_recording(path: str | os.PathLike[str], topics: Collection[str] | None = None) -> Recorded:
    """Read a recording, or what can be had of an unfinished one.

    Args:
        path: of the file.
        topics: the channels to read; all by default.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if it is no MCAP file.
    """
    # Only needed to read: robot hosts that record can do without.
    from mcap.exceptions import EndOfFile, InvalidMagic
    from mcap.records import Attachment, Channel, Footer, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader

    found = Recorded()
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    with Path(path).open("rb") as file:
        try:
            for record in StreamReader(file).records:
                match record:
                    case Schema():
                        schemas[record.id] = record.name
                    case Channel():
                        channels[record.id] = (record.topic, schemas.get(record.schema_id, ""))
                    case Message():
                        topic, schema = channels[record.channel_id]
                        if topics is None or topic in topics:
                            logged = Logged(record.log_time, _decode(schema, record.data))
                            found.topics.setdefault(topic, []).append(logged)
                    case Metadata() if record.name == METADATA:
                        found.metadata = dict(record.metadata)
                    case Attachment():
                        found.attachments[record.name] = record.data
                    case Footer():
                        found.is_complete = True
        except InvalidMagic as error:
            raise ValueError(f"{path}: not an MCAP file") from error
        except (EndOfFile, struct.error):
            found.is_complete = False
    return found


def _decode(schema: str, data: bytes) -> dict[str, Any]:
    match schema:
        case "foxglove.JointStates":
            joints = [dict(_fields(part)) for number, part in _fields(data) if number == 2]
            message: dict[str, Any] = {"name": [joint.get(1, b"").decode() for joint in joints]}
            for number, key in ((2, "position"), (3, "velocity"), (5, "effort")):
                message[key] = [joint.get(number) for joint in joints]
            return message
        case "foxglove.Point3InFrame":
            parts = dict(_fields(data))
            point = dict(_fields(parts.get(3, b"")))
            return {"frame_id": parts.get(2, b"").decode(), "point": [point.get(axis, 0.0) for axis in (1, 2, 3)]}
        case "foxglove.Log":
            parts = dict(_fields(data))
            texts = {"message": parts.get(3, b"").decode(), "name": parts.get(4, b"").decode()}
            return {"level": parts.get(2, 0), **texts}
        case _ if schema == FRAMES_SCHEMA:
            (length,) = struct.unpack_from("<I", data)
            return {"description": json.loads(data[4 : 4 + length]), "slots": data[4 + length :]}
        case _:
            message = json.loads(data)
            return dict(message)


def _fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """Yield number and value of each field of a protobuf message: int, float (of a double) or bytes.

    See "Encoding" in the protocol buffers documentation.
    """
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        match tag & 7:
            case 0:
                value, at = _varint(data, at)
                yield tag >> 3, value
            case 1:
                yield tag >> 3, struct.unpack_from("<d", data, at)[0]
                at += 8
            case 2:
                length, at = _varint(data, at)
                yield tag >> 3, data[at : at + length]
                at += length
            case 5:
                yield tag >> 3, struct.unpack_from("<f", data, at)[0]
                at += 4
            case kind:
                raise ValueError(f"unknown protobuf wire type {kind}")


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return value, at
