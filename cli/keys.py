"""Single keys from a terminal, without Enter: the emergency stop under a thumb."""

import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_STOP_KEYS = (" ", "\x1b")
"""Space and Escape."""


@contextmanager
def stop_keys(on_stop: Callable[[], None]) -> Iterator[bool]:
    """Call `on_stop` (in a thread) whenever space or Esc is pressed. Yields whether there is a terminal to press on."""
    if not sys.stdin.isatty():
        yield False
        return
    fd = sys.stdin.fileno()
    before = termios.tcgetattr(fd)
    ended = threading.Event()

    def watch() -> None:
        while not ended.is_set():
            key = sys.stdin.read(1)
            if key in _STOP_KEYS and not ended.is_set():
                on_stop()

    tty.setcbreak(fd)
    try:
        threading.Thread(target=watch, daemon=True).start()
        yield True
    finally:
        ended.set()
        termios.tcsetattr(fd, termios.TCSADRAIN, before)
