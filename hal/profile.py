"""The robot profile: a frozen, strict data model of one robot, in SI units.

Everything that depends on the robot stands here and nowhere else. Unknown keys, missing keys, NaN and infinities
are refused. The files are `configs/robots/*.yaml`; `robotctl.hal.robot` loads them and checks them against the model.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, model_validator

CLASSIC_HZ = 250
"""Highest servo rate of eight drives on classic CAN at 1 Mbit/s: 2.2 ms of wire time per cycle."""

PAYLOAD_GYRATION = 1e-3
"""Inertia of a payload about its own centre per kilogram, m^2; as of a ball of 10 cm."""

Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]
Point = tuple[Finite, Finite, Finite]
Range = tuple[Finite, Finite]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class ModelSource(_Strict):
    """Where the robot's URDF or MJCF comes from."""

    package: str = ""
    """Distribution that ships the file, or empty for a path of your own."""
    file: str
    """Path, or the end of the path inside the distribution."""
    root: str | list[str] | None = None
    """MJCF only: the body under `worldbody` that carries the arm, or those that carry several, in the file's order."""


class Drive(_Strict):
    """Which motor moves a joint, and how its angle maps to the joint's.

    motor angle = sign * gear * (joint angle - offset)
    """

    id: Annotated[int, Field(strict=True, ge=1, le=0x7F)]
    """The id that the drive listens to: ESC_ID (DAMIAO), or its CANopen node id."""
    sign: Literal[-1, 1] = 1
    gear: Positive = 1.0
    """Motor turns per joint turn, beyond the gear that the drive itself accounts for."""
    offset: Finite = 0.0
    """Joint angle at the motor's zero, rad."""
    bus: Annotated[int, Field(strict=True, ge=0, le=7)] = 0
    """Which of the robot's buses it is on: its place in `--channel`."""


class DamiaoDrive(Drive):
    """A DAMIAO drive in MIT mode."""

    protocol: Literal["damiao"] = "damiao"
    reply_id: Annotated[int, Field(strict=True, ge=1, le=0x7FF)]
    """MST_ID, the id it answers with."""
    motor: str
    """Model, e.g. DM8009; its full-scale ranges are verified against the drive."""


class Cia402Drive(Drive):
    """A drive of the CiA 402 profile over CANopen. Every value is verified against the drive."""

    protocol: Literal["cia402"]
    id: Annotated[int, Field(strict=True, ge=1, le=0x7E)]
    """CANopen node id. 127 is the host's own."""
    resolution: Annotated[int, Field(strict=True, ge=1)]
    """Position increments per motor turn (object 0x608F)."""
    rated_torque: Positive
    """Of the motor, Nm (object 0x6076). Torques on the wire are thousandths of it."""
    vendor: Annotated[int, Field(strict=True, ge=0, le=0xFFFFFFFF)] | None = None
    """Vendor id (object 0x1018:1); None for whoever made it."""
    product: Annotated[int, Field(strict=True, ge=0, le=0xFFFFFFFF)] | None = None
    """Product code (object 0x1018:2); None for any."""


def _protocol(drive: Any) -> str:
    """Return which kind of drive is meant: DAMIAO where nothing is said."""
    if isinstance(drive, Drive):
        return "cia402" if isinstance(drive, Cia402Drive) else "damiao"
    return str(drive.get("protocol", "damiao")) if isinstance(drive, Mapping) else "damiao"


AnyDrive = Annotated[
    Annotated[DamiaoDrive, Tag("damiao")] | Annotated[Cia402Drive, Tag("cia402")], Discriminator(_protocol)
]


class Gains(_Strict):
    """Drive-side tracking gains, and the host's slow correction for what the model does not know."""

    kp: NotNegative
    """Nm/rad"""
    kd: NotNegative
    """Nms/rad"""
    ki: NotNegative = 0.0
    """Nm/(rad s), applied by the host"""


class Joint(_Strict):
    """One joint, with the limits the arm is held to. They may be tighter than the model's, never wider."""

    name: str
    """Name in the model file."""
    position: Range
    """Soft limits, rad."""
    velocity: Positive
    """rad/s"""
    acceleration: Positive
    """rad/s^2"""
    jerk: Positive
    """rad/s^3"""
    torque: Positive
    """Nm"""
    torque_rate: Positive
    """Nm/s"""
    gains: Gains
    drive: AnyDrive | None = None
    """None for an arm without CAN drives."""
    armature: NotNegative = 0.0
    """Inertia of the motor's rotor as the joint feels it, where the model leaves it out, kg m^2."""

    @model_validator(mode="after")
    def _ordered(self) -> "Joint":
        if self.position[0] >= self.position[1]:
            raise ValueError(f"position: lower limit {self.position[0]} is not below the upper {self.position[1]}")
        return self


class Finger(_Strict):
    """One finger joint of the model, and its coordinate at both ends of the stroke."""

    name: str
    closed: Finite
    """rad or m"""
    open: Finite


class GripperProfile(_Strict):
    """A parallel gripper."""

    fingers: list[Finger]
    width: Positive
    """Opening when fully open, m; 0 when closed."""
    force: Positive
    """Largest grip force, N."""
    speed: Positive
    """Opening speed, m/s."""
    gains: Gains
    """Of the first finger's joint; the others follow it."""
    drive: AnyDrive | None = None
    """Gripper motor. Its `offset` is unused."""
    motor_open: Finite = 1.0
    """Motor angle when fully open, rad; 0 when closed."""


class Sphere(_Strict):
    """The ball that the tool point may not leave, in the base frame."""

    centre: Point
    """m"""
    radius: Positive
    """m"""


class KeepOutPlane(_Strict):
    """A table, a wall, a floor: a plane that tool point and moving links stay on one side of, in the base frame."""

    kind: Literal["plane"]
    name: str
    point: Point
    """Any point of the plane, m."""
    normal: Point
    """Points to the side that is free; any length but zero."""
    clearance: NotNegative = 0.0
    """Distance that the tool point keeps from it, m."""

    @model_validator(mode="after")
    def _has_sides(self) -> "KeepOutPlane":
        if not any(self.normal):
            raise ValueError("normal: has no direction")
        return self


class KeepOutBox(_Strict):
    """An obstacle: a box that tool point and moving links stay out of, in the base frame."""

    kind: Literal["box"]
    name: str
    centre: Point
    """m"""
    half: tuple[Positive, Positive, Positive]
    """Half of its sides, m."""
    rpy: Point = (0.0, 0.0, 0.0)
    """Its turn about the fixed axes x, then y, then z, rad."""
    clearance: NotNegative = 0.0
    """Distance that the tool point keeps from it, m."""


KeepOut = Annotated[KeepOutPlane | KeepOutBox, Field(discriminator="kind")]


class Safety(_Strict):
    """Thresholds of the protections. Every default is on."""

    sphere: Literal["qp", "projection"] = "qp"
    """How the sphere bounds a command: as a row of the QP, or by the projection rule of Gu et al. 2017."""
    sphere_gain: Positive = 5.0
    """Largest approach speed per metre of distance left, 1/s. At most 1/(4 (lag + delay)) of the actuators.

    It holds for the sphere and every `keep_out` alike, as do the next two.
    """
    sphere_margin: NotNegative = 0.002
    """Kept free inside the sphere, m; covers the tracking error."""
    sphere_breach: Positive = 0.010
    """Measured distance outside at which the arm is stopped, m."""
    position_margin: NotNegative = 0.002
    """Kept free inside each soft limit, rad; covers the tracking error."""
    position_breach: Positive = 0.0087
    """Measured distance past a soft limit at which the arm is stopped, rad (0.5 degrees)."""
    cap_margin: Annotated[float, Field(ge=0.0, lt=0.5)] = 0.03
    """Fraction of the velocity and acceleration caps that commands leave unused; covers the tracking error."""
    velocity_tolerance: Positive = 0.05
    """Published tolerance: how far true joint speed may exceed its cap, rad/s."""
    tracking_error: Positive = 0.15
    """Distance between reference and measurement at which the arm is stopped, rad."""
    tracking_speed: Positive = 0.1
    """Difference between reference and measured joint speed at which the arm is stopped, rad/s ..."""
    tracking_speed_share: NotNegative = 0.3
    """... plus this share of the joint's velocity cap ..."""
    tracking_time_s: Positive = 0.05
    """... if it lasts for so long."""
    standstill_drift: Positive = 0.05
    """Way that a joint may creep while the arm holds, before its torque is taken away, rad."""
    overspeed: Annotated[float, Field(gt=1.0)] = 1.2
    """Multiple of a velocity cap at which three samples stop the arm."""
    overspeed_cut: Annotated[float, Field(gt=1.0)] = 1.5
    """Multiple of a velocity cap at which its torque is taken away."""
    contact: Annotated[float, Field(gt=0.0, le=1.0)] = 0.6
    """Torque from outside that counts as contact, as a share of what takes a joint off its track or to its cap ..."""
    contact_time_s: Positive = 0.02
    """... if it lasts for so long."""
    bump: Positive = 0.02
    """How far from the measured pose the first command after enabling may be, rad."""
    track_step: Annotated[float, Field(gt=0.0, le=1.0)] = 0.6
    """Share of a joint's torque cap by which the feed-forward may jump while it tracks: when full braking sets in."""
    power: Positive = 500.0
    """Largest mechanical power of all joints together, W."""
    temperature: Positive = 90.0
    """Drive temperature at which the arm is stopped, degrees Celsius; from 10 below, it is warned of."""
    rejected_frames: Annotated[int, Field(ge=1)] = 5
    """Measurements within a second that cannot be believed, at which the arm is stopped."""
    deadman_stuck_s: Positive = 30.0
    """Time after which a deadman's switch has to be released and pressed anew."""
    heartbeat_s: Positive = 0.1
    """Time without a fresh target after which the arm brakes."""
    heartbeat_grace_s: Positive = 0.5
    """Time within which a policy that comes back may go on; later the stop is latched."""
    malformed_window_s: Positive = 1.0
    """Three malformed targets within this time are a fault."""
    feedback_stop_s: Positive = 0.010
    """Age of a joint's feedback above which the reference is braked to rest."""
    feedback_fault_s: Positive = 0.050
    """Age of a joint's feedback above which the arm is stopped for good."""
    drive_timeout_s: Positive = 0.1
    """Longest watchdog timeout a drive may report; without one it is refused."""
    standstill: Positive = 0.05
    """Measured joint speed below which a joint counts as at rest, rad/s."""
    reset_scale: Annotated[float, Field(gt=0.0, le=1.0)] = 0.3
    """Fraction of the velocity caps that reset routines may use."""
    reset_tool_speed: Positive = 0.25
    """Tool speed during reset routines, m/s."""
    overrun_ticks: Annotated[int, Field(ge=2)] = 5
    """Ticks in a row, each late by more than a period, after which the arm is stopped."""
    overrun_s: Positive = 0.020
    """Time beyond a period between two ticks above which the arm is stopped for good."""
    watchman_s: Positive = 0.040
    """Time without a tick of an armed arm's loop after which the watchman takes its drives. Shorter than the drives'
    own watchdogs, or they go off first."""
    proximity_slow: Positive = 0.020
    """Clearance between two links, or a link and a keep-out, below which they approach ever more slowly, m."""
    proximity_stop: Positive = 0.005
    """Measured clearance at which the arm is stopped, m."""
    proximity_margin: NotNegative = 0.003
    """Kept free beyond `proximity_stop`, m; covers the tracking error."""


class Collision(_Strict):
    """What is watched for contact between links, and between links and keep-outs."""

    ignore: list[tuple[str, str]] = []
    """Pairs of links (or of a link and a keep-out) that touch by construction, or that cannot meet.

    Links on one joint, or on neighbouring joints, are no pair to begin with.
    """


class CanBus(_Strict):
    """How the drives are wired. Each says itself which protocol it speaks; they may differ on one bus."""

    fd: bool = True
    """CAN FD with bit-rate switch, else classic CAN."""
    bitrate: int = 1_000_000
    data_bitrate: int = 5_000_000


class Twin(_Strict):
    """Imperfections of the simulated arm."""

    lag_s: NotNegative = 0.0
    """Time constant with which the drives follow a command."""
    delay_s: NotNegative = 0.0
    """Dead time of a command on its way to the drives."""
    noise_position: NotNegative = 0.0
    """Standard deviation of measured positions, rad."""
    noise_velocity: NotNegative = 0.0
    """Standard deviation of measured velocities, rad/s."""
    payload: Finite = 0.0
    """Mass at the tool point that the controller is not told of, kg; negative where it is told of too much."""
    start: list[Finite] | None = None
    """Where the arm stands when it wakes up, rad; None for the rest pose. It may be outside the limits."""


class RobotProfile(_Strict):
    """One robot."""

    name: str
    title: str
    """One line for people."""
    model: ModelSource
    tool_frame: str
    """Frame (link, body or site) that carries the tool."""
    tool_offset: Point = (0.0, 0.0, 0.0)
    """The tool point in that frame, m."""
    servo_hz: Annotated[int, Field(ge=50, le=1000)] = 500
    brakes: bool
    """Whether the joints lock when the drives are off."""
    category0: Literal["disable", "damp"]
    """What a category 0 stop does: cut the torque, or damp with gravity compensated (arms without brakes)."""
    home: list[Finite]
    """Where episodes start, rad."""
    rest: list[Finite]
    """Where the arm is parked before its drives are switched off, rad."""
    joints: list[Joint]
    gripper: GripperProfile | None = None
    sphere: Sphere
    safety: Safety = Safety()
    can: CanBus | None = None
    twin: Twin = Twin()
    keep_out: list[KeepOut] = []
    """Planes and boxes where neither tool point nor moving links may be."""
    collision: Collision | None = Collision()
    """None turns the watch for contact off: for a model without geometry."""
    home_via: list[list[Finite]] = []
    """Poses on the way home, in order, rad."""
    start_spread: NotNegative = 0.2
    """How far from home a random start may be, for each joint, rad."""

    @property
    def poses(self) -> dict[str, list[float]]:
        """Every pose that the arm is led to, by its key."""
        return {
            "home": self.home,
            "rest": self.rest,
            **{f"home_via.{index}": pose for index, pose in enumerate(self.home_via)},
        }

    @property
    def protocol(self) -> str:
        """What the arm's drives speak; "" without drives."""
        drive = self.joints[0].drive
        return drive.protocol if drive is not None else ""

    @property
    def drives(self) -> list[AnyDrive]:
        """Every drive, the gripper's last."""
        wirings = [joint.drive for joint in self.joints] + [self.gripper.drive if self.gripper else None]
        return [wiring for wiring in wirings if wiring is not None]

    @property
    def buses(self) -> int:
        """How many buses the drives are on; 1 without any."""
        return 1 + max((drive.bus for drive in self.drives), default=0)

    payload: NotNegative = 0.0
    """Mass at the tool point that is known, kg; gravity and inertia of the arm's model include it."""

    @model_validator(mode="after")
    def _consistent(self) -> "RobotProfile":
        if self.twin.start is not None and len(self.twin.start) != len(self.joints):
            raise ValueError(f"twin.start: {len(self.twin.start)} values for {len(self.joints)} joints")
        for key, pose in self.poses.items():
            if len(pose) != len(self.joints):
                raise ValueError(f"{key}: {len(pose)} values for {len(self.joints)} joints")
            for value, joint in zip(pose, self.joints, strict=True):
                if not joint.position[0] < value < joint.position[1]:
                    raise ValueError(f"{key}: {joint.name} at {value} rad is outside its limits {joint.position}")
        ids = [(drive.bus, drive.id) for drive in self.drives]
        twice = {motor for bus, motor in ids if ids.count((bus, motor)) > 1}
        if twice:
            raise ValueError(f"drive.id: {sorted(twice)} used by more than one motor of a bus")
        if {bus for bus, _ in ids} != set(range(self.buses if ids else 0)):
            raise ValueError(
                f"drive.bus: buses are counted from 0 without a gap, got {sorted({bus for bus, _ in ids})}"
            )
        near = self.safety.proximity_stop + self.safety.proximity_margin
        if near >= self.safety.proximity_slow:
            raise ValueError(f"safety.proximity_slow: not beyond proximity_stop and proximity_margin ({near} m)")
        names = ["sphere", *(item.name for item in self.keep_out)]
        same = {name for name in names if names.count(name) > 1}
        if same:
            raise ValueError(f"keep_out: more than one region is called {sorted(same)}")
        if self.can and not self.can.fd and self.servo_hz > CLASSIC_HZ:
            raise ValueError(f"servo_hz: classic CAN carries at most {CLASSIC_HZ} Hz, not {self.servo_hz}")
        if self.payload + self.twin.payload < 0.0:
            raise ValueError(
                f"twin.payload: {self.twin.payload} kg takes away more than the payload of {self.payload} kg"
            )
        if self.can and any(joint.drive is None for joint in self.joints):
            raise ValueError("can: set, but not every joint has a drive")
        if any(isinstance(joint.drive, Cia402Drive) for joint in self.joints):
            if self.can and self.can.fd:
                raise ValueError("can.fd: CANopen drives speak classic CAN; set it to false")
            if self.category0 == "damp":
                raise ValueError(
                    "category0: CiA 402 drives cannot lower an arm, since their velocity loop holds what it damps; "
                    "use disable, and brakes"
                )
        return self
