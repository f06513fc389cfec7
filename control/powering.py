"""How the drives get their torque, and how it is taken from them."""

from collections.abc import Callable

from robotctl.control.lowering import gravity_share
from robotctl.control.motion import Motion
from robotctl.control.shared import Power, Watch
from robotctl.hal.arm import Arm
from robotctl.hal.errors import RobotctlError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample
from robotctl.safety.machine import Event, State
from robotctl.safety.supervisor import Supervisor
from robotctl.safety.trip import Category, Protection, Trip


class Powering:
    """Switches the drives of one arm on and off, and lets the watchman know while that takes its time."""

    def __init__(
        self,
        robot: Robot,
        arm: Arm,
        motion: Motion,
        supervisor: Supervisor,
        watch: Watch,
        log: Callable[[str, int], None],
    ) -> None:
        self.closed = False
        self.damping = False
        """Whether the drives are on in DISABLED or FAULT, to damp an arm that has no brakes."""
        self._damps = robot.profile.category0 == "damp"
        self._arm = arm
        self._motion = motion
        self._supervisor = supervisor
        self._watch = watch
        self._log = log
        self._lowering_ns: int | None = None
        self._closing = False

    def on(self, now_ns: int) -> Sample:
        """Enable the drives, which hold the measured pose on return, and return what is measured then.

        Raises:
            HardwareError: if a drive does not come on; the supervisor has tripped.
        """
        # Drives that come on hold with the last feed-forward they were given.
        self._arm.write(self._motion.begin(self._arm.read().position))
        self._watch.power = Power.CHANGING
        try:
            self._arm.enable()
        except RobotctlError as error:
            self._supervisor.trip(Trip(Protection.DRIVE, Category.BRAKE_OFF, str(error), now_ns))
            raise
        self._watch.power = Power.ON
        sample = self._arm.read()
        self._motion.begin(sample.position)
        return sample

    def off(self) -> None:
        """Take the torque away.

        Raises:
            HardwareError: if a drive does not confirm that it is off.
        """
        self._watch.power = min(self._watch.power, Power.CHANGING)
        self._arm.disable()
        self._watch.power = Power.OFF

    def cut(self, sample: Sample, now_ns: int) -> None:
        """Do the profile's category 0 action: drives off, or damped with gravity compensated until lowered."""
        supervisor = self._supervisor
        clean = supervisor.cause is None
        if supervisor.state is State.DISABLED:
            self.damping = self._damps
            if clean:
                self.lower(now_ns)
            elif self.damping:
                supervisor.handle(Event.OFF_FAULT)
        if self.damping and sample.enabled and not supervisor.feedback.lost and not supervisor.runs_away:
            share = 1.0 if self._lowering_ns is None else gravity_share(self._lowering_ns, now_ns)
            if share > 0.0:
                self._arm.write(self._motion.damp(sample.position, share))
                return
        self.damping = False
        self._lowering_ns = None
        try:
            self.off()
        except RobotctlError as error:
            # A drive that does not confirm keeps the arm from READY, but must not end the supervision of the others.
            clean = False
            self._log(str(error), now_ns)
        if supervisor.state is State.DISABLED:
            supervisor.handle(Event.OFF_CLEAN if clean else Event.OFF_FAULT)
        if self._closing:
            self.close(now_ns)

    def lower(self, now_ns: int) -> None:
        """Begin to lower a damped arm, if that has not begun."""
        self._lowering_ns = self._lowering_ns or now_ns

    def close(self, now_ns: int) -> None:
        """Release the arm at once, or after a damped one was lowered.

        Raises:
            Refused: in a state with the drives on.
        """
        if self.damping:
            self._closing = True
            self.lower(now_ns)
        else:
            self._supervisor.handle(Event.CLOSE)
            self.shut_down()

    def shut_down(self) -> None:
        """Take the torque away if it is still there, and release the arm. Harmless when already done."""
        if not self.closed:
            self.closed = True
            try:
                self.off()
            finally:
                self._arm.close()
