"""Which CANopen nodes are on the bus, and what they are. SDO reads only: nothing is written, started or enabled."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.cia402.codec import HOST_ID, Service
from robotctl.hal.can.cia402.drive import Drive
from robotctl.hal.can.cia402.faults import fault_of
from robotctl.hal.can.cia402.machine import State, state_of
from robotctl.hal.can.cia402.network import HostNetwork
from robotctl.hal.can.cia402.objects import (
    DEVICE_PROFILE,
    DEVICE_TYPE,
    ERROR_CODE,
    HEARTBEAT_CONSUMER,
    PRODUCT,
    STATUSWORD,
    VENDOR,
)
from robotctl.hal.can.cia402.verification import Expected, Identity, examine_drive
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import Clock
from robotctl.hal.errors import DriveError
from robotctl.hal.profile import Cia402Drive
from robotctl.hal.robot import Robot

_ROUNDS = 2
_BATCH = 4
_BATCH_WAIT_S = 0.005
_DEVICE_TYPE_REQUEST = bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0))


@dataclass(frozen=True, slots=True)
class FoundNode:
    """A node that answered."""

    id: int
    profile: int
    """Device profile, 402 for a drive; 0 if it did not tell."""
    vendor: int = 0
    product: int = 0
    watchdog_s: float = 0.0
    """How long it waits for this host's heartbeat; 0 if it does not."""
    status: str = ""


def scan_nodes(channel: Channel, clock: Clock, last_id: int = HOST_ID - 1) -> tuple[FoundNode, ...]:
    """Ask the node ids 1 to `last_id` what they are. The channel stays open.

    Raises:
        BusError: if the bus is gone.
    """
    transport = Transport(channel, clock)
    answered: set[int] = set()
    transport.listener = lambda arbitration_id, _: answered.add(arbitration_id - Service.SDO_REPLY)
    ids = range(1, min(last_id, HOST_ID - 1) + 1)
    for _ in range(_ROUNDS):
        for start in range(0, len(ids), _BATCH):
            for node in ids[start : start + _BATCH]:
                transport.send(Service.SDO + node, _DEVICE_TYPE_REQUEST)
            transport.wait(lambda: False, _BATCH_WAIT_S)
    transport.listener = None
    network = HostNetwork(transport, clock, beats=False)
    return tuple(_look(network, node) for node in ids if node in answered)


def examine_drives(
    robot: Robot, channel: Channel, clock: Clock
) -> Iterator[tuple[str, int, Identity | None, Sequence[DriveError], Sequence[str]]]:
    """Yield joint, node id, identity, problems and warnings of every CiA 402 drive of a profile."""
    network = HostNetwork(Transport(channel, clock), clock, beats=False)
    for joint in robot.profile.joints:
        if isinstance(joint.drive, Cia402Drive):
            warnings: list[str] = []
            drive = Drive(joint.name, joint.drive, network)
            identity, problems = examine_drive(drive, Expected.of(robot, joint), warnings)
            yield joint.name, joint.drive.id, identity, problems, warnings


def _look(network: HostNetwork, node: int) -> FoundNode:
    wiring = Cia402Drive(protocol="cia402", id=node, resolution=1, rated_torque=1.0)  # until its own are read
    drive = Drive(f"node {node}", wiring, network)
    try:
        profile = drive.read(DEVICE_TYPE) & 0xFFFF
        if profile != DEVICE_PROFILE:
            return FoundNode(node, profile)
        consumer, state = drive.read_if_there(HEARTBEAT_CONSUMER) or 0, state_of(drive.read(STATUSWORD))
        status = state.value if state else "unknown"
        if state is State.FAULT:
            status += f" ({fault_of('', drive.read_if_there(ERROR_CODE) or 0).name})"
        waits = consumer >> 16 & 0x7F == HOST_ID
        return FoundNode(
            node,
            profile,
            drive.read(VENDOR),
            drive.read_if_there(PRODUCT) or 0,
            1e-3 * (consumer & 0xFFFF) * waits,
            status,
        )
    except DriveError:
        return FoundNode(node, 0, status="fell silent")
