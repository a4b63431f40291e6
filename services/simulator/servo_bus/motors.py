"""Motors of the servo models, and the supplies that the simulator gives them."""

from dataclasses import dataclass, replace

from sextant.shared.robot.servo import Battery, Servo


@dataclass(frozen=True, slots=True)
class Motor:
    """Torque and currents of one motor.

    Sources: ROBOTIS e-manual and Feetech data sheets; the standby current of the AX-12A is from the RX-64 page.
    """

    stall_torque: float = 1.5  # [N m] at a duty of 1
    stall_current: float = 1.5  # [A] at a duty of 1
    standby_current: float = 0.05  # [A] also without torque


@dataclass(frozen=True, slots=True)
class Supply:
    """Battery of all servos and the computer: a 3S LiPo pack.

    Its voltage is linear in the charge.
    """

    full_voltage: float = 12.6  # [V] open circuit
    empty_voltage: float = 9.9  # [V] open circuit
    capacity_ah: float = 4.0  # [A h]
    resistance: float = 0.04  # [ohm]
    computer_current: float = 1.0  # [A]


AX_12A_MOTOR = Motor()
# At 14.8 V. The e-manual has 5.3 N m and 2.6 A, and 3.7 N m and 1.9 A, at 18.5 V; scaled with the voltage, as for a DC motor.
RX_64_MOTOR = Motor(stall_torque=4.24, stall_current=2.08, standby_current=0.05)
RX_28_MOTOR = Motor(stall_torque=2.96, stall_current=1.52)
RX_64_SUPPLY = Supply(full_voltage=14.8, empty_voltage=14.8)  # a bench supply: Lotriet 2024, section 3.1
MX_28_MOTOR = Motor(stall_torque=2.5, stall_current=1.4, standby_current=0.1)  # at 12 V
MX_64_MOTOR = Motor(stall_torque=6.0, stall_current=4.1, standby_current=0.1)  # at 12 V
STS3215_MOTOR = Motor(stall_torque=2.94, stall_current=2.7, standby_current=0.006)  # the model for 12 V
SCS0009_MOTOR = Motor(stall_torque=0.226, stall_current=1.0, standby_current=0.01)  # at 6 V; standby assumed
XL_320_MOTOR, XL_320_SUPPLY = Motor(stall_torque=0.39, stall_current=1.1, standby_current=0.02), Supply(8.4, 6.6)  # two cells
XL430_W250_MOTOR = Motor(stall_torque=1.4, stall_current=1.3, standby_current=0.052)  # at 11.1 V
XC430_W150_MOTOR = Motor(stall_torque=1.6, stall_current=1.4, standby_current=0.046)  # at 12 V
XC430_W240_MOTOR = Motor(stall_torque=1.9, stall_current=1.4, standby_current=0.046)  # at 12 V
XM430_W350_MOTOR = Motor(stall_torque=4.1, stall_current=2.3, standby_current=0.04)  # at 12 V
XM540_W270_MOTOR = Motor(stall_torque=10.6, stall_current=4.4, standby_current=0.04)  # at 12 V
# A DS3218 at 6.8 V. A battery behind a step-down converter keeps this voltage.
PWM_MOTOR = Motor(stall_torque=2.11, stall_current=2.3, standby_current=0.005)
PWM_SUPPLY = Supply(full_voltage=6.8, empty_voltage=6.8, resistance=0.01)
LX_16A_MOTOR = Motor(stall_torque=1.67, stall_current=2.4, standby_current=0.1)  # at 7.4 V; 17 kg cm; currents assumed
HX_35H_MOTOR = Motor(stall_torque=3.43, stall_current=3.0, standby_current=0.1)  # at 11.1 V; 35 kg cm; currents assumed
AX_18A_MOTOR = Motor(stall_torque=1.8, stall_current=2.2)
AX_12W_MOTOR = Motor(stall_torque=0.2, stall_current=1.4)
MOTOR_AND_SUPPLY = {
    "AX-12A": (AX_12A_MOTOR, Supply()),
    "AX-18A": (AX_18A_MOTOR, Supply()),
    "AX-12W": (AX_12W_MOTOR, Supply()),
    "RX-28": (RX_28_MOTOR, Supply()),
    "MX-28": (MX_28_MOTOR, Supply()),
    "MX-64": (MX_64_MOTOR, Supply()),
    "XL-320": (XL_320_MOTOR, XL_320_SUPPLY),
    "XL430-W250": (XL430_W250_MOTOR, Supply()),
    "XC430-W150": (XC430_W150_MOTOR, Supply()),
    "XC430-W240": (XC430_W240_MOTOR, Supply()),
    "XM430-W350": (XM430_W350_MOTOR, Supply()),
    "XM540-W270": (XM540_W270_MOTOR, Supply()),
    "STS3215": (STS3215_MOTOR, Supply()),
    "SCS0009": (SCS0009_MOTOR, XL_320_SUPPLY),
    "RX-64": (RX_64_MOTOR, RX_64_SUPPLY),
    "LX-16A": (LX_16A_MOTOR, Supply(full_voltage=8.4, empty_voltage=6.6)),
    "HX-35H": (HX_35H_MOTOR, Supply()),
}


def powered_by(supply: Supply, battery: Battery) -> Supply:
    """Return a supply with the voltages of a robot's battery, unless it is a constant one above the limits of the battery."""
    if supply.full_voltage == supply.empty_voltage >= battery.warn_voltage:
        return supply
    return replace(supply, full_voltage=battery.full_voltage, empty_voltage=battery.empty_voltage)


def motor_and_supply(servo: Servo) -> tuple[Motor, Supply]:
    """Return motor and supply of a servo's model; the motor of a model by its numbers has its torque and current."""
    if servo.pulses is not None:
        return PWM_MOTOR, PWM_SUPPLY
    if servo.numbers is None:
        return MOTOR_AND_SUPPLY[servo.model]
    motor, supply = MOTOR_AND_SUPPLY[servo.numbers.like]
    current = servo.numbers.stall_current or motor.stall_current * servo.stall_torque / motor.stall_torque
    return replace(motor, stall_torque=servo.stall_torque, stall_current=current), supply
