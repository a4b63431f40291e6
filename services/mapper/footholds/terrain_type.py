"""Terrain type of the ground: probabilities of firm, water and loose per cell.

They are estimated from colour, shape and touch. Lotriet 2024, section 9.2, asks for a "terrain type" score for pools of water
and loose earth, which an elevation map does not show. The model is naive Bayes over what is known of a cell, with a prior that
ground is firm:

    P(type | cell)  ~  P(type) * p(colour | type) * p(shape | type) * product over touches of p(sink | type)

- **Colour** c = (ln Y, Co / Y, Cg / Y): variations of the light's intensity change only the first component. p(c | type) is a
  mixture. One part consists of Gaussians around colours on which a foot has found that type. The other part covers colours not
  met yet. It is spread widely around the colour of the ground under the robot, and for water is shifted towards the reflected
  sky. No colour is good or bad by itself. A colour that carried a foot is known to carry, and one that gave way makes similar
  colours suspect (kernel inference, as in Shan et al. 2018, *Bayesian generalized kernel inference for terrain traversability
  mapping*). Only a colour not met yet is judged by its difference from the ground where the robot started.
- **Shape**: water is level and smooth, so slope or roughness is evidence against it. Flat ground is only weak evidence for it.
- **Touch**: the depth below the mapped height at which a foot carried load, or that it found no ground. A touch counts for the
  cells under the foot and, through their colours, for all cells that look the same.

Touches accumulate in a cell, and feet that sank accumulate in the prior, because each is independent evidence. Colour and shape
are the same evidence from scan to scan. They are filtered (the colour by a running mean) and count once.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.shared.runtime.compiled import compiled
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE

Array = NDArray[np.float64]
Layer = NDArray[np.float32]
Scalar = TypeVar("Scalar", bound=np.generic)


class GroundType(IntEnum):
    """Ground types, in the order of all arrays over types."""

    FIRM = 0
    WATER = 1
    LOOSE = 2


_TYPES = len(GroundType)
_FIRMLY = np.array([1.0, 0.0, 0.0])
_SETTLED = 16  # colour images that a cell's colour is averaged over
_DARKEST = 4.0  # [1/255] luma below which chroma is meaningless
_SMALLEST = 1e-12
_LUMA_STEP, _LUMA_BINS = 4, 64  # [1/255] bins of colours that share one evaluation
_CHROMA_STEP, _CHROMA_BINS = 0.025, 80  # [1] of Co / Y and Cg / Y, from -1 to 1


@dataclass(frozen=True, slots=True)
class TypeModel:
    """Parameters of the model; those that were not measured are marked as assumed."""

    prior: tuple[float, float, float] = (0.92, 0.04, 0.04)  # assumed: most ground where a robot is sent is firm
    # Feet that sank make water and loose ground more likely everywhere. Feet that carried load do not make them less likely,
    # because the planner chose the ground for them.
    prior_touches: float = 15.0  # number of touches that the prior equals; assumed
    # Colours, as one sigma of (ln Y, Co / Y, Cg / Y). One material varies in brightness, not in hue; others vary in everything.
    same_sigma: tuple[float, float, float] = (0.22, 0.05, 0.04)
    other_sigma: tuple[float, float, float] = (0.60, 0.16, 0.12)  # of other firm or loose material, around the known ground
    # A clear sky has Co / Y of -0.4 to -0.5 (R, G, B about 135, 170, 215). Water seen from a walking robot, 20 to 60 degrees
    # from grazing, reflects up to a third of it, and is otherwise darker than the surrounding ground.
    water_shift: tuple[float, float, float] = (-0.20, -0.22, 0.0)  # of water relative to the known ground
    water_sigma: tuple[float, float, float] = (0.45, 0.10, 0.06)
    new_share: float = 0.3  # [1] share of a type's ground with a colour not met yet; assumed
    # Shape.
    flat_share: float = 0.5  # [1] share of firm and loose ground that is as level and smooth as water; assumed
    water_slope: float = 0.06  # [m/m] one sigma of the mapped slope of level water
    ground_slope: float = 0.30  # [m/m] of ground that is not flat
    water_roughness: float = 0.0015  # [m] mean mapped roughness of water beyond noise
    ground_roughness: float = 0.004  # [m] of ground that is not flat
    # Touch: depth of a foot below the map.
    firm_sink_sigma: float = 0.006  # [m] combined errors of map, pose and joints, measured in walks on firm ground
    firm_outlier: float = 0.05  # [1] share of touches on firm ground with arbitrary errors
    loose_sink: float = 0.015  # [m] mean: sand or earth under the 1 cm foot of a 2.5 kg robot; assumed
    water_sink: float = 0.05  # [m] mean depth of puddles; assumed
    deepest: float = 0.10  # [m] largest depth that a foot reaches
    nothing_found: tuple[float, float, float] = (0.02, 0.30, 0.10)  # P(the foot finds no ground where it should | type)
    sank_ratio: float = 3.0  # [1] likelihood ratio from which a touch is evidence against firm ground: 12 mm deep
    touch_radius: float = 0.015  # [m] radius in which a touch counts: the foot and its position error
    # Effects.
    free_below: float = 0.20  # [1] probability of ground that is not firm, up to which the cost is 0
    refused_from: float = 0.50  # [1] probability from which a cell is no foothold
    clearance: float = 0.03  # [m] clearance of a foot from such ground: its radius and position error
    first_feet: float = 6.0  # number of touches that the first seen ground equals, because six feet stand on it

    def __post_init__(self) -> None:
        if len(self.prior) != _TYPES or min(self.prior) <= 0 or abs(sum(self.prior) - 1.0) > 1e-6:
            raise ValueError(f"three positive priors that sum to 1 expected, found {self.prior}")
        if not 0 < self.free_below < self.refused_from < 1:
            raise ValueError(f"0 < free_below < refused_from < 1 expected, found {self.free_below} and {self.refused_from}")
        if not (0 < self.new_share < 1 and 0 < self.flat_share < 1):
            raise ValueError(f"shares between 0 and 1 expected, found {self.new_share} and {self.flat_share}")


@dataclass(frozen=True, slots=True)
class TypeMap:
    """Ground type of each cell, in world order."""

    probability: Layer  # (nx, ny, 3) of firm, water, loose; they sum to one
    cost: Layer  # (nx, ny) added to the score: 0 for firm ground, above `MAX_FOOTHOLD_SCORE` for no foothold
    hazard: NDArray[np.uint8]  # (nx, ny) type for which the cell is no foothold, 0 for none
    confidence: NDArray[np.uint8]  # (nx, ny) [%] of the most probable type, 0 if the cell has neither colour nor touch


class Palette:
    """Colours on which feet have found a type, a few per type, weighted by touches."""

    SIZE = 6

    def __init__(self) -> None:
        self.mean = np.zeros((_TYPES, self.SIZE, 3))
        self.weight = np.zeros((_TYPES, self.SIZE))

    def add(self, kind: int, color: Array, weight: float, sigma: Array) -> None:
        """Add a colour (3,) to a type.

        It is merged into the nearest known colour within two sigma, or replaces the one with the lowest weight.
        """
        far = np.linalg.norm((self.mean[kind] - color) / sigma, axis=1)
        far[self.weight[kind] == 0.0] = np.inf
        k = int(np.argmin(far))
        if far[k] > 2.0:
            k = int(np.argmin(self.weight[kind]))
            if self.weight[kind, k] > weight:
                return
            self.mean[kind, k], self.weight[kind, k] = color, 0.0
        self.weight[kind, k] += weight
        self.mean[kind, k] += weight / self.weight[kind, k] * (color - self.mean[kind, k])

    def take_back(self, kind: int, color: Array, weight: float, sigma: Array) -> None:
        """Reduce the weight of known colours of a type within two sigma of a colour (3,)."""
        near = (np.linalg.norm((self.mean[kind] - color) / sigma, axis=1) <= 2.0) & (self.weight[kind] > 0.0)
        if near.any():
            self.weight[kind, near] = np.maximum(self.weight[kind, near] - weight / near.sum(), 0.0)


class TerrainType:
    """Colours and touches of the cells around the robot, and the types that follow."""

    def __init__(self, shape: tuple[int, int], resolution: float, low: NDArray[np.int64], model: TypeModel | None = None):
        """Create a map with every cell unknown.

        Args:
            shape: Cells along x and y.
            resolution: [m] cell edge.
            low: (2,) world index of the lowest cell: the cell whose edges begin at low * resolution.
            model: Parameters of the model.
        """
        self.model = model or TypeModel()
        self.palette = Palette()
        self._resolution = resolution
        self._low = low.copy()
        self._color = np.full((*shape, 3), np.nan, dtype=np.float32)  # mean Y, Co, Cg
        self._pictures = np.full(shape, 0, dtype=np.uint8)  # number of colour images averaged
        self._touch = np.full((*shape, _TYPES), 0.0, dtype=np.float32)  # log likelihood of all touches
        self._reference: Array | None = None  # mean colour of the ground that carried, over all touches
        self._carried = 0.0  # number of touches averaged
        self._falsely = self._sinks_on_firm_ground()
        self._bin_of = np.full(_LUMA_BINS * _CHROMA_BINS**2, -1, dtype=np.int32)
        self._near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, [2 * round(self.model.clearance / resolution) + 1] * 2)

    def move_to(self, low: NDArray[np.int64]) -> None:
        """Move the window and clear the cells that leave it."""
        shift = low - self._low
        if not shift.any():
            return
        self._color = _shifted(self._color, shift, np.nan)
        self._pictures = _shifted(self._pictures, shift, 0)
        self._touch = _shifted(self._touch, shift, 0.0)
        self._low = low.copy()

    def add_colors(self, p_world_xy: Array, color: Layer) -> None:
        """Add colours Y, Co, Cg (n, 3) to the cells at (n, 2) [m] {world}.

        A colour is NaN if there is none. Each cell occurs at most once.
        """
        if len(p_world_xy) != len(color) or not np.isfinite(p_world_xy).all():
            raise ValueError(f"a colour for each of {len(p_world_xy)} finite places expected, found {len(color)}")
        _take_in(
            np.ascontiguousarray(p_world_xy, dtype=np.float64), color, self._resolution, self._low, self._color, self._pictures
        )

    def learn_start_ground(self, cells: NDArray[np.bool_]) -> bool:
        """Learn the median colour of cells (nx, ny) as that of the ground under the robot.

        Returns False while too few cells have a colour.
        """
        known = self._color[cells & (self._pictures > 0)]
        if len(known) < 100:
            return False
        self._teach(np.median(features(known), axis=0), _FIRMLY, self.model.first_feet)
        return True

    def touch(self, p_world_xy: Array, sink: float | None) -> None:
        """Add the touch of a foot.

        Args:
            p_world_xy: (2,) [m] {world} position of the foot.
            sink: [m] depth below the mapped height where it carried load, None if it found no ground.
        """
        said = self.sink_log_likelihood(sink)
        centre = p_world_xy / self._resolution - self._low - 0.5
        reach = math.ceil(2.5 * self.model.touch_radius / self._resolution)
        low = np.maximum(np.floor(centre).astype(int) - reach, 0)
        high = np.minimum(np.floor(centre).astype(int) + reach + 2, self._pictures.shape)
        if (low >= high).any():
            return
        here = slice(low[0], high[0]), slice(low[1], high[1])
        i, j = np.ogrid[here]
        off2 = ((i - centre[0]) ** 2 + (j - centre[1]) ** 2) * self._resolution**2
        near = np.exp(-off2 / (2.0 * self.model.touch_radius**2))
        self._touch[here] += (near[..., None] * said).astype(np.float32)
        under = self._color[here][(off2 <= self.model.touch_radius**2) & (self._pictures[here] > 0)]
        if len(under):
            color = features(under).mean(axis=0)
            # A foot that did not clearly sink has found firm ground. If every doubt counted as a share of loose ground, a new
            # colour on which only firm ground was found would still become suspect.
            sank = self._sank(said)
            likely = np.exp(said - said.max()) * self._density(color) * self._prior() if sank else _FIRMLY
            self._teach(color, likely / likely.sum(), 1.0)
            if not sank:
                # On firm ground, a foot occasionally seems to sink. Feet that do not sink undo the effect of these errors.
                for kind in (GroundType.WATER, GroundType.LOOSE):
                    self.palette.take_back(kind, color, self._falsely, np.array(self.model.same_sigma))

    def sink_log_likelihood(self, sink: float | None) -> Array:
        """Return the log likelihood (3,) of firm, water and loose ground for a sink depth.

        The depth is in metres, None if the foot found no ground. Firm ground has Gaussian errors and a few outliers. Loose
        ground and water have an exponential depth, blurred by those errors.
        """
        m = self.model
        if sink is None:
            return np.asarray(np.log(m.nothing_found))
        error = math.exp(-0.5 * (sink / m.firm_sink_sigma) ** 2) / (m.firm_sink_sigma * math.sqrt(2.0 * math.pi))
        firm = (1.0 - m.firm_outlier) * error + m.firm_outlier / m.deepest
        water, loose = (_blurred_exponential(sink, mean, m.firm_sink_sigma) for mean in (m.water_sink, m.loose_sink))
        floor = m.firm_outlier / m.deepest
        return np.asarray(np.log([firm, max(water, floor), max(loose, floor)]))

    def _sank(self, said: Array) -> bool:
        """Return whether log likelihoods (3,) are evidence against firm ground."""
        return bool(said[1:].max() > said[GroundType.FIRM] + math.log(self.model.sank_ratio))

    def _sinks_on_firm_ground(self) -> float:
        """Return the rate of apparent sinking on firm ground, per foot that does not sink."""
        m = self.model
        sinks = np.linspace(0.0, m.deepest, 201)[1:]
        told = np.array([self._sank(self.sink_log_likelihood(float(sink))) for sink in sinks])
        error = np.exp(-0.5 * (sinks / m.firm_sink_sigma) ** 2) / (m.firm_sink_sigma * math.sqrt(2.0 * math.pi))
        density = (1.0 - m.firm_outlier) * error + m.firm_outlier / m.deepest
        falsely = float((density * told).sum() * (sinks[1] - sinks[0])) * (1.0 - m.nothing_found[GroundType.FIRM])
        falsely += m.nothing_found[GroundType.FIRM] * self._sank(self.sink_log_likelihood(None))
        return falsely / (1.0 - falsely)

    def classify(self, slope: Layer, roughness: Layer) -> TypeMap:
        """Classify every cell.

        Args:
            slope: (nx, ny) [m/m] of the map, NaN where unknown.
            roughness: (nx, ny) [m] of the map beyond its noise, NaN where unknown.
        """
        m = self.model
        share, base_mean, base_sigma = self._known_colors()
        p, doubt = np.empty_like(self._touch), np.empty(self._pictures.shape, dtype=np.float32)
        confidence = np.empty_like(self._pictures)
        evidence = _Evidence(self._color, self._pictures, self._touch, slope, roughness)
        colors = _ColorModel(
            self.palette.mean, share, base_mean, base_sigma, np.array(m.same_sigma), m.new_share, self._prior()
        )
        shape = (m.water_slope, m.water_roughness, m.ground_slope, m.ground_roughness, m.flat_share)
        _posterior(evidence, colors, shape, self._bin_of, p, doubt, confidence)
        return self._judged(p, doubt, confidence)

    def rgb(self) -> NDArray[np.uint8]:
        """Return colours R, G, B (nx, ny, 3) of the cells, 0 for none; black ground is 1."""
        out = np.empty(self._color.shape, dtype=np.uint8)
        _to_rgb(self._color, self._pictures, out)
        return out

    def _prior(self) -> Array:
        """Return the frequency (3,) of each type, as assumed and from the feet that sank."""
        count = self.model.prior_touches * np.array(self.model.prior)
        count[GroundType.WATER] += self.palette.weight[GroundType.WATER].sum()
        count[GroundType.LOOSE] += self.palette.weight[GroundType.LOOSE].sum()
        return np.asarray(count / count.sum())

    def _known_colors(self) -> tuple[Array, Array, Array]:
        """Return the shares (types, k) of known colours, and the model of new ones.

        The model is the mean and sigma (types, 3) of colours not met yet.
        """
        m = self.model
        if self._reference is None:  # without a reference, colours are no evidence
            return np.zeros_like(self.palette.weight), np.zeros((_TYPES, 3)), np.full((_TYPES, 3), 1e3)
        share = self.palette.weight / np.maximum(self.palette.weight.sum(axis=1, keepdims=True), _SMALLEST)
        base_mean = np.stack([self._reference, self._reference + m.water_shift, self._reference])
        return share, base_mean, np.array([m.other_sigma, m.water_sigma, m.other_sigma])

    def _density(self, color: Array) -> Array:
        """Return the likelihood (3,) of a colour (3,) on each type, up to a common factor.

        `_posterior` computes it for many colours.
        """
        share, base_mean, base_sigma = self._known_colors()
        new = np.exp(-0.5 * (((color - base_mean) / base_sigma) ** 2).sum(axis=1)) / base_sigma.prod(axis=1)
        same = np.array(self.model.same_sigma)
        met = np.exp(-0.5 * (((color - self.palette.mean) / same) ** 2).sum(axis=2)) / same.prod()
        mixed = (1.0 - self.model.new_share) * (share * met).sum(axis=1) + self.model.new_share * new
        return np.asarray(np.maximum(np.where(share.sum(axis=1) > 0.0, mixed, new), _SMALLEST))

    def _teach(self, color: Array, share: Array, weight: float) -> None:
        """Add a colour (3,) to the types by their shares (3,) of one or more touches."""
        for kind in GroundType:
            if share[kind] > 0.05:
                self.palette.add(kind, color, weight * float(share[kind]), np.array(self.model.same_sigma))
        weight *= float(share[GroundType.FIRM])
        if weight > 0.0:
            self._carried += weight
            before = color if self._reference is None else self._reference
            self._reference = before + weight / self._carried * (color - before)

    def _judged(self, p: Layer, doubt: Layer, confidence: NDArray[np.uint8]) -> TypeMap:
        """Compute cost and hazard, which a foot's extent spreads beyond its cell."""
        m = self.model
        cost, hazard = np.zeros_like(doubt), np.zeros_like(confidence)
        if doubt.max() > m.free_below:
            doubt = np.asarray(cv2.dilate(doubt, self._near), dtype=np.float32)
            cost = np.maximum((doubt - np.float32(m.free_below)) / np.float32(m.refused_from - m.free_below), np.float32(0.0))
            i, j = np.nonzero(cost > MAX_FOOTHOLD_SCORE)
            if len(i):
                near = cv2.dilate(np.ascontiguousarray(p[..., 1:]), self._near)[i, j]
                hazard[i, j] = np.where(near[:, 0] >= near[:, 1], GroundType.WATER, GroundType.LOOSE)
        return TypeMap(p, cost, hazard, confidence)


def features(color: Layer) -> Array:
    """Return ln Y, Co / Y, Cg / Y (n, 3) of colours Y, Co, Cg (n, 3)."""
    y = np.maximum(color[:, 0].astype(np.float64), _DARKEST)
    return np.column_stack([np.log(y), color[:, 1] / y, color[:, 2] / y])


def _blurred_exponential(x: float, mean: float, sigma: float) -> float:
    """Return the density [1/m] at x of an exponentially modified Gaussian.

    It is the distribution of an exponential variable with a Gaussian error.
    """
    rate = 1.0 / mean
    return (
        0.5
        * rate
        * math.exp(0.5 * rate * (rate * sigma**2 - 2.0 * x))
        * math.erfc((rate * sigma**2 - x) / (math.sqrt(2) * sigma))
    )


def _shifted(layer: NDArray[Scalar], shift: NDArray[np.int64], fill: float) -> NDArray[Scalar]:
    """Return a layer whose cell (i, j) is the old (i, j) + shift, or `fill`."""
    out = np.full_like(layer, fill)
    to, of = [], []
    for n, by in zip(layer.shape, shift.tolist(), strict=False):
        to.append(slice(max(-by, 0), max(n - max(by, 0), 0)))
        of.append(slice(max(by, 0), max(n - max(-by, 0), 0)))
    out[tuple(to)] = layer[tuple(of)]
    return out


@compiled
def _take_in(
    p_world_xy: Array, color: Layer, resolution: float, low: NDArray[np.int64], mean: Layer, pictures: NDArray[np.uint8]
) -> None:
    """Update the running mean colours of cells; skip points with NaN or outside."""
    nx, ny = pictures.shape
    for n in range(len(color)):
        i = math.floor(p_world_xy[n, 0] / resolution) - low[0]
        j = math.floor(p_world_xy[n, 1] / resolution) - low[1]
        if not (0 <= i < nx and 0 <= j < ny) or np.isnan(color[n, 0]):
            continue
        seen = min(int(pictures[i, j]) + 1, _SETTLED)
        for k in range(3):
            before = mean[i, j, k] if seen > 1 else np.float32(0.0)
            mean[i, j, k] = before + (color[n, k] - before) / np.float32(seen)
        pictures[i, j] = seen


class _Evidence(NamedTuple):
    """Evidence of each cell of the map."""

    color: Layer  # (nx, ny, 3) Y, Co, Cg
    pictures: NDArray[np.uint8]  # (nx, ny) number of colours in the mean
    touch: Layer  # (nx, ny, types) log-likelihoods by touch
    slope: Layer  # (nx, ny) [m/m]
    roughness: Layer  # (nx, ny) [m]


class _ColorModel(NamedTuple):
    """Colours of each type of ground."""

    mean: Array  # (types, k, 3) of known colours
    share: Array  # (types, k) of known colours
    base_mean: Array  # (types, 3) of colours not met yet
    base_sigma: Array  # (types, 3) of colours not met yet
    sigma: Array  # (3,) of a known colour
    new_share: float  # [1] share of colours not met yet
    prior: Array  # (types,) probability


@compiled
def _posterior(
    evidence: _Evidence,
    model: _ColorModel,
    shape: tuple[float, float, float, float, float],
    bin_of: NDArray[np.int32],
    out: Layer,
    doubt: Layer,
    confidence: NDArray[np.uint8],
) -> None:
    """Compute the type probabilities (nx, ny, types) of each cell.

    doubt is the probability of not being firm, confidence [%] the highest probability of a known cell. Colours are evaluated
    once per bin; bin_of is -1 everywhere, before and after.
    """
    color, pictures, touch, slope, roughness = evidence
    mean, share, base_mean, base_sigma, sigma, new_share, prior = model
    types, colors = share.shape
    narrow = 1.0 / (sigma[0] * sigma[1] * sigma[2])
    slope_water, rough_water, slope_ground, rough_ground, flat_share = shape
    volume = (1.0 - flat_share) * slope_water * rough_water / (slope_ground * rough_ground)
    by_slope = 0.5 / slope_water**2 - 0.5 / slope_ground**2
    by_roughness = 1.0 / rough_water - 1.0 / rough_ground
    most = min(len(bin_of), pictures.size)
    density = np.empty((most, types), dtype=np.float32)
    used = np.empty(most, dtype=np.int32)
    n = 0
    for i in range(color.shape[0]):
        for j in range(color.shape[1]):
            firm, water, loose = prior[0], prior[1], prior[2]
            touched = abs(touch[i, j, 0]) + abs(touch[i, j, 1]) > 1e-6
            if pictures[i, j] == 0 and not touched:
                out[i, j, 0], out[i, j, 1], out[i, j, 2] = firm, water, loose
                doubt[i, j], confidence[i, j] = water + loose, 0
                continue
            if pictures[i, j] > 0:
                y = max(float(color[i, j, 0]), _DARKEST)
                b, c = color[i, j, 1] / y, color[i, j, 2] / y
                u = min(int(y) // _LUMA_STEP, _LUMA_BINS - 1)
                v = min(max(int((b + 1.0) / _CHROMA_STEP), 0), _CHROMA_BINS - 1)
                w = min(max(int((c + 1.0) / _CHROMA_STEP), 0), _CHROMA_BINS - 1)
                place = (u * _CHROMA_BINS + v) * _CHROMA_BINS + w
                at = bin_of[place]
                if at < 0:
                    at = bin_of[place] = n
                    used[n] = place
                    n += 1
                    a = math.log(max((u + 0.5) * _LUMA_STEP, _DARKEST))
                    b, c = (v + 0.5) * _CHROMA_STEP - 1.0, (w + 0.5) * _CHROMA_STEP - 1.0
                    for kind in range(types):
                        s, m = base_sigma[kind], base_mean[kind]
                        d = ((a - m[0]) / s[0]) ** 2 + ((b - m[1]) / s[1]) ** 2 + ((c - m[2]) / s[2]) ** 2
                        new = math.exp(-0.5 * d) / (s[0] * s[1] * s[2])
                        met, total = 0.0, 0.0
                        for k in range(colors):
                            if share[kind, k] > 0.0:
                                total += share[kind, k]
                                m = mean[kind, k]
                                d = ((a - m[0]) / sigma[0]) ** 2 + ((b - m[1]) / sigma[1]) ** 2 + ((c - m[2]) / sigma[2]) ** 2
                                met += share[kind, k] * math.exp(-0.5 * d) * narrow
                        p = new if total == 0.0 else (1.0 - new_share) * met + new_share * new
                        density[at, kind] = max(p, _SMALLEST)
                firm, water, loose = firm * density[at, 0], water * density[at, 1], loose * density[at, 2]
            if slope[i, j] >= 0.0 and roughness[i, j] >= 0.0:  # and not NaN
                steep = min(by_slope * slope[i, j] ** 2 + by_roughness * roughness[i, j], 30.0)
                water /= flat_share + volume * math.exp(steep)
            if touched:  # relative to the largest one: touches add up, and their likelihoods would underflow
                likeliest = max(touch[i, j, 0], touch[i, j, 1], touch[i, j, 2])
                firm, water, loose = (
                    firm * math.exp(touch[i, j, 0] - likeliest),
                    water * math.exp(touch[i, j, 1] - likeliest),
                    loose * math.exp(touch[i, j, 2] - likeliest),
                )
            total = firm + water + loose
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = firm / total, water / total, loose / total
            doubt[i, j] = (water + loose) / total
            confidence[i, j] = int(100.0 * max(firm, water, loose) / total + 0.5)
    for k in range(n):
        bin_of[used[k]] = -1


@compiled
def _to_rgb(color: Layer, pictures: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
    """Convert Y, Co, Cg (nx, ny, 3) to R, G, B, at least 1, or 0 where there is none."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            if pictures[i, j] == 0:
                out[i, j, 0] = out[i, j, 1] = out[i, j, 2] = 0
                continue
            rest = color[i, j, 0] - 0.5 * color[i, j, 2]
            half = 0.5 * color[i, j, 1]
            out[i, j, 0] = int(min(max(rest + half, 1.0), 255.0) + 0.499)
            out[i, j, 1] = int(min(max(rest + color[i, j, 2], 1.0), 255.0) + 0.499)
            out[i, j, 2] = int(min(max(rest - half, 1.0), 255.0) + 0.499)
