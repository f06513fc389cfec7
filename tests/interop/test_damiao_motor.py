"""The `damiao-motor` package as the other side: its client drives our emulated drives, as it would drive real ones."""

import time
from collections.abc import Callable, Iterator

import pytest
from damiao_motor import DaMiaoController

from robotctl.hal.can.damiao.registers import ControlMode, Register
from robotctl.hal.robot import load_robot
from robotctl.sim.motors.bench import Bench

from .conftest import served

pytestmark = [pytest.mark.realtime, pytest.mark.filterwarnings("ignore:The 'bustype' argument")]

ELBOW, WRIST = "openarm_right_joint4", "openarm_right_joint7"

_PATIENCE_S = 5.0
_CYCLE_S = 0.01


@pytest.fixture
def bench_and_client() -> Iterator[tuple[Bench, DaMiaoController]]:
    """Our drives in real time, and their client, on one bus."""
    with served(load_robot("openarm")) as (name, bench):
        client = DaMiaoController(channel=name, bustype="virtual")
        yield bench, client
        client.shutdown()


def repeat(action: Callable[[], None], until: Callable[[], bool]) -> bool:
    """Do something 100 times a second, as their users do, until a condition holds; return whether it ever did."""
    deadline = time.monotonic() + _PATIENCE_S
    while not until():
        if time.monotonic() > deadline:
            return False
        action()
        time.sleep(_CYCLE_S)
    return True


def test_their_registers_are_ours(bench_and_client: tuple[Bench, DaMiaoController]) -> None:
    bench, client = bench_and_client
    motor = client.add_motor(4, 0x14, "4340")
    drive = bench.drive(ELBOW)
    assert motor.get_register(Register.ESC_ID) == 4
    assert motor.get_register(Register.MST_ID) == 0x14
    assert [motor.get_register(rid) for rid in (Register.PMAX, Register.VMAX, Register.TMAX)] == [12.5, 10.0, 28.0]
    motor.set_can_timeout(400)
    motor.write_register(Register.CTRL_MODE, ControlMode.POS_VEL)
    assert motor.get_register(Register.TIMEOUT) == 8000
    assert motor.get_register(Register.CTRL_MODE) == ControlMode.POS_VEL
    assert drive.memory[Register.CTRL_MODE] == ControlMode.POS_VEL


def test_their_command_moves_our_joint_and_their_state_is_the_plants(
    bench_and_client: tuple[Bench, DaMiaoController],
) -> None:
    bench, client = bench_and_client
    motor = client.add_motor(7, 0x17, "4310")
    drive = bench.drive(WRIST)
    motor.ensure_control_mode("MIT")
    motor.enable()
    assert repeat(motor.request_motor_feedback, lambda: motor.get_states().get("status") == "ENABLED")
    assert drive.enabled
    start = motor.get_states()["pos"]
    target = start + 0.2

    def push() -> None:
        motor.send_cmd_mit(target_position=target, stiffness=10.0, damping=0.5)

    assert repeat(push, lambda: abs(motor.get_states()["pos"] - target) < 0.05)
    assert bench.plant.truth().position[-1] == pytest.approx(motor.get_states()["pos"], abs=0.02)
    motor.disable()
    assert repeat(motor.request_motor_feedback, lambda: motor.get_states()["status"] == "DISABLED")
    assert not drive.enabled


def test_our_watchdog_and_our_faults_have_their_names(bench_and_client: tuple[Bench, DaMiaoController]) -> None:
    bench, client = bench_and_client
    motor = client.add_motor(7, 0x17, "4310")
    motor.ensure_control_mode("MIT")
    motor.set_can_timeout(50)
    motor.enable()
    assert repeat(motor.request_motor_feedback, lambda: motor.get_states().get("status") == "ENABLED")
    time.sleep(0.2)
    assert repeat(motor.request_motor_feedback, lambda: motor.get_states()["status"] == "LOST_COMM")
    assert not bench.drive(WRIST).enabled
    motor.clear_error()
    assert repeat(motor.request_motor_feedback, lambda: motor.get_states()["status"] == "DISABLED")
