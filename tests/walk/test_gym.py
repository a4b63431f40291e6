"""The Gymnasium environment: its checker passes, and episodes end at the goal, by a fall or at the time limit."""

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sextant.gym import EpisodeError, HexapodEnv

AHEAD = np.array([0.9, 0.0, 0.0], np.float32)


def course(tmp_path: Path, distance: float, time_limit_s: float) -> str:
    path = tmp_path / "short.toml"
    path.write_text(
        f'name = "short"\ntime_limit_s = {time_limit_s}\n[goal]\ndistance = {distance}\n[[terrain]]\nkind = "plane"\n'
    )
    return str(path)


@pytest.mark.rare  # the wrapper of `gymnasium.make` checks the same of the first reset and step below
def test_gymnasium_checker_finds_no_fault() -> None:
    check_env(HexapodEnv("flat", step_s=0.2), skip_render_check=True)  # any warning is an error here


@pytest.mark.slow
def test_same_seed_and_actions_give_the_same_episode_with_progress() -> None:
    runs = []
    for _ in range(2):
        env = gymnasium.make("sextant.gym:sextant/Hexapod-v0", scenario="steps")
        observation, info = env.reset(seed=7)
        assert info == {"time_s": pytest.approx(2.6, abs=2.0), "seed": 7}
        assert observation["known"].mean() > 0.3
        assert observation["goal"][0] == pytest.approx(2.5, abs=0.5)
        seen, rewards = [observation], []
        for _ in range(4):
            observation, reward, terminated, truncated, _ = env.step(AHEAD)
            assert not terminated
            assert not truncated
            seen.append(observation)
            rewards.append(reward)
        runs.append((seen, rewards))
    (seen, rewards), (again, rewards_again) = runs
    assert rewards == rewards_again
    for one, other in zip(seen, again, strict=True):
        for name, values in one.items():
            np.testing.assert_array_equal(values, other[name])
    assert sum(rewards) > 0.15
    assert seen[0]["goal"][0] - seen[-1]["goal"][0] == pytest.approx(sum(rewards), abs=0.02)
    assert seen[-1]["heights"].max() > 0.01, "the map shows the blocks ahead"


@pytest.mark.slow
def test_episode_terminates_at_goal_and_is_truncated_at_time_limit(tmp_path: Path) -> None:
    env = HexapodEnv(course(tmp_path, 0.1, 60.0))
    env.reset(seed=1)
    for _ in range(5):
        _, reward, terminated, truncated, info = env.step(AHEAD)
        if terminated:
            break
    assert (terminated, truncated, info["reason"]) == (True, False, "goal reached")
    assert reward > 1.0
    env = HexapodEnv(course(tmp_path, 2.0, 4.0))
    env.reset(seed=1)
    ends = [env.step(np.zeros(3, np.float32))[2:] for _ in range(3)]
    assert ends[-1][:2] == (False, True)
    assert "reason" in ends[-1][2]


@pytest.mark.slow
def test_documented_loop_runs() -> None:
    text = (Path(__file__).parents[2] / "docs/tools.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    (code,) = (block for block in blocks if "gymnasium" in block)
    names: dict[str, object] = {}
    exec(code, names)
    assert np.isfinite(float(names["reward"]))  # type: ignore[arg-type]


def test_wrong_use_is_refused() -> None:
    with pytest.raises(ValueError, match=r"step_s of 0\.1 to 10 s expected, found 0"):
        HexapodEnv("flat", step_s=0.0)
    with pytest.raises(ValueError, match="passage1, which is a passage"):
        HexapodEnv("passage1")
    with pytest.raises(EpisodeError, match="reset"):
        HexapodEnv("flat").step(AHEAD)
