"""Before the torque comes, and how it goes: readiness, confirmed disabling, faults cleared without enabling."""

from collections.abc import Sequence

from robotctl.hal.can.damiao.codec import Special, Status
from robotctl.hal.can.damiao.drive import CONFIRM_TIMEOUT_S, Drive
from robotctl.hal.can.damiao.faults import fault_of, is_fault
from robotctl.hal.can.damiao.verification import Expected, plausible_turns
from robotctl.hal.can.problems import raise_problems
from robotctl.hal.can.transport import Transport
from robotctl.hal.errors import DriveError

DISABLE_TRIES = 10
"""Disable frames before a drive counts as one that cannot be switched off (axol uses 10)."""


def not_ready(drives: Sequence[Drive], expected: Sequence[Expected]) -> list[DriveError]:
    """Ask every drive how it is, and return what forbids enabling: silence, a fault, an impossible angle."""
    problems = []
    for drive, wanted in zip(drives, expected, strict=True):
        try:
            drive.refresh()
        except DriveError as silent:
            problems.append(silent)
            continue
        if is_fault(drive.status):
            fault = fault_of(drive.name, drive.status)
            problems.append(drive.error(f"reports {fault.name}", f"{fault.hint}; then clear the fault"))
        if wanted.bounds and 0 not in plausible_turns(drive.position, wanted.bounds, wanted.turn):
            problems.append(
                drive.error(
                    f"measures {drive.position:.4f} rad, outside its joint's range",
                    "verify the drives again: one that lost its power may have woken up a turn off",
                )
            )
    return problems


def switch_off(drives: Sequence[Drive], transport: Transport) -> None:
    """Disable all drives, each as often as it takes to hear from it that it is off.

    Raises:
        DriveError: if one drive never confirms; DrivesError if several do not. The others are off.
        BusError: if the bus is gone.
    """
    waiting = list(drives)
    for _ in range(DISABLE_TRIES):
        marks = [(drive, drive.heard) for drive in waiting]
        for drive in waiting:
            drive.special(Special.DISABLE)
        transport.wait(lambda marks=marks: not _unconfirmed(marks), CONFIRM_TIMEOUT_S)  # type: ignore[misc]
        waiting = _unconfirmed(marks)
        if not waiting:
            return
    remedy = "cut the power of the drives; without frames their watchdogs should have acted"
    raise_problems([drive.error(f"did not confirm {DISABLE_TRIES} disable frames", remedy) for drive in waiting])


def clear_faults(drives: Sequence[Drive]) -> None:
    """Clear the fault of every drive that reports one. Enables nothing.

    Raises:
        DriveError: if one drive is silent or keeps its fault; DrivesError if several do.
        BusError: if the bus is gone.
    """
    problems = []
    for drive in drives:
        try:
            drive.refresh()
            if is_fault(drive.status):
                drive.answers(Special.CLEAR_ERROR)
                drive.refresh()
        except DriveError as silent:
            problems.append(silent)
            continue
        if is_fault(drive.status):
            fault = fault_of(drive.name, drive.status)
            problems.append(drive.error(f"keeps its fault {fault.name}", fault.hint))
    raise_problems(problems)


def _unconfirmed(marks: Sequence[tuple[Drive, int]]) -> list[Drive]:
    return [drive for drive, mark in marks if drive.heard == mark or drive.status == Status.ENABLED]
