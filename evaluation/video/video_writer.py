"""Video and animation files: OpenCV and Pillow, chosen by the file's suffix."""

import errno
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sextant.shared.errors import SextantError
from sextant.shared.files.whole_files import make_folder, write_by_name

_VIDEOS = {".mp4": "mp4v", ".webm": "VP80", ".avi": "MJPG"}  # encoders that OpenCV's wheels include
_ANIMATED = (".webp", ".gif", ".png")
SUFFIXES = (*_VIDEOS, *_ANIMATED)
_WEBP: dict[str, Any] = {"quality": 72, "method": 4}
_COLORS, _VIVID = 256, 80  # of a GIF; and range of R, G, B above which a colour is vivid and must be kept
_PROBE_BYTES = 1 << 16  # of free space that is tested before encoding
_TOLD_BY = 5  # step of the other pixels that choose a GIF's colours


class FileError(SextantError, ValueError):
    """A kind of file that no installed encoder can write."""


def write(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float, size: tuple[int, int]) -> int:
    """Write pictures (h, w, 3) R, G, B to a file as they arrive; return their number.

    An unfinished file is removed.

    Raises:
        WriteError: It cannot be written.
        FileError: No encoder for such a file.
        ValueError: An unknown suffix.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"a name that ends in one of {', '.join(SUFFIXES)} expected, found {path.name!r}")
    make_folder(path.parent)
    counted = _Counted(frames)
    encode = _write_video if suffix in _VIDEOS else _write_animated
    write_by_name(path, lambda unfinished: encode(unfinished, suffix, counted, fps, size))
    return counted.count


class _Counted(Iterator[NDArray[np.uint8]]):
    """Iterator that counts pictures."""

    def __init__(self, frames: Iterable[NDArray[np.uint8]]):
        self._frames = iter(frames)
        self.count = 0

    def __next__(self) -> NDArray[np.uint8]:
        frame = next(self._frames)
        self.count += 1
        return frame


def _write_video(path: Path, suffix: str, frames: _Counted, fps: float, size: tuple[int, int]) -> None:
    path.write_bytes(bytes(_PROBE_BYTES))  # OpenCV reports neither why a file cannot be opened nor that its end is missing
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*_VIDEOS[suffix]), fps, size)
    try:
        if not writer.isOpened():
            raise FileError(f"OpenCV has no encoder for {suffix} here; use .webp or .gif")
        for frame in frames:
            writer.write(np.ascontiguousarray(frame[..., ::-1]))
    finally:
        writer.release()
    if _frames_in(path) < frames.count:
        raise OSError(errno.ENOSPC, "it lacks pictures at the end")


def _frames_in(path: Path) -> int:
    """Return the number of pictures that a video file reports."""
    video = cv2.VideoCapture(str(path))
    try:
        return round(video.get(cv2.CAP_PROP_FRAME_COUNT)) if video.isOpened() else 0
    finally:
        video.release()


def _write_animated(path: Path, suffix: str, frames: _Counted, fps: float, size: tuple[int, int]) -> None:
    images = (Image.fromarray(frame) for frame in frames)
    if suffix == ".gif":
        images = (_few_colors(image) for image in images)
    first = next(images)
    options: dict[str, Any] = _WEBP if suffix == ".webp" else {}
    others = list(images) if suffix == ".png" else images  # Pillow iterates over them twice
    with path.open("wb") as file:
        kind = suffix.removeprefix(".")
        first.save(file, kind, save_all=True, append_images=others, duration=1000.0 / fps, loop=0, **options)


def _few_colors(image: Image.Image) -> Image.Image:
    """Reduce a picture to the colours of a GIF.

    Small vivid parts, such as feet, footholds and text, get a fair share of the colours.
    """
    pixels = np.asarray(image).reshape(-1, 3)
    vivid = pixels[np.ptp(pixels, axis=1) > _VIVID]
    others = pixels[::_TOLD_BY]
    times = max(len(others) // (2 * len(vivid)), 1) if len(vivid) else 0
    telling = np.concatenate([others, *[vivid] * times])
    palette = Image.fromarray(telling[None]).quantize(_COLORS, Image.Quantize.MEDIANCUT)
    return image.quantize(palette=palette, dither=Image.Dither.NONE)
