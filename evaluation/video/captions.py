"""Caption below a picture, and insertion of the map into its corner."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from sextant.evaluation.video.timeline import Moment

_BAR, _BAR_SHARE = (22, 26, 32), 0.72
_PLAIN, _MUTED, _TROUBLE = (246, 247, 249), (168, 175, 184), (255, 190, 70)
_GAP = "        "
_MOST_LINES = 3
_SHARE, _SHARE_OF_WIDTH = 0.031, 0.06  # [1] letter height, of the picture's height and width
_SMALLEST = 13  # [px] least letter height, if the picture is wide enough


class Caption:
    """Captions of one text size for all pictures."""

    def __init__(self, size: tuple[int, int], title: str, times: float):
        """Prepare the caption.

        Args:
            size: Width and height of the pictures [px].
            title: Title of the run.
            times: Speed factor of the video.
        """
        self._width, self._height = size
        self._pixels = max(round(_SHARE * self._height), min(_SMALLEST, round(_SHARE_OF_WIDTH * self._width)))
        self._font = ImageFont.load_default(self._pixels)
        self._title = title if times == 1.0 else f"{title}{_GAP}{times:g}x"

    def write(self, picture: NDArray[np.uint8], moment: Moment) -> None:
        """Write the state at a moment into a picture (h, w, 3).

        Problems have a separate colour.
        """
        pad = round(0.7 * self._pixels)
        room = self._width - 2 * pad
        trouble = self._wrapped(moment.trouble, room) if moment.trouble else []
        step = round(1.35 * self._pixels)
        top = self._height - (1 + len(trouble)) * step - pad
        bar = picture[top:].astype(np.float64)
        picture[top:] = np.round(bar + _BAR_SHARE * (np.array(_BAR) - bar)).astype(np.uint8)
        image = Image.fromarray(picture)
        draw = ImageDraw.Draw(image)
        y = top + pad * 0.6
        left = said(moment)
        draw.text((pad, y), left, _PLAIN, self._font)
        if self._font.getlength(left + _GAP + self._title) < room:
            draw.text((self._width - pad, y), self._title, _MUTED, self._font, anchor="ra")
        for k, line in enumerate(trouble, 1):
            draw.text((pad, y + k * step), line, _TROUBLE, self._font)
        picture[top:] = np.asarray(image)[top:]

    def _wrapped(self, text: str, room: float) -> list[str]:
        """Break a text into lines that fit."""
        lines: list[str] = []
        for word in text.split():
            longer = f"{lines[-1]} {word}" if lines else word
            if lines and self._font.getlength(longer) <= room:
                lines[-1] = longer
            else:
                lines.append(word)
        if len(lines) > _MOST_LINES:
            lines = [*lines[: _MOST_LINES - 1], f"{lines[_MOST_LINES - 1]} ..."]
        return lines


def said(moment: Moment) -> str:
    """Return time, speed, and states of robot and planner."""
    doing = ", ".join(word for word in (moment.mode, moment.planner) if word)
    return f"{moment.time_s:5.1f} s{_GAP}{moment.speed:.2f} m/s{_GAP}{doing}"


def lay_in(picture: NDArray[np.uint8], inset: NDArray[np.uint8], margin: int) -> None:
    """Draw a square (n, n, 3) into the upper right corner of a picture.

    It gets rounded corners and a light rim.
    """
    n = len(inset)
    rim = max(round(n / 90), 1)
    outer = n + 2 * rim
    radius = 0.06 * n
    x = picture.shape[1] - margin - outer
    place = picture[margin : margin + outer, x : x + outer]
    shape = _rounded(outer, radius + rim)[..., None]
    whole = np.full((outer, outer, 3), 250.0)
    inner = _rounded(n, radius)[..., None]
    middle = whole[rim : rim + n, rim : rim + n]
    middle += inner * (inset - middle)
    place[:] = np.round(place + shape * (whole - place)).astype(np.uint8)


def _rounded(n: int, radius: float) -> NDArray[np.float64]:
    """Return the coverage of each pixel (n, n) by a square with rounded corners."""
    off = np.maximum(np.abs(np.arange(n) - (n - 1) / 2) - (n / 2 - radius), 0.0)
    return np.asarray(np.clip(radius - np.hypot(off[:, None], off[None, :]) + 0.5, 0.0, 1.0))
