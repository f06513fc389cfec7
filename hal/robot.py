"""A robot: its profile, checked against its model, with the limits as arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import robotctl
from robotctl.hal.can.cia402.units import misfits
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.description import Description, load_description, locate
from robotctl.hal.document import read_document
from robotctl.hal.errors import ConfigError
from robotctl.hal.limits_text import digest, limits_text
from robotctl.hal.profile import Cia402Drive, DamiaoDrive, Joint, RobotProfile
from robotctl.hal.types import Vector, frozen

CONFIGS = Path(robotctl.__file__).parent / "configs"


@dataclass(frozen=True, slots=True)
class Limits:
    """The soft limits of all joints, each of shape (n,)."""

    lower: Vector
    """rad"""
    upper: Vector
    """rad"""
    velocity: Vector
    """rad/s"""
    acceleration: Vector
    """rad/s^2"""
    jerk: Vector
    """rad/s^3"""
    torque: Vector
    """Nm"""
    torque_rate: Vector
    """Nm/s"""

    @staticmethod
    def of(joints: Sequence[Joint]) -> "Limits":
        return Limits(
            lower=frozen([joint.position[0] for joint in joints]),
            upper=frozen([joint.position[1] for joint in joints]),
            **{
                key: frozen([getattr(joint, key) for joint in joints])
                for key in ("velocity", "acceleration", "jerk", "torque", "torque_rate")
            },
        )


@dataclass(frozen=True, slots=True)
class Robot:
    """A checked profile with the model it stands on."""

    profile: RobotProfile
    description: Description
    limits: Limits
    source: Path
    """The profile's file."""

    @property
    def dof(self) -> int:
        return len(self.profile.joints)

    def on_bus(self, bus: int) -> "Robot":
        """Return the part of this robot whose drives are on one of its buses: those joints, and the gripper if it is.

        It is for drivers: regions, tool and poses are still the whole robot's.
        """
        profile = self.profile
        joints = [joint for joint in profile.joints if joint.drive and joint.drive.bus == bus]
        gripper = profile.gripper
        here = gripper is not None and gripper.drive is not None and gripper.drive.bus == bus
        part = profile.model_copy(update={"joints": joints, "gripper": gripper if here else None})
        return Robot(part, self.description, Limits.of(joints), self.source)

    @property
    def period_ns(self) -> int:
        """Servo period."""
        return round(1e9 / self.profile.servo_hz)

    @property
    def limits_text(self) -> str:
        """Everything that limits the arm, one line per value."""
        return limits_text(self.profile, self.description)

    @property
    def limits_hash(self) -> str:
        """Stands for `limits_text`: equal where that is."""
        return digest(self.limits_text)

    @property
    def stopping_time_s(self) -> float:
        """Longest time from a stop's trigger to rest: jerk-limited braking from the velocity cap, plus the actuator.

        Braking with jerk j at deceleration a from speed v takes v/a + a/j, and a/j more from full acceleration; the
        drives' lag settles within five time constants; two servo periods pass between measurement and command.
        """
        limits, twin = self.limits, self.profile.twin
        braking = float((limits.velocity / limits.acceleration + 2.0 * limits.acceleration / limits.jerk).max())
        return braking + 5.0 * twin.lag_s + twin.delay_s + 2e-9 * self.period_ns


def profile_path(name: str) -> Path:
    """Return the file of a shipped robot's name, or of a path to a YAML file.

    Raises:
        ConfigError: if there is no such robot.
    """
    if name.endswith((".yaml", ".yml")) or "/" in name:
        return Path(name).expanduser()
    path = CONFIGS / "robots" / f"{name}.yaml"
    if not path.is_file():
        raise ConfigError(f"unknown robot {name!r}", f"use one of {', '.join(robot_names())}, or the path of a profile")
    return path


def robot_names() -> list[str]:
    """Return the names of the shipped robots."""
    return sorted(path.stem for path in (CONFIGS / "robots").glob("*.yaml"))


def load_robot(name: str, overrides: Sequence[str] = ()) -> Robot:
    """Load a robot by name or by the path of its profile, and check it against its model.

    Raises:
        ConfigError: if the profile is malformed, or allows what the model or its motors do not.
    """
    path = profile_path(name)
    profile = read_document(path, RobotProfile, overrides)
    description = load_description(locate(profile.model.package, profile.model.file), profile.model.root)
    problems = [f"{path}: {problem}" for joint in profile.joints for problem in _wider_than_model(joint, description)]
    if problems:
        raise ConfigError("\n".join(problems), "tighten the profile; it may never allow more than the model and motor")
    return Robot(profile, description, Limits.of(profile.joints), path)


def _wider_than_model(joint: Joint, description: Description) -> list[str]:
    model = description.limits.get(joint.name)
    if model is None:
        return [f"joint {joint.name!r} is not in the model; it has {', '.join(description.limits)}"]
    problems = []
    lower, upper = joint.position
    if lower < model.lower or upper > model.upper:
        problems.append(
            f"{joint.name}: position {lower}..{upper} is wider than the model's {model.lower}..{model.upper}"
        )
    if model.velocity is not None and joint.velocity > model.velocity:
        problems.append(f"{joint.name}: velocity {joint.velocity} exceeds the model's {model.velocity}")
    if model.effort is not None and joint.torque > model.effort:
        problems.append(f"{joint.name}: torque {joint.torque} exceeds the model's {model.effort}")
    match joint.drive:
        case DamiaoDrive():
            problems += _wider_than_motor(joint, joint.drive)
        case Cia402Drive():
            problems += misfits(joint, joint.drive)
    return problems


def _wider_than_motor(joint: Joint, drive: DamiaoDrive) -> list[str]:
    motor, gear = MOTORS.get(drive.motor), drive.gear
    if motor is None:
        return [f"{joint.name}: unknown motor {drive.motor!r}; known are {', '.join(MOTORS)}"]
    problems = []
    if joint.torque > motor.tmax * gear:
        problems.append(f"{joint.name}: torque {joint.torque} exceeds the {drive.motor}'s {motor.tmax * gear}")
    if joint.velocity > motor.vmax / gear:
        problems.append(f"{joint.name}: velocity {joint.velocity} exceeds the motor's {motor.vmax / gear}")
    reach = max(abs(bound - drive.offset) for bound in joint.position) * gear
    if reach > motor.pmax:
        problems.append(f"{joint.name}: needs {reach:.2f} rad of the motor, whose range is {motor.pmax}")
    return problems
