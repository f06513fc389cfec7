"""What a DAMIAO drive's status nibble means to a person."""

from robotctl.hal.can.damiao.codec import Status
from robotctl.hal.types import Fault

_HINTS = {
    Status.SENSOR_ERROR: "the encoder failed; power-cycle the drive, and replace it if that does not help",
    Status.PARAMETER_ERROR: "a stored parameter is out of range; load the vendor's defaults",
    Status.OVER_VOLTAGE: "supply above register 29; braking feeds energy back, check the supply",
    Status.UNDER_VOLTAGE: "supply below register 0; check the supply, its cable and the e-stop",
    Status.OVER_CURRENT: "phase current above register 3; check for a blocked joint",
    Status.MOSFET_OVER_TEMPERATURE: "the driver is too hot; let it cool",
    Status.ROTOR_OVER_TEMPERATURE: "the motor is too hot; let it cool, and lower the load",
    Status.COMMUNICATION_LOST: "no frame arrived within the drive's watchdog; find why the host or the bus fell silent",
    Status.OVERLOAD: "too much torque for too long; check for a blocked joint or a heavy load",
}


def status_name(status: int) -> str:
    """Return the name of a status, UNKNOWN_n if the vendor's manual has none."""
    return Status(status).name if status in Status._value2member_map_ else f"UNKNOWN_{status}"


def is_fault(status: int) -> bool:
    """Return whether a status is anything but disabled and enabled."""
    return status > Status.ENABLED


def fault_of(joint: str, status: int) -> Fault:
    """Return a fault status as data for people."""
    hint = _HINTS.get(Status(status), "") if status in Status._value2member_map_ else ""
    return Fault(joint, status, status_name(status), hint or "not in the manual; update robotctl or ask the vendor")
