"""How warm a drive gets: two first-order models heated by the square of the torque."""

from robotctl.hal.can.damiao.codec import Status

AMBIENT = 25.0
"""degrees Celsius"""

ROTOR_RISE = 150.0
"""Final rise of the rotor at the largest torque, K. A third of that torque, about the rated one, gives 17 K."""

ROTOR_TIME = 120.0
"""Time constant, s."""

MOSFET_RISE = 60.0
MOSFET_TIME = 20.0

ROTOR_LIMIT = 100.0
"""Rotor temperature at which a drive switches itself off (DM4340 manual: motor at most 100)."""


class Thermal:
    """Temperatures of one drive, degrees Celsius."""

    __slots__ = ("mosfet", "rotor", "word")

    def __init__(self) -> None:
        self.mosfet = AMBIENT
        self.rotor = AMBIENT
        self.word = 0
        """The last two bytes of a feedback frame."""
        self.step(0.0, 0.0)

    def step(self, load: float, seconds: float) -> None:
        """Heat with `load`, the torque as a fraction of the largest, for `seconds`, which are few."""
        square = load * load
        self.mosfet += (AMBIENT + MOSFET_RISE * square - self.mosfet) * seconds / MOSFET_TIME
        self.rotor += (AMBIENT + ROTOR_RISE * square - self.rotor) * seconds / ROTOR_TIME
        self.word = min(int(self.mosfet), 0xFF) << 8 | min(int(self.rotor), 0xFF)

    def fault(self, mosfet_limit: float) -> Status | None:
        """Return the fault that the present temperatures mean; `mosfet_limit` is register 2, OT_Value."""
        if self.rotor >= ROTOR_LIMIT:
            return Status.ROTOR_OVER_TEMPERATURE
        return Status.MOSFET_OVER_TEMPERATURE if self.mosfet >= mosfet_limit else None
