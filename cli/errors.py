"""Exit statuses, and errors as a person should see them."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum

import typer
from rich.console import Console

from robotctl.hal.errors import ConfigError, RobotctlError


class Exit(IntEnum):
    """Exit statuses of all verbs."""

    DONE = 0
    BAD_INPUT = 2
    STOPPED_BY_SAFETY = 3
    NO_HARDWARE = 4
    INTERRUPTED = 130


def hear_interrupts() -> None:
    """Listen to SIGINT even where a shell that started us in the background had it ignored: an arm has to stop."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def readable_errors() -> Iterator[None]:
    """Turn this package's errors into a message on stderr and an exit status."""
    try:
        yield
    except KeyboardInterrupt:
        raise typer.Exit(Exit.INTERRUPTED) from None
    except RobotctlError as error:
        console = Console(stderr=True, soft_wrap=True, highlight=False)
        console.print(
            f"[bold red]error[/] {error.what}" if "[" not in error.what else f"error {error.what}",
            markup="[" not in error.what,
        )
        if error.remedy:
            console.print(f"  try: {error.remedy}", markup=False)
        raise typer.Exit(Exit.BAD_INPUT if isinstance(error, ConfigError) else Exit.NO_HARDWARE) from None
