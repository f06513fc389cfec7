"""The `canopen` package as the other side: its nodes driven by our driver, our emulated drive driven by its client."""

import itertools
import struct
import time
from collections.abc import Callable, Iterator

import canopen
import numpy as np
import pytest
from canopen.profiles.p402 import BaseNode402

from robotctl.hal.can.cia402.arm import Cia402Arm
from robotctl.hal.can.cia402.machine import State
from robotctl.hal.can.cia402.objects import dictionary
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.errors import DriveError
from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Command, CommandMode
from robotctl.sim.motors.bench import Bench

from .conftest import served

pytestmark = pytest.mark.realtime

_numbers = itertools.count()
_PATIENCE_S = 5.0


def until(condition: Callable[[], bool]) -> bool:
    """Wait for something that other threads do."""
    deadline = time.monotonic() + _PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.002)
    return True


class TheirDrive:
    """A drive in a few lines of canopen's LocalNode: it goes at once where it is told, and knows no heartbeat of ours.

    PDOs and SYNC are done by hand, since a LocalNode has no notion of synchronous PDOs.
    """

    def __init__(self, network: canopen.Network, node: int, counts: int, rated_mnm: int) -> None:
        self.node = canopen.LocalNode(node, dictionary())
        network[node] = self.node
        self.network = network
        self.words: list[int] = []
        for (index, sub), value in {
            (0x1000, 0): 0x20192, (0x1016, 1): 127 << 16 | 80, (0x1017, 0): 100, (0x1018, 1): 0x29C, (0x1018, 2): 7,
            (0x1018, 3): 1, (0x1018, 4): 1, (0x6007, 0): 3, (0x603F, 0): 0, (0x6041, 0): 0x0250, (0x6061, 0): 0,
            (0x6064, 0): counts, (0x606C, 0): 0, (0x6072, 0): 3000, (0x6076, 0): rated_mnm, (0x6077, 0): 0,
            (0x6080, 0): 6000, (0x608F, 1): 131072, (0x608F, 2): 1, (0x60A9, 0): 0x00B50300, (0x6502, 0): 0x380,
            (0x6040, 0): 0, (0x6060, 0): 0, (0x607A, 0): 0, (0x60B1, 0): 0, (0x60B2, 0): 0,
        }.items():  # fmt: skip
            self.put(index, sub, value)
        for index in (0x1400, 0x1401, 0x1800, 0x1801):
            self.put(index, 1, 0x80000000)
        network.subscribe(0x200 + node, self.on_setpoint)
        network.subscribe(0x080, self.on_sync)
        self.pending = b""
        self.node.nmt.send_command(0)

    def put(self, index: int, sub: int, value: int) -> None:
        entry = self.node.object_dictionary.get_variable(index, sub)
        self.node.set_data(index, sub, entry.encode_raw(value))

    def get(self, index: int, sub: int = 0) -> int:
        return int(self.node.object_dictionary.get_variable(index, sub).decode_raw(self.node.get_data(index, sub)))

    def on_setpoint(self, can_id: int, data: bytearray, stamp: float) -> None:
        self.pending = bytes(data)

    def on_sync(self, can_id: int, data: bytearray, stamp: float) -> None:
        if self.node.nmt.state != "OPERATIONAL":
            return
        if self.pending:
            word, mode, position = struct.unpack("<Hbi", self.pending)
            self.pending = b""
            self.words.append(word)
            after = {0x06: 0x0231, 0x07: 0x0233, 0x0F: 0x1237}.get(word, 0x0250)
            self.put(0x6041, 0, after)
            self.put(0x6061, 0, mode)
            if after == 0x1237:
                self.put(0x6064, 0, position)
        for base, index in ((0x180, 0x1A00), (0x280, 0x1A01)):
            mapped = [self.get(index, sub) for sub in range(1, self.get(index, 0) + 1)]
            frame = b"".join(self.node.get_data(word >> 16, word >> 8 & 0xFF) for word in mapped)
            self.network.send_message(base + self.node.id, frame)


@pytest.fixture
def xarm7() -> Robot:
    return load_robot("xarm7")


def test_our_driver_brings_up_leads_and_switches_off_their_drives(xarm7: Robot) -> None:
    name = f"their{next(_numbers)}"
    network = canopen.Network()
    network.connect(interface="virtual", channel=name)
    drives = []
    for joint, angle in zip(xarm7.profile.joints, xarm7.profile.home, strict=True):
        wiring = joint.drive
        counts = wiring.sign * wiring.gear * wiring.resolution / (2 * np.pi) * (angle - wiring.offset)
        drives.append(TheirDrive(network, wiring.id, round(counts), round(wiring.rated_torque * 1e3)))
    arm = Cia402Arm(xarm7, MonotonicClock(), f"virtual:{name}")
    try:
        arm.connect()
        arm.verify()
        assert {identity.vendor for identity in arm.identities.values()} == {0x29C}
        home, rest = np.array(xarm7.profile.home), np.zeros(7)
        assert arm.read().position == pytest.approx(home, abs=1e-5)
        arm.enable()
        for drive in drives:
            led = [word for word, _ in itertools.groupby(drive.words)]
            assert led == [0x06, 0x07, 0x0F]
        target = Command(CommandMode.TRACK, home + 0.05, rest, rest)
        assert until(
            lambda: arm.write(target).delivered and bool(np.allclose(arm.read().position, home + 0.05, atol=1e-5))
        )
        assert arm.read().enabled
        drives[4].node.emcy.send(0x8611)
        assert until(
            lambda: [(fault.joint, fault.name) for fault in arm.read().faults] == [("joint5", "FOLLOWING_ERROR")]
        )
        drives[4].node.emcy.reset()
        assert until(lambda: not arm.read().faults)
        arm.disable()
        assert {drive.words[-1] for drive in drives} == {0}
        drives[2].put(0x1016, 1, 0)
        with pytest.raises(DriveError, match=r"joint3.*no watchdog"):
            arm.verify()
    finally:
        arm.close()
        network.disconnect()


@pytest.fixture
def ours(xarm7: Robot) -> Iterator[tuple[str, Bench]]:
    """Our drives in real time: their channel and their bench."""
    with served(xarm7) as channel_and_bench:
        yield channel_and_bench


def test_their_client_leads_our_drive_through_its_states(
    ours: tuple[str, Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    for timeout in ("RESET_FAULT", "SWITCH_OP_MODE", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE", "CHECK_TPDO"):
        monkeypatch.setattr(BaseNode402, f"TIMEOUT_{timeout}", _PATIENCE_S)
    name, bench = ours
    drive = bench.drive("joint1")
    network = canopen.Network()
    network.connect(interface="virtual", channel=name)
    try:
        node = BaseNode402(1, dictionary())
        network.add_node(node)
        node.sdo.RESPONSE_TIMEOUT = _PATIENCE_S
        assert node.sdo[0x1000].raw == 0x20192
        node.nmt.state = "PRE-OPERATIONAL"
        node.setup_402_state_machine()
        assert node.is_op_mode_supported("CYCLIC SYNCHRONOUS POSITION")
        node.nmt.state = "OPERATIONAL"
        node.sdo[0x607A].raw = node.sdo[0x6064].raw
        node.op_mode = "CYCLIC SYNCHRONOUS POSITION"
        node.tpdo_values[0x6041] = node.sdo[0x6041].raw
        assert node.state == "SWITCH ON DISABLED"
        node.state = "OPERATION ENABLED"
        assert drive.enabled
        node.state = "SWITCH ON DISABLED"
        assert drive.state is State.OFF
        drive.fail(0x8611)
        assert until(lambda: node.is_faulted())
        assert [error.code for error in node.emcy.active] == [0x8611]
        node.controlword = 0x00
        node.controlword = 0x80
        assert until(lambda: node.state == "SWITCH ON DISABLED")
        assert drive.state is State.OFF
        assert until(lambda: not node.emcy.active)
    finally:
        network.disconnect()


def test_their_client_maps_pdos_of_our_drive_only_before_it_is_operational(ours: tuple[str, Bench]) -> None:
    name, bench = ours
    network = canopen.Network()
    network.connect(interface="virtual", channel=name)
    try:
        node = network.add_node(3, dictionary())
        node.sdo.RESPONSE_TIMEOUT = _PATIENCE_S
        node.tpdo.read()
        node.tpdo[1].clear()
        node.tpdo[1].add_variable(0x6064)
        node.tpdo[1].enabled = True
        node.tpdo[1].trans_type = 1
        node.tpdo[1].save()
        assert bench.drive("joint3").dictionary.values[0x1A00, 1] == 0x60640020
        node.nmt.state = "OPERATIONAL"
        assert until(lambda: bench.drive("joint3").nmt == 5)
        with pytest.raises(canopen.SdoAbortedError, match="0x08000022"):
            node.tpdo[1].save()
        network.sync.transmit()
        assert node.tpdo[1].wait_for_reception(_PATIENCE_S) is not None
        counts = bench.drive("joint3").dictionary.get((0x6064, 0))
        assert node.tpdo[1][0].raw == pytest.approx(counts, abs=2)
    finally:
        network.disconnect()
