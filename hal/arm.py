"""The interfaces that every robot fulfils, and that `tests/contract` holds it to.

Life of an arm: `connect` -> `verify` -> `enable` -> (`read`, `write`)* -> `hold` -> `disable` -> `close`.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from types import TracebackType
from typing import Protocol, Self

from robotctl.hal.can.tap import Tap
from robotctl.hal.errors import HardwareError
from robotctl.hal.types import Command, GripperSample, Sample, Sent, Truth


class Inspector(Protocol):
    """Has the last word on what leaves for the drives: any text it returns says why that is kept back."""

    def frames(self, frames: Sequence[tuple[int, bytes]]) -> str:
        """Judge encoded CAN frames (id, data) that are about to leave together; ids as `hal.can.bus_ids` has them."""
        ...

    def command(self, command: Command) -> str:
        """Judge a command of an arm without a wire."""
        ...

    def enabling(self) -> str:
        """Judge that the drives of an arm without a wire are about to come on."""
        ...


class Arm(ABC):
    """A serial arm of n joints. `read` and `write` never block for longer than one servo period.

    Raises:
        HardwareError: from `connect`, `verify`, `enable` and `disable`. `read` and `write` raise it only
            when the bus itself is gone; what a single drive lacks shows in the sample's stamps and faults.
    """

    @abstractmethod
    def inspect_with(self, inspector: Inspector) -> None:
        """Let nothing leave from now on that `inspector` objects to."""

    def record_frames(self, tap: Tap) -> None:  # noqa: B027 - most arms have nothing to show
        """Show every frame of the bus to `tap` from now on. An arm without a bus has none to show."""

    @abstractmethod
    def connect(self) -> None:
        """Open what has to be opened. On return nothing has been sent."""

    @abstractmethod
    def verify(self) -> None:
        """Read back from every drive what it is, and refuse what the profile does not say. Enables nothing."""

    @abstractmethod
    def enable(self) -> None:
        """Enable every drive, holding the measured pose on return. Harmless when already enabled.

        Does not clear faults: a faulty drive makes it raise.
        """

    @abstractmethod
    def read(self) -> Sample:
        """Return the latest sample. Joints that were not heard of keep their old stamp."""

    @abstractmethod
    def write(self, command: Command) -> Sent:
        """Send one command to every joint, and return what was really sent."""

    @abstractmethod
    def hold(self) -> Sent:
        """Ask the drives to hold the measured pose."""

    @abstractmethod
    def disable(self) -> None:
        """Take the torque away from every drive. Resent until confirmed; raises if a drive never confirms."""

    @abstractmethod
    def clear_faults(self) -> None:
        """Clear the drives' faults. Enables nothing."""

    @abstractmethod
    def close(self) -> None:
        """Release everything. Harmless when already closed. Does not move or disable anything by itself."""

    def take_over(self, command: Command) -> None:
        """Instead of `connect`, `verify` and `enable`: take drives that another process had enabled, and is gone.

        They are asked nothing first: `command` goes out at once, and frames may be written from now on. Its position
        is where the joints were last, which tells whole turns apart.

        Raises:
            HardwareError: if the drives cannot be reached, or went with that process.
        """
        raise HardwareError("there is nothing to take over: the arm lives in the process that drives it")

    def truth(self) -> Truth | None:
        """Return the true state of the plant behind this arm, or None where only measurements exist."""
        return None

    def bus_statistics(self) -> dict[str, object] | None:
        """Return counters of the bus (sent, received, missed replies, round trips), or None without a bus."""
        return None

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Gripper(ABC):
    """A gripper of its own: metres and newtons. No call waits for it to move."""

    @abstractmethod
    def command(self, width: float, force: float) -> None:
        """Ask for an opening of `width` metres with at most `force` newtons. Returns at once.

        Raises:
            ValueError: if a value is not finite or outside the profile's range.
        """

    @abstractmethod
    def read(self) -> GripperSample:
        """Return the latest sample."""

    @abstractmethod
    def step(self) -> None:
        """Do what is due on the bus. The loop calls it once in every tick."""
