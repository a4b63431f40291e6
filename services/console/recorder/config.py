"""Settings of the recorder."""

from dataclasses import dataclass

from sextant.shared.files import config


@dataclass(frozen=True, slots=True)
class Settings:
    """Where recordings go, and how much room they leave."""

    folder: str = "recordings"  # in which each recording has a folder of its own, by date and time
    file_s: float = 60.0  # [s] of a file
    reserve_mb: int = 500  # [MB] of the disk that stay free
    pictures: bool = False  # the camera's own pictures too: nine tenths of the bytes

    checks = (
        *config.each("folder", lambda folder: folder.strip() != "", "a folder"),
        *config.each("file_s", lambda length: 1.0 <= length <= 3600.0, "1 to 3600 s"),
        *config.each("reserve_mb", lambda reserve: reserve >= 0, "0 MB or more"),
    )

    def __post_init__(self) -> None:
        config.verify(self)
