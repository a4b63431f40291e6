"""Settings of the recorder."""

from dataclasses import dataclass

from sextant.shared.files import config


@dataclass(frozen=True, slots=True)
class Settings:
    """Folder, file duration and content of recordings."""

    folder: str = "recordings"  # parent folder; each recording gets a subfolder, named by date and time
    file_s: float = 60.0  # [s] duration of one file
    reserve_mb: int = 500  # [MB] disk space that stays free
    pictures: bool = False  # also record raw camera images, which are 90 % of the bytes

    checks = (
        *config.each("folder", lambda folder: folder.strip() != "", "a folder"),
        *config.each("file_s", lambda length: 1.0 <= length <= 3600.0, "1 to 3600 s"),
        *config.each("reserve_mb", lambda reserve: reserve >= 0, "0 MB or more"),
    )

    def __post_init__(self) -> None:
        config.verify(self)
