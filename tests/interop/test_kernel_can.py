"""The tests of `kernel/` need a kernel with vcan: the host's own, or one booted in user-mode Linux."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent / "kernel"
ROOT = Path(__file__).parents[2]
REQUIRED = os.environ.get("ROBOTCTL_REQUIRE_UML") == "1"
BOOT_AND_TESTS_S = 280


def host_has_vcan() -> bool:
    return Path("/sys/class/net/vcan0").exists()


@pytest.mark.timeout(BOOT_AND_TESTS_S + 15)
def test_socketcan_of_a_real_kernel(tmp_path: Path) -> None:
    if host_has_vcan():
        pytest.skip("this host has vcan0: tests/interop/kernel ran natively")
    kernel = shutil.which("linux.uml")
    if (
        kernel is None
        or not Path("/usr/lib/uml/modules").is_dir()
        or shutil.which("insmod", path="/sbin:/usr/sbin") is None
    ):
        assert not REQUIRED, "install user-mode-linux and kmod"
        pytest.skip("needs Debian's user-mode-linux and kmod, which .ci/run installs")
    (tmp_path / "command").write_text(
        f"cd {ROOT}\nexec {sys.executable} -m pytest -q -x -p no:cacheprovider -o timeout={BOOT_AND_TESTS_S} {FOLDER}\n"
    )
    arguments = [
        "mem=1G",
        "rootfstype=hostfs",
        "rootflags=/",
        "rw",
        f"init={FOLDER / 'guest.sh'}",
        f"robotctl.dir={tmp_path}",
    ]
    boot = subprocess.run(
        [kernel, *arguments, "con0=fd:0,fd:1", "con=null"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=BOOT_AND_TESTS_S,
        check=False,
    )
    assert (tmp_path / "status").exists(), boot.stdout.decode(errors="replace")[-3000:]
    output = (tmp_path / "output").read_text()
    assert (tmp_path / "status").read_text().strip() == "0", output
    assert "passed" in output
    assert "skipped" not in output, output
