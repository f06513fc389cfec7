"""Several buses on one plant: time passes for all of them together, whoever lets it pass."""

from collections.abc import Sequence

from robotctl.hal.robot import Robot
from robotctl.sim.motors.bench import Bench
from robotctl.sim.plant import PHYSICS_STEP_NS


class SharedPlant:
    """The benches of all buses of a robot, in front of one plant."""

    def __init__(self, robot: Robot, start_ns: int = 0, fd: bool | None = None, seed: int = 0) -> None:
        """Build the plant and all drives; see `Bench`.

        Raises:
            ConfigError: if the robot has no CAN drives.
        """
        first = Bench(robot, start_ns, fd, seed)
        others = [Bench(robot, start_ns, fd, seed, bus, first.plant) for bus in range(1, robot.profile.buses)]
        self.benches: Sequence[Bench] = (first, *others)
        self._now_ns = start_ns

    def advance(self, to_ns: int) -> None:
        """Let time pass; what falls due on any of the buses happens at its own time."""
        while (due := min([bench.due_ns for bench in self.benches])) <= to_ns:
            self._pass(due)
        if to_ns > self._now_ns:
            self._pass(to_ns)
            self._now_ns = to_ns

    def _pass(self, to_ns: int) -> None:
        plant = self.benches[0].plant
        if any(bench.is_servoing for bench in self.benches):
            while plant.time_ns + PHYSICS_STEP_NS <= to_ns:
                for bench in self.benches:
                    bench.step_servos()
                plant.advance(plant.time_ns + PHYSICS_STEP_NS)
        for bench in self.benches:
            bench.advance(to_ns)
