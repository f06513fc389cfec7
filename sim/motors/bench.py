"""The drives of a robot on one plant and one bus: frames in, replies out, and everything that happens in between.

Time comes with every call and never goes backwards. Between two calls the physics runs in one go, unless a drive's
own loop has to be stepped, or something falls due: a watchdog, a late reply, a command in its dead time, trouble.
"""

from collections import deque
from collections.abc import Callable, Iterator
from heapq import heappop, heappush
from random import Random

from robotctl.hal import profile as wired
from robotctl.hal.can.damiao.codec import BROADCAST_ID, decode_register
from robotctl.hal.can.damiao.registers import TIMEOUT_UNIT_S, ControlMode
from robotctl.hal.can.error_frames import GARBLED, UNACKNOWLEDGED, ErrorFrame
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot
from robotctl.sim.motors.cia402 import Cia402Drive
from robotctl.sim.motors.damiao import DamiaoDrive
from robotctl.sim.motors.drive import FOREVER, EmulatedDrive, Handler, Reply
from robotctl.sim.motors.memory import Memory, factory_values
from robotctl.sim.motors.shaft import Shaft
from robotctl.sim.motors.trouble import Trouble
from robotctl.sim.plant import PHYSICS_STEP_NS, WATCHDOG_SHARE, Plant

_STEP_S = PHYSICS_STEP_NS * 1e-9
_WARM_NS = 100_000_000
"""Step of the thermal models."""

_ERRORS = 256
"""Error frames kept for a bus that does not take them."""


class Bench:
    """All drives of a robot profile that are on one bus, powered up, in the plant's home pose.

    `replies` fills with what the drives answer, `errors` with what went wrong on the wire; whoever runs the bus takes
    it from there.
    """

    def __init__(
        self,
        robot: Robot,
        start_ns: int = 0,
        fd: bool | None = None,
        seed: int = 0,
        bus: int = 0,
        plant: Plant | None = None,
    ) -> None:
        """Build the plant, unless there is one already, and the drives.

        Args:
            robot: whose drives.
            start_ns: the present time.
            fd: whether the drives are set to CAN FD; None for what the profile says.
            seed: of measurement noise and trouble.
            bus: which of the robot's buses.
            plant: that of its other buses; see `shared_plant`.

        Raises:
            ConfigError: if the robot has no CAN drives.
        """
        profile = robot.profile
        if profile.can is None:
            raise ConfigError(f"robot {profile.name!r} has no CAN drives to emulate", "use panda, openarm or xarm7")
        self.plant = plant or Plant(robot, start_ns)
        self.replies: deque[Reply] = deque()
        self.errors: deque[ErrorFrame] = deque(maxlen=_ERRORS)
        """What the host's controller would tell of the frames that it sent."""
        self.drives: list[EmulatedDrive] = []
        self.now_ns = start_ns
        self.trouble = Troubles(self, seed)
        self._nominal = profile.can.bitrate
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = 0
        self._watch_ns = FOREVER
        self._next_ns = FOREVER
        self._routes: dict[int, list[tuple[EmulatedDrive, Handler]]] = {}
        self._servos: list[EmulatedDrive] = []
        self._damiao: list[DamiaoDrive] = []
        """Those that register frames may name."""
        self.drives += _drives(self, robot, bus, profile.can.fd if fd is None else fd, seed)
        self._damiao += [drive for drive in self.drives if isinstance(drive, DamiaoDrive)]
        self.refresh()
        self.at(start_ns + _WARM_NS, self._warm)

    @property
    def nominal(self) -> int:
        """Nominal bit rate of the host, bit/s."""
        return self._nominal

    @nominal.setter
    def nominal(self, bitrate: int) -> None:
        if bitrate != self._nominal:
            self._nominal = bitrate
            self.refresh()

    @property
    def hears(self) -> bool:
        """Whether any drive has power, and so acknowledges what is sent."""
        return self._error is not UNACKNOWLEDGED

    def drive(self, which: str | int) -> EmulatedDrive:
        """Return a drive by its joint's name or by its present id.

        Raises:
            ConfigError: if there is no such drive.
        """
        for drive in self.drives:
            if which in (drive.name, drive.id):
                return drive
        names = ", ".join(f"{drive.name} ({drive.id})" for drive in self.drives)
        raise ConfigError(f"no motor {which!r}", f"use one of {names}")

    @property
    def due_ns(self) -> int:
        """When something falls due next."""
        return self._next_ns

    @property
    def is_servoing(self) -> bool:
        """Whether a drive's own loop has to be stepped with the physics."""
        return bool(self._servos)

    def step_servos(self) -> None:
        """Run the drives' own loops for one step of the physics."""
        for drive in self._servos:
            drive.step(_STEP_S)

    def advance(self, to_ns: int) -> None:
        """Let time pass until `to_ns`; everything that falls due on the way happens at its own time."""
        while self._next_ns <= to_ns:
            due = max(self._next_ns, self.now_ns)
            self._run(due)
            self.now_ns = due
            self._happen(due)
        if to_ns > self.now_ns:
            self._run(to_ns)
            self.now_ns = to_ns

    def receive(self, arbitration_id: int, data: bytes) -> None:
        """Take a data frame with an 11-bit id that a host has sent. Call `advance` first."""
        if self._error is not None:
            self.errors.append(self._error)
        routes = self._routes.get(arbitration_id)
        if routes is None:
            if arbitration_id == BROADCAST_ID:
                self._on_register(data)
            return
        if self.trouble.active:
            self._receive_troubled(routes, data)
            return
        now = self.now_ns
        for drive, handler in routes:
            reply = handler(data, now)
            if reply is not None:
                self.replies.append(Reply(drive.reply_id, reply, drive.fd, now))

    def at(self, time_ns: int, action: Callable[[], None]) -> None:
        """Do something at a time to come; what falls due at the same time happens in the order of these calls."""
        self._order += 1
        heappush(self._events, (time_ns, self._order, action))
        self._next_ns = min(self._next_ns, time_ns)

    def say(self, drive: EmulatedDrive, arbitration_id: int, data: bytes) -> None:
        """Put a frame of a drive's on the wire now, in CAN FD if that is what it speaks."""
        self._answer(drive, Reply(arbitration_id, data, drive.fd, self.now_ns))

    def refresh(self) -> None:
        """Look again at what drives may change: their ids, bit rates, modes, status and watchdogs."""
        routes: dict[int, list[tuple[EmulatedDrive, Handler]]] = {}
        for drive in self.drives:
            for arbitration_id, handler in drive.routes(self._nominal).items():
                routes.setdefault(arbitration_id, []).append((drive, handler))
        self._routes = routes
        self._error = self._find_error()
        self._servos = [drive for drive in self.drives if drive.is_servoing]
        self._watch_ns = min((drive.deadline_ns for drive in self.drives), default=FOREVER)
        self._next_ns = min(self._watch_ns, self._events[0][0] if self._events else FOREVER)

    # --- time -------------------------------------------------------------------------------------------------------

    def _run(self, to_ns: int) -> None:
        if not self._servos:
            self.plant.advance(to_ns)
            return
        plant = self.plant
        while plant.time_ns + PHYSICS_STEP_NS <= to_ns:
            self.step_servos()
            plant.advance(plant.time_ns + PHYSICS_STEP_NS)

    def _happen(self, now: int) -> None:
        while self._events and self._events[0][0] <= now:
            heappop(self._events)[2]()
        if self._watch_ns <= now:
            for drive in self.drives:
                if drive.deadline_ns <= now:
                    drive.expire()
            # Drives were fed since the last look, so the next deadline is known only now.
            self._watch_ns = min(drive.deadline_ns for drive in self.drives)
        self._next_ns = min(self._watch_ns, self._events[0][0] if self._events else FOREVER)

    def _warm(self) -> None:
        for drive in self.drives:
            drive.warm(_WARM_NS * 1e-9)
        self.at(self.now_ns + _WARM_NS, self._warm)

    # --- frames -----------------------------------------------------------------------------------------------------

    def _find_error(self) -> ErrorFrame | None:
        """Return what happens to every frame of the host: nobody is there, or some hear it at another bit rate."""
        powered = [drive for drive in self.drives if drive.powered]
        if not powered:
            return UNACKNOWLEDGED
        return None if all(drive.routes(self._nominal) for drive in powered) else GARBLED

    def _on_register(self, data: bytes) -> None:
        for drive in self._damiao:
            # The reply to a change of id or bit rate still goes out the old way.
            reply_id, fd = drive.reply_id, drive.fd
            frame = decode_register(data, drive.id)
            if frame is None or not drive.routes(self._nominal):
                continue
            if self.trouble.active and not self.trouble.hears(drive):
                continue
            reply = drive.on_register(frame, self.now_ns)
            if reply is not None:
                self._answer(drive, Reply(reply_id, reply, fd, self.now_ns))

    def _receive_troubled(self, routes: list[tuple[EmulatedDrive, Handler]], data: bytes) -> None:
        for drive, handler in routes:
            if self.trouble.hears(drive):
                reply = handler(data, self.now_ns)
                if reply is not None:
                    self._answer(drive, Reply(drive.reply_id, reply, drive.fd, self.now_ns))

    def _answer(self, drive: EmulatedDrive, reply: Reply) -> None:
        if not self.trouble.active:
            self.replies.append(reply)
            return
        for altered in self.trouble.alter(drive, reply):
            if altered.stamp_ns <= self.now_ns:
                self.replies.append(altered)
            else:
                self.at(altered.stamp_ns, lambda late=altered: self.replies.append(late))  # type: ignore[misc]


class Troubles:
    """The trouble that a bench is in."""

    def __init__(self, bench: Bench, seed: int) -> None:
        self.active: list[Trouble] = []
        self._bench = bench
        self._random = Random(seed)

    def add(self, trouble: Trouble) -> None:
        """Let trouble begin at its time, or now if that has passed."""
        self._bench.at(max(trouble.from_ns, self._bench.now_ns), lambda: self._begin(trouble))
        # So that trouble of the present acts on the very next frame.
        self._bench.advance(self._bench.now_ns)

    def remove(self, trouble: Trouble) -> None:
        """End trouble now. Harmless if it is over, or has not begun."""
        if trouble in self.active:
            self.active.remove(trouble)
            for drive in self._meant(trouble):
                trouble.end(drive)

    def hears(self, drive: EmulatedDrive) -> bool:
        """Return whether a frame reaches a drive."""
        for trouble in self._of(drive):
            if not trouble.hears(self._random):
                if trouble.garbles:
                    self._bench.errors.append(GARBLED)
                return False
        return True

    def alter(self, drive: EmulatedDrive, reply: Reply) -> list[Reply]:
        """Return what becomes of a reply."""
        replies = [reply]
        for trouble in self._of(drive):
            before, replies = len(replies), list(trouble.alter(replies, self._random))
            if trouble.garbles and len(replies) < before:
                self._bench.errors.append(GARBLED)
        return replies

    def _begin(self, trouble: Trouble) -> None:
        self.active.append(trouble)
        for drive in self._meant(trouble):
            trouble.begin(drive)
        if trouble.until_ns < FOREVER:
            self._bench.at(trouble.until_ns, lambda: self.remove(trouble))

    def _of(self, drive: EmulatedDrive) -> list[Trouble]:
        return [trouble for trouble in self.active if trouble.motor_id in (None, drive.id)]

    def _meant(self, trouble: Trouble) -> list[EmulatedDrive]:
        return [drive for drive in self._bench.drives if trouble.motor_id in (None, drive.id)]


def _drives(bench: Bench, robot: Robot, bus: int, fd: bool, seed: int) -> Iterator[EmulatedDrive]:
    """Build the drives that a profile has on a bus, in the order of the plant's axes, as an integrator leaves them."""
    profile, plant = robot.profile, bench.plant
    timeout_s = WATCHDOG_SHARE * profile.safety.drive_timeout_s
    delay_ns = round(profile.twin.delay_s * 1e9)
    noise = (profile.twin.noise_position, profile.twin.noise_velocity)
    for axis, joint in enumerate(profile.joints):
        wiring, gains = joint.drive, joint.gains
        if wiring is None or wiring.bus != bus:
            continue
        scale = wiring.sign * wiring.gear
        shaft = Shaft(plant, axis, scale, wiring.offset, gains.kp, gains.kd)
        own_noise = (noise[0] * wiring.gear, noise[1] * wiring.gear)
        if isinstance(wiring, wired.Cia402Drive):
            yield _cia402(bench, joint, wiring, shaft, timeout_s, delay_ns, own_noise, seed + axis)
        else:
            yield _damiao(
                bench, joint.name, wiring, shaft, ControlMode.MIT, timeout_s, fd, delay_ns, own_noise, seed + axis
            )
    gripper = profile.gripper
    if gripper and isinstance(gripper.drive, wired.DamiaoDrive) and gripper.drive.bus == bus:
        finger = gripper.fingers[0]
        scale = gripper.motor_open / (finger.open - finger.closed)
        shaft = Shaft(plant, plant.dof, scale, finger.closed, gripper.gains.kp, gripper.gains.kd)
        yield _damiao(
            bench,
            "gripper",
            gripper.drive,
            shaft,
            ControlMode.POS_FORCE,
            timeout_s,
            fd,
            0,
            (0.0, 0.0),
            seed + plant.dof,
        )


def _damiao(
    bench: Bench,
    name: str,
    wiring: wired.DamiaoDrive,
    shaft: Shaft,
    mode: ControlMode,
    timeout_s: float,
    fd: bool,
    delay_ns: int,
    noise: tuple[float, float],
    seed: int,
) -> DamiaoDrive:
    timeout = round(timeout_s / TIMEOUT_UNIT_S)
    memory = Memory(factory_values(wiring.motor, wiring.id, wiring.reply_id, mode, timeout, fd))
    return DamiaoDrive(name, wiring.motor, memory, shaft, bench.refresh, bench.at, delay_ns, noise, seed)


def _cia402(
    bench: Bench,
    joint: wired.Joint,
    wiring: wired.Cia402Drive,
    shaft: Shaft,
    timeout_s: float,
    delay_ns: int,
    noise: tuple[float, float],
    seed: int,
) -> Cia402Drive:
    square = wiring.gear**2
    drive: Cia402Drive
    drive = Cia402Drive(
        joint.name,
        wiring,
        shaft,
        (joint.gains.kp / square, joint.gains.kd / square),
        joint.torque / wiring.gear,
        timeout_s,
        bench.refresh,
        lambda arbitration_id, data: bench.say(drive, arbitration_id, data),
        bench.at,
        bench.now_ns,
        delay_ns,
        noise,
        seed,
    )
    return drive
