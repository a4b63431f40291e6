"""How fast the stages are beside their peers: every frame goes through all in turn, so a busy machine slows all alike."""

import json
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deploy.bench.registration_peers import METHODS, Registers
from deploy.bench.ride import CarriedCamera, Errors, ride
from deploy.bench.scenes import REGISTERED
from shared.geometry import Array, inverse

_WARM = 5  # frames that are not timed, where there are more
_STEP = 0.02  # [m] between frames
_DRIFT, _FLOOR, _LEVEL, _TURN = 0.1, 0.001, 0.01, 0.003  # what is believed of odometry, as in perception's settings


@dataclass(frozen=True, slots=True)
class Timing:
    """One method on one scene."""

    stage: str
    scene: str
    method: str
    ms: tuple[float, float, float]  # median and quartiles of a frame
    ratio: float  # median of its time over the default's, frame by frame
    drift: float  # [m] error of the place at the end, median over the seeds


def registration(
    seeds: Sequence[int], frames: int = 100, say: Callable[[str], object] = lambda _: None
) -> tuple[list[Timing], list[str]]:
    """Time all methods of registration on all scenes; also the names of those that are not installed."""
    methods, missing = dict(METHODS), []
    rides = [(scene, seed) for scene in REGISTERED for seed in seeds]
    took: dict[tuple[str, str], list[Array]] = {}
    drifts: dict[tuple[str, str], list[float]] = {}
    for scene, seed in rides:
        rngs = [np.random.default_rng([seed, k]) for k in range(3)]
        way = ride(REGISTERED[scene](rngs[0]), rngs[1], Errors(), frames, _STEP * frames)
        camera = CarriedCamera(way, rngs[2])
        sensor, intrinsics = way.profile.camera.sensor, way.profile.camera.intrinsics
        at_work: dict[str, Registers] = {}
        for name in list(methods):
            try:
                at_work[name] = methods[name](intrinsics, sensor)
            except ImportError as error:
                missing.append(f"{name} ({error.name})")
                del methods[name]
        times = {name: np.empty(frames) for name in at_work}
        T_true = way.T_world_camera
        T_legs = way.T_odom_body @ way.profile.camera.T_body_camera
        T = dict.fromkeys(at_work, T_true[0])
        for k in range(frames):
            depth = camera.frame(k)
            motion = inverse(T_legs[k - 1]) @ T_legs[k] if k else np.eye(4)
            along = _DRIFT * float(np.linalg.norm(motion[:3, 3])) + _FLOOR
            covariance = np.diag(np.square([along, along, _LEVEL, _LEVEL, _LEVEL, _TURN]))
            for name, method in at_work.items():
                began = time.perf_counter()
                T[name] = method.update(depth, k, T[name] @ motion, covariance)
                times[name][k] = time.perf_counter() - began
        for name in at_work:
            took.setdefault((scene, name), []).append(times[name][min(_WARM, frames - 1) :])
            drifts.setdefault((scene, name), []).append(float(np.linalg.norm((T[name] - T_true[-1])[:3, 3])))
        say(f"registration: {scene}, seed {seed} done")
    default = next(iter(methods))
    out = []
    for scene, name in took:
        ms = 1e3 * np.concatenate(took[scene, name])
        ratio = float(np.median(ms / (1e3 * np.concatenate(took[scene, default]))))
        low, middle, high = np.percentile(ms, [25, 50, 75]).tolist()
        out.append(Timing("registration", scene, name, (middle, low, high), ratio, float(np.median(drifts[scene, name]))))
    return out, missing


def machine() -> str:
    """What it was measured on."""
    name = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines() if Path("/proc/cpuinfo").exists() else ():
        if line.startswith("model name"):
            name = line.partition(":")[2].strip()
            break
    return f"{name}, one thread, Python {platform.python_version()}, NumPy {np.__version__}"


def in_words(timings: Sequence[Timing], missing: Sequence[str]) -> str:
    """The timings for people."""
    lines = [machine()]
    lines.append(f"{'stage':<14}{'scene':<16}{'method':<22}{'ms median (quartiles)':>26}{'ratio':>8}{'drift mm':>10}")
    for t in timings:
        ms = f"{t.ms[0]:.2f} ({t.ms[1]:.2f} to {t.ms[2]:.2f})"
        lines.append(f"{t.stage:<14}{t.scene:<16}{t.method:<22}{ms:>26}{t.ratio:>8.2f}{1e3 * t.drift:>10.1f}")
    if missing:
        lines.append(f"not installed, so not measured: {', '.join(missing)}; pip install 'sextant[bench]' brings them")
    return "\n".join(lines)


def to_json(timings: Sequence[Timing], missing: Sequence[str]) -> str:
    """The timings for scripts."""
    rows = [
        {
            "stage": t.stage,
            "scene": t.scene,
            "method": t.method,
            "ms": {"median": t.ms[0], "q25": t.ms[1], "q75": t.ms[2]},
            "ratio": t.ratio,
            "drift_m": t.drift,
        }
        for t in timings
    ]
    return json.dumps({"machine": machine(), "timings": rows, "missing": list(missing)}, indent=1) + "\n"
