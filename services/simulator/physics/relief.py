"""Height fields of reliefs: waves, ridges, fractal ground and cross-slopes."""

import numpy as np

from sextant.services.simulator.physics.solids import HeightField
from sextant.shared.geometry import Array
from sextant.shared.scenario.relief import Relief


def build_relief(relief: Relief, rng: np.random.Generator) -> HeightField:
    """Return the height field of a relief; `rng` draws phases and roughness."""
    x, y = (low + relief.resolution * np.arange(_points(low, high, relief)) for low, high in (relief.x, relief.y))
    phases = rng.uniform(0.0, 1.0, 2)  # of a period along x and y
    u, v = x[:, None] / relief.wavelength + phases[0], y[None, :] / relief.wavelength + phases[1]
    match relief.shape:
        case "level":
            shape = np.zeros((1, 1))
        case "washboard":
            shape = np.sin(2 * np.pi * u)
        case "sine":
            shape = np.sin(2 * np.pi * u) * np.sin(2 * np.pi * v)
        case "ridges":
            shape = 4.0 * np.abs(u - np.floor(u) - 0.5) - 1.0
        case "fractal":
            shape = fractal((len(x), len(y)), relief.resolution, relief.wavelength, relief.hurst, rng)
    share = np.clip((x - relief.begin) / max(relief.blend, 1e-9), 0.0, 1.0)[:, None]
    tilt = np.tan(np.radians(relief.cross_slope_deg)) * y[None, :]
    heights = relief.base + share * (relief.amplitude * shape + tilt)
    return HeightField(heights, relief.resolution, (relief.x[0], relief.y[0]))


def fractal(shape: tuple[int, int], resolution: float, longest: float, hurst: float, rng: np.random.Generator) -> Array:
    """Return a random surface (nx, ny) of mean 0 and standard deviation 1 with a power-law spectrum.

    Args:
        shape: Number of points along x and y.
        resolution: [m] grid spacing.
        longest: [m] longest wavelength; longer ones are left out.
        hurst: Hurst exponent H; the power falls with the wavenumber to the power -2 (H + 1).
        rng: Draws the surface.

    Source: D. Saupe, in Peitgen and Saupe (editors) 1988, The Science of Fractal Images, section 2.5 (spectral synthesis).
    """
    fx, fy = (np.fft.fftfreq(n, resolution) for n in shape)
    wavenumber = np.hypot(fx[:, None], fy[None, :])
    known = wavenumber >= 1.0 / longest
    size = np.where(known, np.where(known, wavenumber, 1.0) ** -(hurst + 1.0), 0.0)
    surface = np.fft.ifft2(np.fft.fft2(rng.standard_normal(shape)) * size).real
    spread = surface.std()
    return np.asarray(surface / spread if spread > 0 else surface)


def _points(low: float, high: float, relief: Relief) -> int:
    return round((high - low) / relief.resolution) + 1
