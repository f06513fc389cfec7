"""What Linux offers a process that must keep time, and one that must not outlive its parent."""

import ctypes
import gc
import os
import resource
import signal

_PR_SET_PDEATHSIG = 1
_PR_SET_NAME = 15
_MCL_CURRENT = 1
_MCL_FUTURE = 2
CONTROL_PRIORITY = 50
WATCHMAN_PRIORITY = 51
"""Above the one it watches: equals do not displace each other, and a loop that spins would never be caught."""
_libc = ctypes.CDLL(None, use_errno=True)


def name_process(name: str) -> None:
    """Show this process as `name` (at most 15 characters) in ps and top."""
    _libc.prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)


def signal_on_parent_death(number: signal.Signals, parent: int) -> None:
    """Be sent a signal when the parent process dies; at once if it already has."""
    _libc.prctl(_PR_SET_PDEATHSIG, int(number), 0, 0, 0)
    if os.getppid() != parent:
        os.kill(os.getpid(), number)


def go_real_time(priority: int = CONTROL_PRIORITY) -> list[str]:
    """Take what the machine allows of real-time scheduling, and return what was not allowed.

    SCHED_FIFO, all memory locked, garbage collector frozen and off: the loop allocates no cycles.
    """
    missing = []
    gc.collect()
    gc.freeze()
    gc.disable()
    # Locking under a finite limit would make later allocations fail rather than page.
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    if not (unlimited or os.geteuid() == 0) or _libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        missing.append("locked memory")
    # Last, since locking takes tens of milliseconds, in which no other loop should be held up.
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        missing.insert(0, "SCHED_FIFO")
    return missing


def leave_real_time() -> None:
    """Give the priority back before the end: taking a process apart takes the kernel tens of milliseconds, too."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
