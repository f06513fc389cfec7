"""What drives store, as a YAML file for people: kept before something is changed, compared and restored later."""

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from ruamel.yaml import YAML

from robotctl.hal.document import read_document
from robotctl.hal.errors import ConfigError

_HEADER = (
    "What the drives of an arm store. Restored with `robotctl motor restore`, compared with `robotctl motor diff`."
)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class DumpedMotor(_Strict):
    """One drive."""

    id: Annotated[int, Field(strict=True, ge=1, le=0x7F)]
    name: str
    """The joint's, or motor and its id."""
    protocol: str
    serial: int
    parameters: dict[str, Annotated[float, Field(allow_inf_nan=False)]]
    """By the protocol's own names; see its list of registers."""


class Dump(_Strict):
    """A file, and where it comes from."""

    taken: str
    """Local time, ISO 8601."""
    host: str
    version: str
    """Of robotctl."""
    robot: str
    channel: str
    motors: list[DumpedMotor]

    def motor(self, motor_id: int) -> DumpedMotor:
        """Return a drive by its id.

        Raises:
            ConfigError: if the file has none.
        """
        for motor in self.motors:
            if motor.id == motor_id:
                return motor
        known = ", ".join(f"0x{motor.id:02X}" for motor in self.motors)
        raise ConfigError(f"the file has no drive 0x{motor_id:02X}", f"it has {known}")

    def owner(self, serial: int) -> DumpedMotor | None:
        """Return the drive with a serial number, if there is one."""
        return next((motor for motor in self.motors if motor.serial == serial), None)


def read_dump(path: Path) -> Dump:
    """Return a dump.

    Raises:
        ConfigError: with file, line and key of everything that is wrong.
    """
    return read_document(path, Dump)


def write_dump(path: Path, dump: Dump) -> None:
    """Write a dump to a new file.

    Raises:
        ConfigError: if there is such a file already, or it cannot be written.
    """
    yaml = YAML()
    yaml.indent(mapping=2, sequence=4, offset=2)
    content = dump.model_dump()
    for motor in content["motors"]:
        motor["parameters"] = {name: readable(value) for name, value in motor["parameters"].items()}
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(f"# {_HEADER}\n")
            yaml.dump(content, file)
    except FileExistsError:
        raise ConfigError(f"{path} already exists", "dumps are never overwritten; choose another name") from None
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}", "check the folder and the space left") from None


def readable(value: float) -> float | int:
    """Return a number as short as it can be, with everything that 32 bits hold of it."""
    return int(value) if float(value).is_integer() else float(str(np.float32(value)))
