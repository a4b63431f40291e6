import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.simulator.physics.terrain import build_terrain
from sextant.services.simulator.physics.world import World
from sextant.services.simulator.sensors.depth_camera import RANDOM_LOSS, DepthCamera
from sextant.services.simulator.sensors.renderer import Renderer
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Pillars

PROFILE = load_profile("phantomx_mk2")
XTION, SENSOR = PROFILE.camera.intrinsics, PROFILE.camera.sensor
BF = XTION.fx * SENSOR.baseline
FINE = DepthSensor(disparity_step=0.0, depth_scale=20_000.0, max_range=3.2)  # so fine that rounding does not show


def camera(seed: int = 0, sensor: DepthSensor = SENSOR, noise: bool = True, dropouts: bool = False) -> DepthCamera:
    return DepthCamera(XTION, sensor, np.random.default_rng(seed), noise, dropouts)


def wall(z: float) -> NDArray[np.float32]:
    """Return the inverse depth of a wall in front of the camera."""
    return np.full((XTION.height, XTION.width), 1.0 / z, dtype=np.float32)


def errors(frames: int, z: float = 2.0) -> NDArray[np.float64]:
    """Return the disparity errors (frames, h, w) [px] of a wall, unquantised."""
    cam = camera(sensor=FINE)
    raw = np.array([cam.measure(wall(z)) for _ in range(frames)])
    assert np.all(raw > 0)
    return BF * FINE.depth_scale / raw - BF / z


def test_disparity_noise_is_gaussian_with_sensor_sigma() -> None:
    e = errors(4) / SENSOR.disparity_sigma
    n = e.size
    assert abs(e.mean()) < 5 / np.sqrt(n)
    assert e.std() == pytest.approx(1.0, abs=5 / np.sqrt(2 * n) + 1e-3)
    assert np.mean(e**3) == pytest.approx(0.0, abs=5 * np.sqrt(15 / n))
    assert np.mean(e**4) == pytest.approx(3.0, abs=0.05)
    for level in (0.5, 1.0, 2.0, 3.0):
        share = {0.5: 0.38292, 1.0: 0.68269, 2.0: 0.95450, 3.0: 0.99730}[level]
        assert np.mean(np.abs(e) < level) == pytest.approx(share, abs=3e-3)


def test_frame_noise_is_unaffected_by_skipped_frames() -> None:
    first, second = camera(dropouts=True), camera(dropouts=True)
    first.measure(wall(1.0))
    second.skip_frame()
    np.testing.assert_array_equal(first.measure(wall(2.0)), second.measure(wall(2.0)))


@pytest.mark.parametrize("loss", [0.0, 0.3, 0.6, 0.95, 1.0])
def test_given_share_of_pixels_is_lost_independently_per_frame(loss: float) -> None:
    cam = DepthCamera(XTION, SENSOR, np.random.default_rng(0), noise=False, dropouts=True, loss=loss)
    middle = (slice(100, 380), slice(100, 540))  # seen from straight ahead
    one, other = ((cam.measure(wall(1.0)) == 0)[middle] for _ in range(2))
    assert one.mean() == pytest.approx(loss, abs=0.01)
    assert np.mean(one & other) == pytest.approx(loss**2, abs=0.01)


def test_noise_is_white_in_space_and_time() -> None:
    e = errors(6) / SENSOR.disparity_sigma
    bound = 5 / np.sqrt(e[0].size)
    for dv, du in ((0, 1), (0, 2), (0, 5), (1, 0), (2, 0), (1, 1), (0, 64), (0, 256)):
        a = e[0][dv:, du:]
        b = e[0][: a.shape[0], : a.shape[1]]
        assert abs(np.mean(a * b)) < bound
    for i in range(6):
        for j in range(i):
            assert abs(np.mean(e[i] * e[j])) < bound
    spectrum = np.abs(np.fft.rfft2(e[0])) ** 2 / e[0].size
    assert spectrum.max() < 20.0  # no line stands out: exponentially distributed with mean 1 over 150 000 bins
    other = camera(seed=1, sensor=FINE)
    assert abs(np.mean(e[0] * (BF * FINE.depth_scale / other.measure(wall(2.0)) - BF / 2.0) / SENSOR.disparity_sigma)) < bound


@pytest.mark.parametrize("z", [0.8, 1.7, 3.0])
def test_depth_is_quantized_in_disparity_with_sensor_error(z: float) -> None:
    cam = camera()
    # Different depths within a step, so that quantisation averages out.
    truth = np.linspace(z, z * 1.05, XTION.width, dtype=np.float64)
    w = np.tile((1.0 / truth).astype(np.float32), (XTION.height, 1))
    raw = cam.measure(w)
    disparity = BF / (raw / SENSOR.depth_scale) / SENSOR.disparity_step
    # A millimetre of rounding moves the disparity by this number of steps.
    slack = BF / z**2 * 0.5e-3 / SENSOR.disparity_step * 1.1
    assert np.abs(disparity - np.rint(disparity)).max() < max(slack, 1e-9)
    error = raw / SENSOR.depth_scale - truth
    sigma = np.hypot(SENSOR.sigma(truth, XTION.fx), 1e-3 / np.sqrt(12.0))
    assert np.std(error / sigma) == pytest.approx(1.0, abs=0.05)
    assert abs(np.mean(error)) < 0.15 * sigma.mean()


def test_noise_free_depth_is_rounded_to_raw_units_only() -> None:
    cam = camera(noise=False)
    z = np.linspace(0.3, 4.0, XTION.width)
    w = np.tile((1.0 / z).astype(np.float32), (XTION.height, 1))
    raw = cam.measure(w)[0]
    inside = (z > SENSOR.min_range + 1e-6) & (z < SENSOR.max_range - 1e-6)
    np.testing.assert_allclose(raw[inside] / SENSOR.depth_scale, z[inside], atol=0.5e-3 + 1e-6)
    np.testing.assert_array_equal(raw[(z < SENSOR.min_range - 1e-6) | (z > SENSOR.max_range + 1e-6)], 0)


@pytest.mark.parametrize("noise", [False, True])
def test_surfaces_out_of_range_give_no_depth(noise: bool) -> None:
    for z in (0.02, 0.45, 3.8, 50.0, np.inf):
        assert not camera(noise=noise).measure(wall(z)).any()


def test_depth_frames_are_determined_by_seed() -> None:
    one, same, other = (camera(seed, dropouts=True) for seed in (3, 3, 4))
    frames = [cam.measure(wall(1.5)).tobytes() for cam in (one, same, other)]
    assert frames[0] == frames[1] != frames[2]
    assert one.measure(wall(1.5)).tobytes() == same.measure(wall(1.5)).tobytes() != frames[0]


def test_frame_noise_is_independent_of_previous_scenes() -> None:
    one, two = camera(5), camera(5)
    one.measure(wall(1.0))
    two.measure(wall(3.0))
    assert one.measure(wall(2.0)).tobytes() == two.measure(wall(2.0)).tobytes()


def test_near_object_casts_projector_shadow_to_its_left() -> None:
    near, far, left, right = 0.8, 2.0, 300, 400
    w = wall(far)
    w[:, left:right] = 1.0 / near
    lost = np.mean(camera(noise=False, dropouts=True).measure(w) == 0, axis=0)
    shadow = BF / near - BF / far  # [px] difference of disparities
    assert np.all(lost[int(left - shadow) + 2 : left - 1] == 1.0)
    clear = np.r_[lost[1 : int(left - shadow) - 1], lost[left + 1 : right - 1], lost[right + 1 : -1]]
    assert clear.mean() == pytest.approx(RANDOM_LOSS, abs=0.005)


def floor(height: float, pitch: float) -> NDArray[np.float32]:
    terrain = build_terrain(load_scenario("flat"), np.random.default_rng(0))
    look = from_xyz_rpy((0, 0, height), (0, pitch, 0))
    T = look @ np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
    return Renderer(terrain, XTION).inverse_depth(T).copy()


def test_pixel_loss_on_ground_grows_at_grazing_angles() -> None:
    w = floor(0.15, 0.25)
    z = 1.0 / np.maximum(w, 1e-9)
    lost = camera(noise=False, dropouts=True).measure(w) == 0
    shares = [lost[(z > a) & (z <= b)].mean() for a, b in ((0.6, 0.9), (1.5, 1.8), (2.2, 2.5), (3.0, 3.3))]
    assert shares[0] == pytest.approx(RANDOM_LOSS, abs=0.01)
    assert shares[0] < shares[1] < shares[2] < shares[3]
    assert shares[3] > 0.5


@pytest.mark.parametrize("course", ["flat", "steps", "pillars"])
def test_pixel_loss_in_range_matches_real_cameras(course: str) -> None:
    pillars = Pillars(tuple((0.2 * i - 0.2, 0.2 * j - 0.6) for i in range(15) for j in range(7)), 0.14, 0.0)
    scenario = Scenario("pillars", (pillars,), Goal(1.0)) if course == "pillars" else load_scenario(course)
    terrain = build_terrain(scenario, np.random.default_rng(0))
    world = World(PROFILE, terrain)
    world.place(np.tile([0.0, 0.6, -1.9], (6, 1)), from_xyz_rpy((0.3, 0, 0.1), (0, 0, 0)))
    T = world.T_world_body @ PROFILE.camera.T_body_camera
    w = Renderer(terrain, XTION).inverse_depth(T, world.robot_solids())
    inside = (w > 1.01 / SENSOR.max_range) & (w < 0.99 / SENSOR.min_range)
    assert inside.mean() > 0.3
    assert 0.05 <= np.mean(camera(dropouts=True).measure(w)[inside] == 0) <= 0.26


def test_image_of_wrong_size_or_type_is_refused() -> None:
    with pytest.raises(ValueError, match=r"float32 inverse depth \(480, 640\) expected, found float32 \(240, 320\)"):
        camera().measure(np.zeros((240, 320), dtype=np.float32))
    with pytest.raises(ValueError, match="found float64"):
        camera().measure(np.zeros((480, 640)))  # type: ignore[arg-type]


def test_small_image_size_is_supported() -> None:
    small = Intrinsics(7, 5, 100.0, 100.0, 3.0, 2.0)
    raw = DepthCamera(small, SENSOR, np.random.default_rng(0)).measure(np.full((5, 7), 1.0, dtype=np.float32))
    assert raw.shape == (5, 7)
    assert np.median(raw) == pytest.approx(1000, abs=20)
