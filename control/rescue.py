"""What the watchman does once a control process is gone: drives off, or damped and lowered first."""

from robotctl.control.kinematics import Kinematics
from robotctl.control.legacy import Legacy
from robotctl.control.lowering import damp, gravity_share
from robotctl.control.shared import Link
from robotctl.hal.backend import Rig
from robotctl.hal.clock import Clock
from robotctl.hal.errors import RobotctlError
from robotctl.hal.robot import Robot
from robotctl.safety.machine import State

DAMPING_S = 0.5
"""Time with all of gravity compensated, in which the motion dies away, before the arm is lowered."""
_LOST_NS = 250_000_000
"""Age of a joint's feedback above which the arm is not damped any more. Longer than the loop's, which has a watchman
behind it: after this nobody is left to keep the arm from falling."""


class Rescue:
    """Takes the drives of one arm. Made beforehand, so that taking them is quick."""

    def __init__(self, robot: Robot, link: Link, clock: Clock, rig: Rig) -> None:
        self._link = link
        self._clock = clock
        self._arm = rig.arm
        self._gripper = rig.gripper
        self._kinematics = Kinematics(robot)
        self._damps = robot.profile.category0 == "damp"
        self._period_ns = robot.period_ns

    def run(self, cause: str, onset_ns: int) -> None:
        """Do the profile's category 0 action. The loop's process must be gone: two would fight over the drives.

        Args:
            cause: what happened to the loop, in words.
            onset_ns: since when.
        """
        legacy, began = Legacy(self._link, self._clock), self._clock.now_ns()
        try:
            self._arm.take_over(damp(self._kinematics, legacy.position, 1.0))
        except RobotctlError as error:
            legacy.trip(f"{cause}; its drives cannot be reached: {error}", onset_ns)
            legacy.tick(State.FAULT)
            return
        action = "damped, lowered and switched off" if self._damps else "switched off"
        legacy.trip(f"{cause}; its drives are {action}; look at the arm, then start again", onset_ns)
        try:
            if self._damps:
                self._lower(legacy, began)
            self._arm.disable()
            legacy.log("the watchman has switched the drives off, and they have confirmed it")
        except RobotctlError as error:
            legacy.log(f"the watchman could not switch the drives off: {error}")
        self._release(legacy)
        legacy.tick(State.FAULT)

    def _release(self, legacy: Legacy) -> None:
        try:
            self._arm.close()
        except RobotctlError as error:
            legacy.log(f"the bus was not left as it should be: {error}")

    def _lower(self, legacy: Legacy, began_ns: int) -> None:
        """Damp the arm, and lower it, as long as all its drives are on and heard of."""
        clock, arm = self._clock, self._arm
        due = began_ns
        while True:
            sample, now = arm.read(), clock.now_ns()
            share = min(1.0, gravity_share(began_ns + round(DAMPING_S * 1e9), now))
            heard = int(sample.joint_stamp_ns.min())
            off = heard >= began_ns and not sample.enabled
            if share <= 0.0 or off or now - max(heard, began_ns) > _LOST_NS:
                return
            command = damp(self._kinematics, sample.position, share)
            arm.write(command)
            if self._gripper is not None:
                self._gripper.step()
            legacy.tick(State.DISABLED, sample, command)
            due += self._period_ns
            clock.sleep_until(due)
