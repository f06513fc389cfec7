"""One CiA 402 drive, seen from the host: requests by SDO, and what it says of itself in PDOs, EMCY and heartbeat.

Positions, velocities and efforts are those of the joint.
"""

from collections.abc import Sequence

from canopen import SdoAbortedError, SdoCommunicationError

from robotctl.hal.can.cia402.codec import (
    EMERGENCY,
    FEED_FORWARD,
    MOTION,
    SETPOINT,
    STATUS,
    Mode,
    Nmt,
    NmtCommand,
    Service,
)
from robotctl.hal.can.cia402.faults import NOT_OPERATIONAL, SILENT, fault_of
from robotctl.hal.can.cia402.machine import State, Word, state_of
from robotctl.hal.can.cia402.network import TRIES, HostNetwork
from robotctl.hal.can.cia402.objects import Entry
from robotctl.hal.can.cia402.units import I16, I32, Units
from robotctl.hal.errors import DriveError
from robotctl.hal.profile import Cia402Drive
from robotctl.hal.types import Fault

_OFF_BITS = 0x40
_LOST_BEATS = 3
"""Heartbeats in a row that may stay away; the rest of a period more."""


class Drive:
    """A drive on a network. The fields are what it said last; `stamp_ns` is 0 before its first TPDO1."""

    def __init__(self, name: str, wiring: Cia402Drive, network: HostNetwork) -> None:
        """Register with the network. Sends nothing. `name` is the joint's, for messages."""
        self.name = name
        self.id = wiring.id
        self.wiring = wiring
        self.units = Units.of(wiring)
        self.statusword = _OFF_BITS
        self.state = State.OFF
        self.mode = int(Mode.NONE)
        self.position = float("nan")
        self.velocity = float("nan")
        self.effort = float("nan")
        self.counts = 0
        """The position as it came, increments."""
        self.emergency = 0
        """Error code of the latest EMCY; 0 when its cause has gone."""
        self.nmt = int(Nmt.BOOT_UP)
        self.configured = False
        """Whether its PDOs are mapped and it was started."""
        self.restarted = False
        """Whether it has booted since then, so that nothing is left of its PDOs."""
        self.stamp_ns = 0
        self.heard = 0
        """TPDO1s so far."""
        self.missed = 0
        """SYNCs without an answer before the next one."""
        self.reply_pending = False
        self.sent_ns = 0
        self.saturated = False
        """Whether a value given to `encode` lay outside the wire's range; whoever looks resets it."""
        self.beat_ns = 0
        """When its heartbeat came last."""
        self.beat_period_ns = 0
        self.setpoint_id = Service.RPDO1 + self.id
        self.feed_forward_id = Service.RPDO2 + self.id
        self._trips = network.transport.trips
        self._node = network.attach(self.id)
        for service, route in (
            (Service.TPDO1, self.accept_status),
            (Service.TPDO2, self.accept_motion),
            (Service.EMCY, self.accept_emergency),
            (Service.HEARTBEAT, self.accept_heartbeat),
        ):
            network.transport.by_id[service + self.id] = route
            network.transport.reply_ids.add(service + self.id)

    # --- the fast path ----------------------------------------------------------------------------------------------

    def encode(
        self, word: Word, mode: Mode, counts: int, velocity: float, effort: float
    ) -> tuple[tuple[int, bytes], tuple[int, bytes]]:
        """Return both RPDOs (id, data): position in increments, rad/s and Nm. Sets `saturated` where it must clip."""
        per_radian, permille, _ = self.units
        speed, torque = round(velocity * per_radian), round(effort * permille)
        if not (-I32 <= counts <= I32 and -I32 <= speed <= I32 and -I16 <= torque <= I16):
            self.saturated = True
            counts, speed = min(max(counts, -I32), I32), min(max(speed, -I32), I32)
            torque = min(max(torque, -I16), I16)
        return (
            (self.setpoint_id, SETPOINT.pack(word, mode, counts)),
            (self.feed_forward_id, FEED_FORWARD.pack(speed, torque)),
        )

    def counts_of(self, position: float) -> int:
        """Return a joint angle in increments."""
        return round((position - self.units.offset) * self.units.counts)

    def expect_reply(self, now_ns: int) -> None:
        """Note that a SYNC goes out; one that is still unanswered counts as missed."""
        if self.reply_pending:
            self.missed += 1
        self.reply_pending = True
        self.sent_ns = now_ns

    def accept_status(self, data: bytearray, stamp_ns: int) -> bool:
        """Take a TPDO1; return whether it made sense."""
        if len(data) != STATUS.size:
            return False
        statusword, counts, torque = STATUS.unpack(data)
        state = state_of(statusword)
        if state is None:
            return False
        self.statusword, self.state, self.counts = statusword, state, counts
        self.position = counts / self.units.counts + self.units.offset
        self.effort = torque / self.units.permille
        self.stamp_ns = stamp_ns
        self.heard += 1
        if self.reply_pending:
            self.reply_pending = False
            self._trips.append(max(stamp_ns - self.sent_ns, 0))
        return True

    def accept_motion(self, data: bytearray, stamp_ns: int) -> bool:
        """Take a TPDO2."""
        if len(data) != MOTION.size:
            return False
        speed, self.mode = MOTION.unpack(data)
        self.velocity = speed / self.units.counts
        return True

    def accept_emergency(self, data: bytearray, stamp_ns: int) -> bool:
        """Take an EMCY."""
        if len(data) != EMERGENCY.size:
            return False
        self.emergency = EMERGENCY.unpack(data)[0]
        return True

    def accept_heartbeat(self, data: bytearray, stamp_ns: int) -> bool:
        """Take a heartbeat. One that tells of a restart tells that there is no torque, too."""
        if len(data) != 1:
            return False
        self.nmt = data[0] & 0x7F
        self.beat_ns = stamp_ns
        self.restarted |= self.nmt == Nmt.BOOT_UP
        if self.nmt != Nmt.OPERATIONAL and self.configured:
            self.statusword, self.state = _OFF_BITS, State.OFF
        return True

    def fault(self, now_ns: int) -> Fault | None:
        """Return what is wrong with it, if anything: its own fault, or that it left, or is not there any more."""
        if self.state in (State.FAULT, State.FAULT_REACTION) or self.emergency:
            return fault_of(self.name, self.emergency)
        if not self.configured:
            return None
        if now_ns - self.beat_ns > (_LOST_BEATS + 0.5) * self.beat_period_ns:
            return fault_of(self.name, SILENT)
        return fault_of(self.name, NOT_OPERATIONAL) if self.nmt != Nmt.OPERATIONAL else None

    @property
    def commands(self) -> set[int]:
        """The ids of frames that tell it to do something, but for those that go to all drives."""
        return {self.setpoint_id, self.feed_forward_id, Service.SDO + self.id}

    # --- requests: bring-up and shutdown, not for the loop ----------------------------------------------------------

    def read(self, entry: Entry) -> int:
        """Return an entry of the drive's object dictionary.

        Raises:
            DriveError: if the drive does not answer, or has no such entry.
        """
        try:
            return int(self._variable(entry).raw)
        except SdoAbortedError as abort:
            raise self.error(f"does not tell {entry}: {abort}", "is it a drive of the CiA 402 profile?") from abort
        except SdoCommunicationError as silent:
            raise self.silent() from silent

    def read_if_there(self, entry: Entry) -> int | None:
        """Return an entry that the standard leaves optional, or None. Raises as `read` if there is no answer."""
        try:
            return int(self._variable(entry).raw)
        except SdoAbortedError:
            return None
        except SdoCommunicationError as silent:
            raise self.silent() from silent

    def write(self, entry: Entry, value: int) -> None:
        """Write an entry in RAM, and read it back.

        Raises:
            DriveError: if the drive does not answer, refuses, or does not keep the value.
        """
        try:
            self._variable(entry).raw = value
            kept = int(self._variable(entry).raw)
        except SdoAbortedError as abort:
            raise self.error(f"does not take {value} for {entry}: {abort}", "see its manual") from abort
        except SdoCommunicationError as silent:
            raise self.silent() from silent
        if kept != value:
            raise self.error(f"keeps {entry} at {kept}, {value} was written", "see its manual")

    def map_pdos(self, rpdos: Sequence[Sequence[Entry]], tpdos: Sequence[Sequence[Entry]], transmission: int) -> None:
        """Map its first PDOs to these entries, and read back that they are.

        Raises:
            DriveError: if the drive does not answer, refuses, or keeps another mapping.
        """
        bases = (Service.RPDO1, Service.RPDO2), (Service.TPDO1, Service.TPDO2)
        try:
            for maps, wanted, ids in zip((self._node.rpdo, self._node.tpdo), (rpdos, tpdos), bases, strict=True):
                for number, (entries, base) in enumerate(zip(wanted, ids, strict=True), 1):
                    pdo = maps[number]
                    pdo.cob_id, pdo.enabled, pdo.trans_type = base + self.id, True, transmission
                    pdo.clear()
                    for entry in entries:
                        pdo.add_variable(entry.index, entry.sub)
                    pdo.save()
                    pdo.read()
                    found = [(variable.index, variable.subindex) for variable in pdo.map]
                    if (pdo.cob_id, pdo.enabled, pdo.trans_type) != (base + self.id, True, transmission) or (
                        found != [(entry.index, entry.sub) for entry in entries]
                    ):
                        raise self.error(f"keeps another mapping of PDO 0x{base + self.id:X}", "see its manual")
        except SdoAbortedError as abort:
            raise self.error(f"does not let its PDOs be mapped: {abort}", "see its manual") from abort
        except SdoCommunicationError as silent:
            raise self.silent() from silent

    def start(self, now_ns: int) -> None:
        """Let it take part in the exchange of PDOs, as they are mapped."""
        self.command(NmtCommand.START)
        self.configured, self.nmt, self.beat_ns = True, int(Nmt.OPERATIONAL), now_ns

    def command(self, command: NmtCommand) -> None:
        """Send a network management command to this drive alone."""
        self._node.nmt.send_command(command)

    def error(self, what: str, remedy: str = "") -> DriveError:
        """Return an error that names this drive's joint and id."""
        return DriveError(self.name, self.id, what, remedy)

    def silent(self) -> DriveError:
        """Return the error for a drive that does not answer."""
        return self.error(
            f"does not answer ({TRIES} requests)",
            f"check its power, the cable and the ground, termination (120 Ohm at both ends), that its node id is "
            f"{self.id}, and the bit rate: CANopen is classic CAN",
        )

    def _variable(self, entry: Entry):  # type: ignore[no-untyped-def]
        found = self._node.sdo[entry.index]
        return found[entry.sub] if entry.in_record else found
