"""How CiA 402 drives get their torque, and how it is taken from them; and faults, cleared without enabling."""

from collections.abc import Callable, Sequence

from robotctl.hal.can.cia402.codec import SYNC_ID, Mode, Nmt
from robotctl.hal.can.cia402.drive import Drive
from robotctl.hal.can.cia402.faults import fault_of
from robotctl.hal.can.cia402.machine import Goal, State, controlword, state_of
from robotctl.hal.can.cia402.network import HostNetwork
from robotctl.hal.can.cia402.objects import CONTROLWORD, ERROR_CODE, STATUSWORD
from robotctl.hal.can.cia402.verification import Expected, misplaced
from robotctl.hal.can.problems import raise_problems
from robotctl.hal.errors import DriveError

Frames = list[tuple[int, bytes]]

CYCLE_S = 0.01
"""Longest wait for the answers to one SYNC, and the pace at which a drive is led through its states."""
ENABLE_S = 1.0
"""Time a drive has to come on: brakes take some 100 ms to open."""
_TRIES = 10
"""SYNCs before a drive counts as silent, or as one that cannot be switched off."""
_SYNC = (SYNC_ID, b"")
_TORQUE = (State.ENABLED, State.QUICK_STOP, State.FAULT_REACTION)
"""The states in which a drive may give torque."""


def not_ready(drives: Sequence[Drive], expected: Sequence[Expected], network: HostNetwork) -> list[DriveError]:
    """Ask every drive how it is, and return what forbids enabling: silence, a restart, a fault, an impossible angle."""
    silent = listen(drives, network)
    problems = []
    for drive, wanted in zip(drives, expected, strict=True):
        if not drive.configured or drive.restarted or drive.nmt != Nmt.OPERATIONAL:
            problems.append(drive.error("has restarted since it was verified", "verify the drives again"))
        elif drive in silent:
            problems.append(drive.silent())
        elif drive.state in (State.FAULT, State.FAULT_REACTION):
            fault = fault_of(drive.name, drive.emergency)
            problems.append(drive.error(f"reports {fault.name}", f"{fault.hint}; then clear the fault"))
        else:
            problems += misplaced(drive, drive.position, wanted.bounds)
    return problems


def listen(drives: Sequence[Drive], network: HostNetwork) -> list[Drive]:
    """Let every drive tell how it is, and return those that did not."""
    waiting = list(drives)
    for _ in range(_TRIES):
        marks = [(drive, drive.heard) for drive in waiting]
        network.transport.send_all([*network.beat(), _SYNC])
        network.wait(lambda marks=marks: not _unheard(marks), CYCLE_S)  # type: ignore[misc]
        waiting = _unheard(marks)
        if not waiting:
            break
    return waiting


def switch_on(drives: Sequence[Drive], network: HostNetwork, hold: Callable[[], Frames]) -> None:
    """Lead all drives to OPERATION ENABLED together.

    Args:
        drives: which have just been found ready.
        network: that they are on.
        hold: returns what those that are on are told meanwhile, as a cycle's frames, and how the others are led on.

    Raises:
        DriveError: if one drive does not come on in time; DrivesError if several do not.
        BusError: if the bus is gone.
    """
    for _ in range(round(ENABLE_S / CYCLE_S)):
        marks = [(drive, drive.heard) for drive in drives]
        network.transport.send_all([*network.beat(), *hold(), _SYNC])
        network.wait(lambda marks=marks: not _unheard(marks), CYCLE_S)  # type: ignore[misc]
        if all(drive.state is State.ENABLED for drive in drives):
            return
        if any(drive.state in (State.FAULT, State.FAULT_REACTION) for drive in drives):
            break
        network.wait(lambda: False, CYCLE_S / 2.0)
    problems = []
    for drive in drives:
        if drive.state in (State.FAULT, State.FAULT_REACTION):
            fault = fault_of(drive.name, drive.emergency)
            problems.append(drive.error(f"reports {fault.name} when it is enabled", fault.hint))
        elif drive.state is not State.ENABLED:
            text = f"did not come on within {ENABLE_S:g} s, it is in state {drive.state}"
            problems.append(drive.error(text, network.transport.refusal or "check its supply and its enable input"))
    raise_problems(problems)


def switch_off(drives: Sequence[Drive], network: HostNetwork) -> None:
    """Take the torque from all drives, as often as it takes to hear from each that it has none.

    Raises:
        DriveError: if one drive never confirms; DrivesError if several do not. The others are off.
        BusError: if the bus is gone.
    """
    waiting = list(drives)
    transport = network.transport
    for _ in range(_TRIES):
        marks = [(drive, drive.heard) for drive in waiting]
        for drive in waiting:
            word = controlword(drive.statusword, Goal.OFF)
            setpoint, _ = drive.encode(word, Mode.POSITION, drive.counts, 0.0, 0.0)
            transport.send(*setpoint, force=True)
        transport.send(*_SYNC, force=True)
        network.wait(lambda marks=marks: not _with_torque(marks), CYCLE_S)  # type: ignore[misc]
        waiting = [drive for drive in _with_torque(marks) if not _is_off(drive)]
        if not waiting:
            return
    remedy = "cut the power of the drives; without the host's heartbeat they should have stopped"
    raise_problems([drive.error(f"did not confirm {_TRIES} times that it is off", remedy) for drive in waiting])


def clear_faults(drives: Sequence[Drive]) -> None:
    """Clear the fault of every drive that reports one, by SDO: a faulty drive exchanges no PDOs yet. Enables nothing.

    Raises:
        DriveError: if one drive is silent or keeps its fault; DrivesError if several do.
        BusError: if the bus is gone.
    """
    problems = []
    for drive in drives:
        try:
            for goal in (Goal.OFF, Goal.CLEAR, Goal.OFF):  # the edge of the reset bit counts
                statusword = drive.read(STATUSWORD)
                if state_of(statusword) is State.FAULT:
                    drive.write(CONTROLWORD, controlword(statusword, goal))
            if state_of(drive.read(STATUSWORD)) is State.FAULT:
                fault = fault_of(drive.name, drive.read(ERROR_CODE))
                problems.append(drive.error(f"keeps its fault {fault.name}", fault.hint))
        except DriveError as problem:
            problems.append(problem)
    raise_problems(problems)


def _unheard(marks: Sequence[tuple[Drive, int]]) -> list[Drive]:
    return [drive for drive, mark in marks if drive.heard == mark]


def _with_torque(marks: Sequence[tuple[Drive, int]]) -> list[Drive]:
    return [drive for drive, mark in marks if drive.heard == mark or drive.state in _TORQUE]


def _is_off(drive: Drive) -> bool:
    """Return whether a drive that exchanges no PDOs says that it is off, when it is asked."""
    if drive.nmt == Nmt.OPERATIONAL and drive.configured:
        return False
    try:
        statusword = drive.read(STATUSWORD)
    except DriveError:
        return False
    return controlword(statusword, Goal.STAY) == 0
