"""Camera process: `python -m sextant.services.perception.cameras --connect tcp/127.0.0.1:7447 --set device=realsense`."""

from sextant.services.perception.cameras.config import Settings
from sextant.services.perception.cameras.live import live_camera
from sextant.shared.runtime import process

process.main("camera", Settings, live_camera)
