"""The guard's own reading of CANopen frames to CiA 402 drives: what kind of message a frame is, and what it asks.

A motion takes two frames, RPDO1 (controlword u16, mode i8, position i32) and RPDO2 (velocity i32, torque i16), which
have to leave together: neither says anything without the other. Everything is little-endian.
"""

import math
from collections.abc import Iterator, Sequence

from robotctl.hal.can.cia402.codec import HOST_ID, NMT_ID, SYNC_ID, Mode, Nmt, NmtCommand, Service
from robotctl.hal.can.cia402.machine import Word
from robotctl.hal.profile import Cia402Drive, Joint, RobotProfile
from robotctl.safety.asked import Asked, Kind, Move, Reading, Step, stranger

_WORDS: dict[int, Kind] = {
    Word.DISABLE_VOLTAGE: Kind.DISABLE,
    Word.QUICK_STOP: Kind.DISABLE,
    Word.SHUTDOWN: Kind.ENABLE,
    Word.SWITCH_ON: Kind.ENABLE,
    Word.FAULT_RESET: Kind.CLEAR,
}
"""ENABLE OPERATION is missing: it goes with every motion, and moves no drive that was not led up to it."""
_NETWORK: dict[int, Kind] = {NmtCommand.START: Kind.START, NmtCommand.ENTER_PRE_OPERATIONAL: Kind.MODE}
_SETTINGS = frozenset({0x1400, 0x1401, 0x1600, 0x1601, 0x1800, 0x1801, 0x1A00, 0x1A01, 0x60C2})
"""Objects of the layout of PDOs, and the cycle time."""
_ZEROED = frozenset({0x60FF, 0x6071})
"""Targets of velocity and torque, which have to be 0: a drive adds to them what the PDOs say."""
_SETPOINT, _FEED_FORWARD = 7, 6
_DOWNLOAD = 1
_READING = (2, 3, 4)
"""Command specifiers of SDO requests: uploads, and the end of a transfer."""
_HALF = 0.5005
"""Half a step, and what floating point adds."""


class Joint402:
    """One drive: its motions in joint coordinates."""

    def __init__(self, joint: Joint, drive: Cia402Drive) -> None:
        scale = drive.sign * drive.gear
        self._radian = 2.0 * math.pi / (drive.resolution * scale)
        self._newton_metre = 1e-3 * drive.rated_torque * scale
        self._offset = drive.offset
        self._gains = joint.gains
        self.step = Step(
            _HALF * abs(self._radian), _HALF * abs(self._radian), 0.0, 0.0, _HALF * abs(self._newton_metre)
        )

    def asked(self, setpoint: bytes, feed_forward: bytes) -> Asked | None:
        """Return what both frames ask, or None for a mode in which drives are not led.

        The gains are not on the wire: a drive tracks with those that it was commissioned with.
        """
        position = _signed(setpoint[3:]) * self._radian + self._offset
        velocity = _signed(feed_forward[:4]) * self._radian
        effort = _signed(feed_forward[4:]) * self._newton_metre
        kp, kd = self._gains.kp, self._gains.kd
        match setpoint[2]:
            case Mode.POSITION:
                return Asked(Kind.TRACK, position, velocity, kp, kd, effort)
            case Mode.VELOCITY:
                return Asked(Kind.DAMP, position, velocity, 0.0, kd, effort)
            case Mode.TORQUE:
                return Asked(Kind.TORQUE, position, velocity, 0.0, 0.0, effort)
        return None


class Wire402:
    """Tells the kinds of all messages on the bus of an arm with CiA 402 drives."""

    def __init__(self, profile: RobotProfile, rest: Reading) -> None:
        """Take the drives from the profile; frames that are none of theirs are read by `rest`."""
        drives = [
            (index, joint, joint.drive)
            for index, joint in enumerate(profile.joints)
            if isinstance(joint.drive, Cia402Drive)
        ]
        self._joints = {index: Joint402(joint, drive) for index, joint, drive in drives}
        self._nodes = {drive.id for _, _, drive in drives}
        self._setpoints = {Service.RPDO1 + drive.id: index for index, _, drive in drives}
        self._feed_forwards = {Service.RPDO2 + drive.id: index for index, _, drive in drives}
        self._rest = rest

    def read(
        self, frames: Sequence[tuple[int, bytes]], measured: Sequence[tuple[float, float]]
    ) -> Iterator[Kind | Move | str]:
        """Return what frames that leave together ask for; a text for one that is not on the list."""
        waiting: dict[int, bytes] = {}
        for arbitration_id, data in frames:
            index = self._setpoints.get(arbitration_id)
            if index is not None and len(data) == _SETPOINT:
                waiting[index] = data
                word = _word(data)
                if word != Word.ENABLE_OPERATION:
                    yield _WORDS.get(word) or stranger(arbitration_id, data)
                continue
            index = self._feed_forwards.get(arbitration_id)
            if index in waiting and len(data) == _FEED_FORWARD:
                setpoint, joint = waiting.pop(index), self._joints[index]
                if _word(setpoint) == Word.ENABLE_OPERATION:
                    asked = joint.asked(setpoint, data)
                    yield Move(index, asked, joint.step) if asked else stranger(arbitration_id, data)
                continue
            kind = self._kind(arbitration_id, data)
            if kind is None:
                yield from self._rest.read([(arbitration_id, data)], measured)
            else:
                yield kind
        if any(_word(setpoint) == Word.ENABLE_OPERATION for setpoint in waiting.values()):
            yield "a setpoint without its feed-forward: half a motion"

    def _kind(self, arbitration_id: int, data: bytes) -> Kind | None:
        if (arbitration_id, data) in ((SYNC_ID, b""), (Service.HEARTBEAT + HOST_ID, bytes((Nmt.OPERATIONAL,)))):
            return Kind.READ
        if arbitration_id == NMT_ID and len(data) == 2:
            return _NETWORK.get(data[0]) if data[1] in self._nodes else None
        if arbitration_id - Service.SDO in self._nodes and len(data) == 8:
            return _transfer_kind(data)
        return None


def _transfer_kind(data: bytes) -> Kind:
    command = data[0] >> 5
    if command in _READING:
        return Kind.READ
    index = int.from_bytes(data[1:3], "little")
    if command == _DOWNLOAD and (index in _SETTINGS or (index in _ZEROED and not any(data[4:]))):
        return Kind.MODE
    return Kind.STORE


def _word(setpoint: bytes) -> int:
    return int.from_bytes(setpoint[:2], "little")


def _signed(data: bytes) -> int:
    return int.from_bytes(data, "little", signed=True)
