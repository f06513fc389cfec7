"""Who is on the bus, and if nobody is, why? Every protocol's probe is asked; none of them enables, clears or writes."""

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from robotctl.hal.can.channel import Channel, open_channel
from robotctl.hal.can.cia402.scan import FoundNode, scan_nodes
from robotctl.hal.can.damiao.probe import probe
from robotctl.hal.can.found import FoundMotor
from robotctl.hal.can.transport import Transport
from robotctl.hal.can.verdict import Attempt, bus_findings
from robotctl.hal.can.ways import Way, blind_spots, open_way, other_ways, own_way
from robotctl.hal.clock import Clock
from robotctl.hal.errors import BusError
from robotctl.hal.host import Finding
from robotctl.hal.robot import Robot

LAST_ID = 32

Probe = Callable[[Transport, Clock, int], tuple[FoundMotor, ...]]
"""Asks the ids 1 to a last one, and returns who answered. It may read, and nothing else."""

PROBES: dict[str, Probe] = {"damiao": probe}
"""By protocol, as in a drive's `protocol`. CANopen nodes tell other things of themselves, see `Scan.nodes`."""


@dataclass(frozen=True, slots=True)
class Scan:
    """What a scan found, and what is wrong with the bus as far as that can be seen."""

    motors: tuple[FoundMotor, ...]
    findings: tuple[Finding, ...] = ()
    statistics: dict[str, object] = field(default_factory=dict)
    attempts: tuple[Attempt, ...] = ()
    nodes: tuple[FoundNode, ...] = ()
    """CANopen nodes that answered in the profile's way."""


def scan(channel: Channel, clock: Clock, last_id: int = LAST_ID, way: Way | None = None) -> Attempt:
    """Ask the ids 1 to `last_id` on an open channel, which stays open.

    Raises:
        BusError: if the bus is gone.
    """
    way = way or Way(1_000_000, channel.fd)
    transport = Transport(channel, clock, way.bitrate)
    motors: list[FoundMotor] = []
    failure = ""
    try:
        for ask in PROBES.values():
            motors += ask(transport, clock, last_id)
    except BusError as error:
        if not transport.errors.kinds and not transport.send_failures:
            raise
        failure = error.what  # nobody acknowledges: that is a finding, too
    trips = transport.round_trip() if transport.trips else None
    errors = dict(transport.errors.kinds)
    return Attempt(way, tuple(motors), transport.statistics(), errors, last_id, failure, trips)


def sweep(
    name: str, robot: Robot, clock: Clock, last_id: int = LAST_ID, wanted: Collection[int] = (), thorough: bool = False
) -> Scan:
    """Scan a channel the way that its robot's profile says, and in other ways where somebody is missing.

    A host at a wrong bit rate disturbs whoever talks on the bus, so the others are tried only if nobody answers, if
    one of the ids `wanted` does not and no losses explain it, or if the search is to be `thorough`. A kernel interface
    keeps its bit rate.

    Raises:
        ConfigError: if the channel's name has no known form, or the robot has no CAN drives.
        BusError: if the channel cannot be opened, or is lost.
    """
    channel = open_channel(name, robot, clock)
    wiring = robot.profile.can
    assert wiring is not None  # or there is no channel
    with _open(channel):
        attempts = [scan(channel, clock, last_id, own_way(name, wiring))]
        silent = bool(attempts[0].failure)
        nodes = () if silent else scan_nodes(channel, clock, last_id)
    for way in other_ways(name, wiring):
        found = {motor.id for attempt in attempts for motor in attempt.motors} | {node.id for node in nodes}
        explained = found >= set(wanted) or attempts[0].all_lossy
        if found and explained and not thorough:
            break
        other = open_way(name, wiring, way)
        with _open(other):
            attempts.append(scan(other, clock, last_id, way))
    first = attempts[0]
    # Where only nodes answer, DAMIAO drives are not missed.
    findings = () if nodes and not first.motors else tuple(bus_findings(attempts, blind_spots(name)))
    return Scan(first.motors, findings, first.statistics, tuple(attempts), nodes)


@contextmanager
def _open(channel: Channel) -> Iterator[None]:
    try:
        yield
    finally:
        channel.close()
