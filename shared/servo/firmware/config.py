"""Settings of the board. They fit a Teensy 4.1; change them for yours. docs/firmware.md has those of other boards."""

NAME = "Teensy 4.1"  # at most 32 characters
SERVO = "AX-12A"  # model of all servos, a name in models.py; "PWM" for hobby servos
BAUD_RATE = 1_000_000  # [bit/s] of the servos; 115_200 of a Maestro
CYCLE_MS = 20  # [ms] period of states and readings; docs/firmware.md estimates what boards reach

BUS_UART = 2
BUS_TX: object = None  # pin, None for the fixed pins of the UART: 8 and 7
BUS_RX: object = None
DIRECTION: object = "D6"  # pin that switches the transceiver, None without one
DIRECTION_SENDS = 1  # level of this pin while the board sends
ECHO = False  # whether the circuit returns to the board what it sends

# Hobby servos. PULSES are those of the profile: sender, width [ns/rad], width at the centre and its largest change [us], and
# rate [Hz]; then of PCA9685 the oscillator [kHz] and the address of the first chip, and of a Maestro, which is at BUS_UART, its
# device number or 0 for the compact protocol: PULSES = ("Maestro", 424_400, 1500, 1000, 50, 0).
PULSES: tuple = ("PCA9685", 424_400, 1500, 1000, 50, 25_000, 0x40)
I2C_BUS = 0  # of PCA9685
I2C_SCL: object = None  # pin, None for the fixed pins of the bus
I2C_SDA: object = None

HOST_UART: object = None  # None for USB
HOST_BAUD_RATE = 1_000_000  # [bit/s]
HOST_TX: object = None
HOST_RX: object = None

UART_OPTIONS = {"rxbuf": 512, "txbuf": 512}  # [bytes] further options of machine.UART on this board
