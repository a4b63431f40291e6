"""The camera's process: `python -m services.perception.cameras --connect tcp/127.0.0.1:7447 --set device=realsense`."""

from services.perception.cameras.config import Settings
from services.perception.cameras.live import live_camera
from shared import process

process.main("camera", Settings, live_camera)
