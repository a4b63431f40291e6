"""Masri 2016, chapter 4: his terrain modelling as published, on pictures of the simulated camera over his first layout."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.baselines import masri_mapping as his
from sextant.evaluation.baselines.masri_mapping import HeightMap, WorldModel, error_between, registered
from sextant.evaluation.figures.layers_picture import UNSEEN
from sextant.evaluation.theses.data import Data, map_window
from sextant.evaluation.theses.stills import camera_picture, draw_stills, true_terrain
from sextant.services.mapper.footholds.foothold_map import closed
from sextant.services.simulator.physics.terrain import Terrain
from sextant.services.simulator.sensors.depth_camera import DepthCamera
from sextant.services.simulator.sensors.renderer import Renderer
from sextant.shared.geometry import Array, apply, exp_so3, transform
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile

LAYOUT, ROBOT = "passage1", "phantomx_mk2"
LOW, RAISED = 0.105, 0.175  # [m] of the body: the walking state, and 7 cm above it (section 4.7)
_AREA = (0.5, 1.9), (-0.5, 0.5)  # [m] x and y of the gap and both its sides
_FORWARD = 0.06  # [m] motion between the two scans of figures 4.1 and 4.5
_WRONG = (np.array([0.018, -0.012, 0.006]), np.array([0.0, 0.01, 0.02]))  # [m] and [rad] errors of the expected motion
_SLICE = (0.11, 0.21)  # [m] y of the shown slice: along the left pillars
_TARGET, _MOVED, _ALIGNED = "#0072b2", "#d55e00", "#009e73"
_TERRAIN, _F, _FOOTHOLD = "#111111", "#d55e00", "#009e73"
_SEEN_STEP = 7  # of the shown points


class Scan(NamedTuple):
    """A scan of the simulated camera."""

    points: Array  # (n, 3) [m] {camera} within the range of the sensor
    T: Array  # (4, 4) true T_world_camera
    depth: NDArray[np.float32]  # (h, w) [m], 0 without a measurement


@cache
def _setup(seed: int) -> tuple[Terrain, RobotProfile, Renderer, DepthCamera]:
    terrain, profile = true_terrain(LAYOUT, seed), load_profile(ROBOT)
    camera = profile.camera
    sensor = DepthCamera(camera.intrinsics, camera.sensor, np.random.default_rng(seed))
    return terrain, profile, Renderer(terrain, camera.intrinsics), sensor


def scan_at(seed: int, x: float, height: float) -> Scan:
    """Return the scan of a robot at x [m] before the gap, its body at a height [m]."""
    _, profile, renderer, sensor = _setup(seed)
    T = transform(np.eye(3), np.array([x, 0.0, height])) @ profile.camera.T_body_camera
    raw = sensor.measure(renderer.inverse_depth(T))
    depth = np.asarray(raw / profile.camera.sensor.depth_scale, dtype=np.float32)
    return Scan(his.scan_of(depth, profile.camera.intrinsics), T, depth)


@cache
def world_model(seed: int) -> WorldModel:
    """Return his model of the layout: scans from raised bodies, each at a motion that is expected wrongly by 5 %."""
    model, expected = WorldModel(), None
    for x in np.arange(0.0, 0.45, 0.05):
        scan = scan_at(seed, float(x), RAISED)
        T = scan.T if expected is None else expected @ _ahead(0.05 * 1.05)
        found = model.add(his.cropped(scan.points), T)
        expected = T if found is None else found
    return model


def _ahead(length: float) -> Array:
    """Return the motion (4, 4) {camera} of a body that goes ahead."""
    _, profile, _, _ = _setup(0)
    R = profile.camera.T_body_camera[:3, :3]
    return transform(np.eye(3), R.T @ np.array([length, 0.0, 0.0]))


@cache
def _map(seed: int, smoothed: bool = True) -> HeightMap:
    (x0, x1), (y0, y1) = _AREA
    shape = round((x1 - x0) / his.FINE_M), round((y1 - y0) / his.FINE_M)
    return world_model(seed).height_map(np.array([x0, y0]), shape, smoothed)


def draw_depth(figure: Any, data: Data) -> list[str]:
    """Draw figure 2.12: the depth picture; the simulated camera has no pattern of dots."""
    scan = scan_at(data.seed, 0.0, RAISED)
    axes = figure.subplots()
    axes.set_facecolor("#111111")
    image = axes.imshow(np.where(scan.depth > 0, scan.depth, np.nan), cmap="viridis_r")
    axes.set_axis_on()
    axes.set_xlabel("pixels")
    axes.set_ylabel("pixels")
    figure.colorbar(image, ax=axes, label="depth [m] (black: no measurement)", shrink=0.85)
    _, profile, _, _ = _setup(data.seed)
    size = profile.camera.intrinsics
    nearest = float(scan.depth[scan.depth > 0].min())
    return [f"{size.width} x {size.height}", f"{profile.camera.sensor.min_range:g} m, here from {nearest:.2f} m"]


def draw_cloud(figure: Any, data: Data) -> list[str]:
    """Draw figure 4.3: what the camera shows, and the raw point cloud."""
    terrain, profile, _, _ = _setup(data.seed)
    scan = scan_at(data.seed, 0.0, RAISED)
    picture = figure.add_subplot(1, 2, 1)
    T_world_body = transform(np.eye(3), np.array([0.0, 0.0, RAISED]))
    draw_stills([picture], [camera_picture(terrain, profile, T_world_body)], ["camera"])
    cloud = figure.add_subplot(1, 2, 2, projection="3d")
    p = _near(apply(scan.T, scan.points))[:: 2 * _SEEN_STEP]
    cloud.scatter(p[:, 0], p[:, 1], p[:, 2], s=0.4, c=p[:, 2], cmap="viridis", vmin=-0.42, vmax=0.05)
    _axes_3d(cloud)
    return [f"{scan.depth.size}, of which {len(scan.points)} measured"]


def draw_reduction(figure: Any, data: Data) -> list[str]:
    """Draw figure 4.4: his box, and the points that our scan has."""
    from sextant.services.perception.config import Settings
    from sextant.services.perception.reduction.scan_reduction import reduce_scan

    scan = scan_at(data.seed, 0.0, RAISED)
    _, profile, _, _ = _setup(data.seed)
    settings = Settings()
    raw = np.asarray(np.rint(scan.depth * profile.camera.sensor.depth_scale), dtype=np.uint16)
    ours = reduce_scan(
        raw, profile.camera.intrinsics, profile.camera.sensor, scan.T,
        resolution=settings.scan_resolution, max_range=settings.scan_range, max_points=settings.scan_points,
        ceiling=settings.scan_ceiling, params=settings.reduction,
    )  # fmt: skip
    kept = his.cropped(scan.points)
    points = 1e-3 * ours.points.astype(np.float64) + ours.origin
    for axes, shown, color, title in (
        (figure.add_subplot(1, 2, 1, projection="3d"), apply(scan.T, kept), "#cc79a7", "his box"),
        (figure.add_subplot(1, 2, 2, projection="3d"), points, _ALIGNED, "here: one point per cell"),
    ):
        all_ = _near(apply(scan.T, scan.points))[:: 3 * _SEEN_STEP]
        axes.scatter(all_[:, 0], all_[:, 1], all_[:, 2], s=0.2, c="#cccccc")
        p = shown[:: max(1, len(shown) // 9000)]
        axes.scatter(p[:, 0], p[:, 1], p[:, 2], s=1.5, c=color)
        axes.set_title(title)
        _axes_3d(axes)
    return [f"box: {len(kept)}, then {len(his.centroids(kept, his.COARSE_M))} voxels; here {len(points)}"]


def draw_translation(figure: Any, data: Data) -> list[str]:
    """Draw figure 4.1: the expected motion alone, and after his registration."""
    first, second, expected = _two_scans(data.seed)
    model = apply(first.T, his.cropped(first.points))
    found, _ = registered(his.centroids(his.cropped(second.points), his.COARSE_M), his.centroids(model, his.COARSE_M), expected)
    for axes, T, color, name in zip(
        figure.subplots(2, 1, sharex=True),
        (expected, found),
        (_MOVED, _ALIGNED),
        ("expected motion", "registered"),
        strict=True,
    ):
        _draw_slice(axes, model, apply(T, second.points), color, name, error_between(T, second.T))
    axes.set_xlabel("ahead [m]")
    return []


def draw_normals(figure: Any, data: Data) -> list[str]:
    """Draw figure 4.5: his registration of points, and with normals."""
    first, second, expected = _two_scans(data.seed)
    model = apply(first.T, his.cropped(first.points))
    coarse = his.centroids(his.cropped(second.points), his.COARSE_M), his.centroids(model, his.COARSE_M)
    values = []
    for axes, normals, color in zip(figure.subplots(2, 1, sharex=True), (False, True), (_MOVED, _ALIGNED), strict=True):
        T, errors = registered(*coarse, expected, normals)
        off = error_between(T, second.T)
        _draw_slice(axes, model, apply(T, second.points), color, "with normals" if normals else "points", off)
        values.append(f"{1e3 * off[0]:.1f} mm, {np.degrees(off[1]):.2f} deg, {len(errors)} iterations")
    axes.set_xlabel("ahead [m]")
    return values


def draw_steps(figure: Any, data: Data) -> list[str]:
    """Draw figure 4.6: the cloud, the elevation map, and the map without inaccessible areas."""
    ground = _map(data.seed)
    p = world_model(data.seed).points
    p = p[(p[:, 0] > _AREA[0][0]) & (p[:, 0] < _AREA[0][1]) & (np.abs(p[:, 1]) < _AREA[1][1])]
    cloud = figure.add_subplot(1, 3, 1, projection="3d")
    cloud.scatter(p[::2, 0], p[::2, 1], p[::2, 2], s=0.4, c=p[::2, 2], cmap="viridis", vmin=-0.42, vmax=0.02)
    _axes_3d(cloud)
    B = his.accessible(ground, LOW)
    for k, layer in enumerate((ground.elevation, np.where(B > 0, ground.elevation, np.nan))):
        axes = figure.add_subplot(1, 3, 2 + k)
        image = _show(axes, 100 * layer, cmap="gray", vmin=-42, vmax=5)
        axes.set_facecolor("#9fc0e0")
        axes.set_title(("elevation map", "accessible")[k])
    figure.colorbar(image, ax=figure.axes[1:], label="height [cm]", shrink=0.7)
    return [f"{len(ground.elevation)} x {len(ground.elevation[0])} cells of {100 * his.FINE_M:g} cm"]


def draw_closing(figure: Any, data: Data) -> list[str]:
    """Draw figure 4.8: the foothold map, dilated, and closed."""
    B = his.accessible(_map(data.seed), LOW)
    from cv2 import dilate

    wide = dilate(B, np.ones((his.CLOSING, his.CLOSING), np.uint8))
    whole = closed(B, his.CLOSING // 2)
    for axes, layer, title in zip(
        figure.subplots(1, 3, sharey=True), (B, wide, whole), ("foothold map B", "dilated", "closed"), strict=True
    ):
        _show(axes, layer, cmap="gray", vmin=0, vmax=1)
        axes.set_title(title)
    return [f"{his.CLOSING} x {his.CLOSING} cells", f"{int(B.sum())} accessible, {int(whole.sum())} closed"]


def draw_evaluation(figure: Any, data: Data) -> list[str]:
    """Draw figure 4.10: the evaluation function, and with its threshold."""
    from matplotlib.colors import TwoSlopeNorm

    B = his.accessible(_map(data.seed), LOW)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, bound, title in zip(panels, (his.REACH, his.BOUND), ("F", f"thresholded at -{his.BOUND}"), strict=True):
        F = his.evaluation(B, bound)
        image = _show(axes, F, cmap="BrBG_r", norm=TwoSlopeNorm(0.0, -his.REACH, his.REACH))
        axes.set_title(title)
    figure.colorbar(image, ax=list(panels), label="F [cells]: a foothold below 0", shrink=0.8)
    return [f"{his.evaluation(B).min()} cells"]


def draw_pillar(figure: Any, data: Data, thresholded: bool) -> list[str]:
    """Draw figures 4.7 and 4.11: the evaluation function across a single pillar."""
    z = np.full((90, 60), -0.4, dtype=np.float32)
    z[30:60, 15:45] = 0.0
    normals = np.tile([0.0, 0.0, 1.0], (*z.shape, 1))
    B = his.accessible(HeightMap(np.zeros(2), z, normals), LOW)
    F = his.evaluation(B, his.BOUND if thresholded else his.REACH)[:, 30].astype(int)
    x = np.arange(len(F))
    axes = figure.subplots()
    axes.step(x, 25 * z[:, 30], where="mid", color=_TERRAIN, lw=2, label="terrain [4 cm]")
    axes.plot(x, F, color=_F, lw=1.6, marker=".", ms=3, label="F [cells]")
    on = np.flatnonzero(F < 0)
    axes.plot(x[on], np.zeros(len(on)), color=_FOOTHOLD, lw=5, solid_capstyle="butt", label="accessible", alpha=0.7)
    for border in (on[0] - 0.5, on[-1] + 0.5):
        axes.axvline(border, color="#777777", lw=0.8, ls="--")
    axes.axhline(0, color="#777777", lw=0.5)
    axes.set_xlabel("x [cm]")
    axes.set_ylabel("F [cells]")
    axes.legend(loc="upper center", ncols=3)
    axes.set_ylim(top=22)
    return [f"{F.min()} cells"] if thresholded else []


def draw_heights(figure: Any, data: Data) -> list[str]:
    """Draw figure 4.12: the points from the walking state and from a raised body."""
    terrain = true_terrain(LAYOUT, data.seed)
    (x0, x1), (y0, y1) = _AREA
    heights = terrain.raster(x0, y0, round((x1 - x0) / 0.01), round((y1 - y0) / 0.01), 0.01)
    values = [f"{100 * (RAISED - LOW):.0f} cm"]
    for k, height in enumerate((LOW, RAISED)):
        scan = scan_at(data.seed, 0.0, height)
        p = apply(scan.T, scan.points)
        axes = figure.add_subplot(1, 2, 1 + k, projection="3d")
        shown = _near(p)[:: 2 * _SEEN_STEP]
        axes.scatter(shown[:, 0], shown[:, 1], shown[:, 2], s=0.4, c=shown[:, 2], cmap="viridis", vmin=-0.42, vmax=0.05)
        axes.set_title(f"body at {100 * height:.1f} cm")
        _axes_3d(axes)
        i, j = np.floor((p[:, 0] - x0) / 0.01).astype(int), np.floor((p[:, 1] - y0) / 0.01).astype(int)
        inside = (i >= 0) & (j >= 0) & (i < heights.shape[0]) & (j < heights.shape[1])
        seen = np.zeros(heights.shape, dtype=bool)
        seen[i[inside], j[inside]] = True
        on_top = heights > -0.05
        values.append(f"{100 * seen[on_top].mean():.0f} % of the tops seen")
    return values


def draw_start(figure: Any, data: Data) -> list[str]:
    """Draw figure 4.14: the ground that is assumed at the start, and the measured one."""
    terrain = data.maps(LAYOUT)[0]
    window = (-0.4, 2.0), (-0.6, 0.6)
    height = map_window(terrain, terrain.elevation, *window)
    assumed = map_window(terrain, terrain.assumed, *window) == 1.0
    x, y = np.meshgrid(np.arange(*window[0], terrain.resolution), np.arange(*window[1], terrain.resolution), indexing="ij")
    x, y = x[: height.shape[0], : height.shape[1]], y[: height.shape[0], : height.shape[1]]
    axes = figure.add_subplot(projection="3d")
    for which, color, label in ((assumed, "#111111", "assumed"), (~assumed & np.isfinite(height), _TARGET, "measured")):
        axes.scatter(x[which][::3], y[which][::3], height[which][::3], s=0.7, c=color, label=label)
    _axes_3d(axes)
    axes.legend(loc="upper right", markerscale=8)
    near = float(x[~assumed & np.isfinite(height)].min())
    return [f"from {near:.2f} m ahead of the body's centre"]


def _near(points: Array) -> Array:
    """Return the points (m, 3) {world} of (n, 3) that are shown."""
    return points[(points[:, 0] < 2.3) & (np.abs(points[:, 1]) < 0.8)]


def _two_scans(seed: int) -> tuple[Scan, Scan, Array]:
    """Return two scans, and where the second is expected."""
    first, second = scan_at(seed, 0.30, RAISED), scan_at(seed, 0.30 + _FORWARD, RAISED)
    wrong = transform(exp_so3(_WRONG[1]), second.T[:3, 3] + _WRONG[0])
    wrong[:3, :3] = wrong[:3, :3] @ second.T[:3, :3]
    return first, second, wrong


def _draw_slice(axes: Any, model: Array, moved: Array, color: str, name: str, off: tuple[float, float]) -> None:
    """Draw a slice of two clouds from the side."""
    for points, shade, label in ((model, _TARGET, "first scan"), (moved, color, f"second scan, {name}")):
        p = points[(points[:, 1] > _SLICE[0]) & (points[:, 1] < _SLICE[1]) & (points[:, 0] < 2.0)]
        p = p[:: max(1, len(p) // 2500)]
        axes.plot(p[:, 0], 100 * p[:, 2], ".", ms=1.6, color=shade, label=label)
    axes.set_title(f"error {1e3 * off[0]:.1f} mm, {np.degrees(off[1]):.2f} deg", loc="right")
    axes.set_ylabel("height [cm]")
    axes.legend(loc="lower right", markerscale=5)
    axes.grid(alpha=0.25)


def _show(axes: Any, layer: Any, **style: Any) -> Any:
    """Show a layer (n, m) of the area from above, ahead upward and left to the left."""
    (x0, x1), (y0, y1) = _AREA
    axes.set_facecolor(UNSEEN)
    image = axes.imshow(layer, origin="lower", extent=(y0, y1, x0, x1), interpolation="nearest", **style)
    axes.set_xlim(y1, y0)
    axes.set_xlabel("left [m]")
    axes.set_ylabel("ahead [m]")
    return image


def _axes_3d(axes: Any) -> None:
    """Set equal scales, a view from behind, and few ticks."""
    axes.view_init(35, -150)
    size = [high - low for low, high in (axes.get_xlim3d(), axes.get_ylim3d(), axes.get_zlim3d())]
    axes.set_box_aspect(size, zoom=1.12)
    axes.locator_params(nbins=4)
    axes.set_zticks([-0.4, 0.0] if axes.get_zlim3d()[0] < -0.3 else [0.0])
    axes.tick_params(labelsize=7, pad=-2)
    axes.set_xlabel("ahead [m]", labelpad=-4, size=8)
    axes.set_ylabel("left [m]", labelpad=-4, size=8)
