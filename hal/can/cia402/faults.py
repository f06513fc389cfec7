"""What a CiA 402 drive's error code means to a person. Sources: CiA 301 (8xxx), IEC 61800-7-201 (0x603F)."""

from canopen.emcy import EmcyError

from robotctl.hal.types import Fault

_KNOWN = {
    0x2310: ("CONTINUOUS_OVER_CURRENT", "too much torque for too long; check for a blocked joint or a heavy load"),
    0x2320: ("SHORT_CIRCUIT", "short circuit or earth fault at the motor; check its cable"),
    0x3110: ("MAINS_OVER_VOLTAGE", "supply too high; check it"),
    0x3120: ("MAINS_UNDER_VOLTAGE", "supply too low; check it, its cable and the e-stop"),
    0x3210: ("OVER_VOLTAGE", "braking feeds energy back into the DC link; check supply and brake resistor"),
    0x3220: ("UNDER_VOLTAGE", "DC link too low; check the supply, its cable and the e-stop"),
    0x4210: ("DEVICE_TOO_HOT", "the drive is too hot; let it cool"),
    0x4310: ("DRIVE_TOO_HOT", "the motor or its drive is too hot; let it cool, and lower the load"),
    0x5441: ("SAFE_TORQUE_OFF", "the drive's safe torque off is open; close the safety circuit"),
    0x6320: ("PARAMETER_ERROR", "a stored parameter is out of range; commission the drive again"),
    0x7121: ("MOTOR_BLOCKED", "the joint does not turn; look for what blocks it"),
    0x7300: ("SENSOR_ERROR", "the encoder failed; check its cable, and replace it if that does not help"),
    0x7305: ("ENCODER_ERROR", "the encoder failed; check its cable, and replace it if that does not help"),
    0x8110: ("CAN_OVERRUN", "the drive lost frames; lower the servo rate, and check the bus load"),
    0x8120: ("CAN_PASSIVE", "the drive sees too many bus errors; check cable, termination and bit rate"),
    0x8130: ("HEARTBEAT_LOST", "the host's heartbeat did not come; find why the host or the bus fell silent"),
    0x8140: ("BUS_OFF_RECOVERED", "the drive had left the bus; check cable, termination and bit rate"),
    0x8210: ("PDO_TOO_SHORT", "a PDO was shorter than it is mapped; verify the drive again"),
    0x8611: ("FOLLOWING_ERROR", "the joint did not follow; look for a collision, or commission the drive's loops"),
}

HOST_LOST = 0x8130
"""A consumed heartbeat did not come."""
NOT_OPERATIONAL = 0xF0001
"""Not a drive's code: it left the NMT state in which PDOs are exchanged, most likely by a restart."""
SILENT = 0xF0002
"""Not a drive's code: its heartbeat did not come."""
_OURS = {
    NOT_OPERATIONAL: ("NOT_OPERATIONAL", "the drive has restarted or left the network; check its supply, verify again"),
    SILENT: ("DRIVE_LOST", "the drive's heartbeat does not come any more; check its supply and cable"),
}


def fault_of(joint: str, code: int) -> Fault:
    """Return an error code as data for people: by its own name if that is known, else by its class."""
    name, hint = _KNOWN.get(code) or _OURS.get(code) or ("", "")
    if not name:
        kind = EmcyError(code, 0, b"", 0.0).get_desc() if code else ""
        name = f"ERROR_{code:04X}" if code else "FAULT"
        hint = f"{kind.lower() or 'unknown'} error; look it up in the drive's manual, with its object 0x603F"
    return Fault(joint, code, name, hint)
