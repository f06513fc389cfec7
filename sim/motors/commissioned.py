"""The dictionary of a CiA 402 drive as an integrator leaves it, with a maker's idea of PDOs."""

from robotctl.hal.can.cia402 import objects as od
from robotctl.hal.can.cia402.codec import HOST_ID, Mode, Service
from robotctl.hal.can.cia402.objects import Entry
from robotctl.hal.profile import Cia402Drive as Wiring
from robotctl.sim.motors.dictionary import Dictionary
from robotctl.sim.motors.pdo import RECORDS

BEAT_NS = 100_000_000
"""Its own heartbeat."""
FAULT_SIGNAL, DISABLE_VOLTAGE, QUICK_STOP = 1, 2, 3
"""Options of 0x6007; 0 is to do nothing."""

_SUPPORTED = 1 << (Mode.POSITION - 1) | 1 << (Mode.VELOCITY - 1) | 1 << (Mode.TORQUE - 1)
_HEADROOM = 1.05
"""Torque that it can give, of what its joint may be asked for."""
_MAKERS_PDOS: tuple[tuple[Service, Entry | None], ...] = (
    (Service.RPDO1, od.CONTROLWORD),
    (Service.RPDO2, None),
    (Service.TPDO1, od.STATUSWORD),
    (Service.TPDO2, None),
)
"""What is mapped when it leaves the factory; event-driven."""


def commissioned(wiring: Wiring, watchdog_s: float, peak: float) -> Dictionary:
    """Return a dictionary.

    Args:
        wiring: node id, resolution and rated torque.
        watchdog_s: time that the drive waits for the host's heartbeat.
        peak: largest torque that is asked of the motor, Nm.
    """
    made = Dictionary(RECORDS)
    values = {
        od.DEVICE_TYPE: 2 << 16 | od.DEVICE_PROFILE,
        od.HEARTBEAT_CONSUMER: HOST_ID << 16 | round(watchdog_s * 1e3),
        od.HEARTBEAT_PRODUCER: BEAT_NS // 1_000_000,
        od.VENDOR: wiring.vendor or 0x5A5A,
        od.PRODUCT: wiring.product or 0x402,
        od.REVISION: 0x0001_0000,
        od.SERIAL: 0x2600_0000 + wiring.id,
        od.ABORT_OPTION: QUICK_STOP,
        od.QUICK_STOP_OPTION: 2,
        od.MAX_TORQUE: min(round(peak * 1000.0 / wiring.rated_torque * _HEADROOM), 0xFFFF),
        od.RATED_TORQUE: round(wiring.rated_torque * 1e3),
        od.MAX_MOTOR_SPEED: 6000,
        od.INCREMENTS: wiring.resolution,
        od.REVOLUTIONS: 1,
        od.VELOCITY_UNIT: od.INCREMENTS_PER_SECOND,
        od.CYCLE: 10,
        od.CYCLE_EXPONENT: -3,
        od.SUPPORTED_MODES: _SUPPORTED,
    }
    for entry, value in values.items():
        made.preset((entry.index, entry.sub), value)
    for (communication, mapping), (service, first) in zip(RECORDS, _MAKERS_PDOS, strict=True):
        made.preset((communication, 1), service + wiring.id | (0 if first else od.INVALID))
        made.preset((communication, 2), 255)
        if first is not None:
            made.preset((mapping, 1), od.mapped(first))
            made.preset((mapping, 0), 1)
    return made
