"""IMU process: `python -m sextant.services.perception.imu --robot my_robot.toml --connect tcp/127.0.0.1:7447`."""

from sextant.services.perception.imu.config import Settings
from sextant.services.perception.imu.live import live_imu
from sextant.shared.runtime import process

process.main("imu", Settings, live_imu)
