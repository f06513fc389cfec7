"""Frames of CiA 402 drives in words, for people who watch a bus."""

import struct

from robotctl.hal.can.cia402 import codec
from robotctl.hal.can.cia402.codec import HOST_ID, NMT_ID, SYNC_ID, Mode, Nmt, NmtCommand, Service
from robotctl.hal.can.cia402.faults import fault_of
from robotctl.hal.can.cia402.machine import Word, state_of
from robotctl.hal.can.cia402.objects import ENTRIES
from robotctl.hal.can.cia402.units import Units
from robotctl.hal.profile import Cia402Drive
from robotctl.hal.robot import Robot

_NAMES = {entry.index: entry.name for entry in ENTRIES if not entry.in_record}


class Words402:
    """Decodes with the ids and units of a robot's profile. What it does not know it says so of."""

    def __init__(self, robot: Robot) -> None:
        self._drives = {
            joint.drive.id: (joint.name, Units.of(joint.drive))
            for joint in robot.profile.joints
            if isinstance(joint.drive, Cia402Drive)
        }

    def __call__(self, arbitration_id: int, data: bytes) -> str:
        """Return what a frame says."""
        if (arbitration_id, data) == (SYNC_ID, b""):
            return "SYNC"
        if arbitration_id == NMT_ID and len(data) == 2:
            return f"to {self._name(data[1])}: NMT {_named(NmtCommand, data[0])}"
        if arbitration_id == Service.HEARTBEAT + HOST_ID and len(data) == 1:
            return f"host: {_named(Nmt, data[0])}"
        node = arbitration_id & 0x7F
        if node not in self._drives:
            return "?"
        name, units = self._drives[node]
        try:
            return self._service(arbitration_id - node, name, units, data)
        except struct.error:
            return f"{name}: {len(data)} bytes that make no sense"

    def _service(self, service: int, name: str, units: Units, data: bytes) -> str:
        match service:
            case Service.RPDO1:
                word, mode, counts = codec.decode_setpoint(data)
                position = counts / units.counts + units.offset
                return f"to {name}: {_named(Word, word)}, {_named(Mode, mode)}, {position:.4f} rad"
            case Service.RPDO2:
                speed, torque = codec.decode_feed_forward(data)
                return f"to {name}: {speed / units.counts:.3f} rad/s, {torque / units.permille:.2f} Nm"
            case Service.TPDO1:
                statusword, counts, torque = codec.decode_status(data)
                position = counts / units.counts + units.offset
                state = state_of(statusword) or f"statusword 0x{statusword:04X}"
                return f"{name}: {state}, {position:.4f} rad, {torque / units.permille:.2f} Nm"
            case Service.TPDO2:
                speed, mode = codec.decode_motion(data)
                return f"{name}: {speed / units.counts:.3f} rad/s, {_named(Mode, mode)}"
            case Service.EMCY:
                code = codec.decode_emergency(data).code
                return f"{name}: EMCY {fault_of(name, code).name if code else 'cause has gone'}"
            case Service.HEARTBEAT:
                return f"{name}: {_named(Nmt, data[0])}" if len(data) == 1 else "?"
            case Service.SDO | Service.SDO_REPLY:
                (index, sub) = struct.unpack_from("<HB", data, 1)
                what = f"0x{index:04X}:{sub} {_NAMES.get(index, '')}".rstrip()
                kind = (
                    {1: "write", 2: "read", 4: "abort"}
                    if service == Service.SDO
                    else {2: "is", 3: "written", 4: "abort"}
                )
                told = kind.get(data[0] >> 5, "transfer")
                value = f" 0x{int.from_bytes(data[4:8], 'little'):X}" if told in ("write", "is", "abort") else ""
                return f"{'to ' if service == Service.SDO else ''}{name}: SDO {told} {what}{value}"
        return "?"

    def _name(self, node: int) -> str:
        return "all" if node == 0 else self._drives[node][0] if node in self._drives else f"node {node}"


def _named(kind: type[Word] | type[Mode] | type[Nmt] | type[NmtCommand], value: int) -> str:
    """Return an enumeration's name for a value, or the value."""
    return kind(value).name.replace("_", " ") if value in tuple(kind) else f"0x{value:X}"
