"""MJCF as a robot description: the simulator's model has the kinematics of its profile."""

from pathlib import Path

import numpy as np
import pytest

from sextant.services.simulator.physics.mjcf_description import read_mjcf
from sextant.services.simulator.physics.model import mjcf
from sextant.shared.robot.description.profile_import import import_profile
from sextant.shared.robot.description.robot_description import DescriptionError
from sextant.shared.robot.kinematics import body_forward
from sextant.shared.robot.profiles import load_profile, profile_names

LEG = """
<body name="{name}" pos="{x} {y} 0" euler="0 0 {yaw}">
  <inertial pos="0 0 0" mass="0.07" diaginertia="1e-4 1e-4 1e-4"/>
  <joint name="{name} yaw" axis="0 0 1" range="-60 60"/>
  <geom type="mesh" mesh="coxa"/>
  <body pos="0.05 0 0">
    <joint name="{name} pitch" axis="0 1 0" range="-90 90"/>
    <geom type="capsule" fromto="0 0 0 0.07 0 0" size="0.01" mass="0.07"/>
    <body pos="0.07 0 0" euler="0 90 0">
      <joint name="{name} knee" axis="0 1 0" range="-60 80"/>
      <geom type="capsule" fromto="0 0 0 0.12 0 0" size="0.008" mass="0.04"/>
    </body>
  </body>
</body>"""
PLACES = {"lf": (0.1, 0.06, 45), "lm": (0, 0.09, 90), "lr": (-0.1, 0.06, 135)}
PLACES |= {name.replace("l", "r", 1): (x, -y, -yaw) for name, (x, y, yaw) in PLACES.items()}
HEXAPOD = f"""
<mujoco model="spider">
  <compiler angle="degree"/>
  <default><joint limited="true" damping="0.3"/></default>
  <asset><mesh name="coxa" file="nowhere.stl"/><material name="m" texture="wood"/>
    <texture name="wood" type="2d" file="nowhere.png"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 0.1" material="m"/>
    <body name="trunk" pos="0 0 0.2"><freejoint/>
      <geom type="box" size="0.12 0.07 0.03" mass="1.5" material="m"/>
      {"".join(LEG.format(name=name, x=x, y=y, yaw=yaw) for name, (x, y, yaw) in PLACES.items())}
    </body>
  </worldbody>
  <actuator><position joint="lf yaw" kp="10" forcerange="-1.8 1.8"/></actuator>
</mujoco>"""


@pytest.mark.parametrize("name", profile_names())
def test_exported_mjcf_is_imported_with_the_same_kinematics(name: str, tmp_path: Path) -> None:
    robot = load_profile(name)
    path = tmp_path / "robot.xml"
    path.write_text(mjcf(robot), encoding="utf-8")
    found = import_profile(read_mjcf(path))
    q = np.random.default_rng(0).uniform(robot.joint_limits[..., 0], robot.joint_limits[..., 1], (100, 6, 3))
    np.testing.assert_allclose(body_forward(found.profile, q), body_forward(robot, q), atol=1e-6)
    assert found.foot_error < 1e-6
    assert found.profile.servo.stall_torque == pytest.approx(robot.servo.stall_torque)
    assert found.profile.servo.no_load_speed == pytest.approx(robot.servo.no_load_speed, rel=1e-4)
    assert found.profile.servo.armature == pytest.approx(robot.servo.armature)
    assert found.profile.body.mass == pytest.approx(robot.body.mass)
    assert found.profile.foot == robot.foot


def test_robot_of_meshes_and_defaults_is_read_without_its_files(tmp_path: Path) -> None:
    path = tmp_path / "spider.xml"
    path.write_text(HEXAPOD, encoding="utf-8")
    found = import_profile(read_mjcf(path))
    links = found.profile.links
    assert (links.coxa, links.femur, links.tibia) == pytest.approx((0.05, 0.07, 0.12), abs=1e-6)
    assert found.profile.name == "spider"
    assert found.profile.foot.radius == pytest.approx(0.008)
    assert found.profile.body.size == pytest.approx((0.24, 0.14, 0.06))
    assert found.joints["right middle"] == ("rm yaw", "rm pitch", "rm knee")
    assert found.profile.servo.stall_torque == pytest.approx(1.8)
    # The knee is bent down by 90 deg at joint angle zero; a positive angle about y lowers the leg.
    np.testing.assert_allclose(np.degrees(found.profile.joint_limits[0, 2]), [-170.0, -30.0], atol=1e-3)
    assert found.foot_error < 1e-6


def test_joints_of_a_head_are_fixed_whatever_they_are(tmp_path: Path) -> None:
    box = '<geom type="box" size=".01 .01 .01" mass="0.1"/>'
    head = (
        f'<body name="head"><joint name="pan" range="-90 90"/>{box}'
        f'<body name="eyes"><joint type="ball" name="look" range="0 20"/>{box}</body>'
        f'<body name="neck"><joint type="slide" name="up" range="0 1"/><joint name="turn" range="-90 90"/>{box}</body></body>'
    )
    path = tmp_path / "spider.xml"
    path.write_text(HEXAPOD.replace('<body name="lf"', f'{head}<body name="lf"'), encoding="utf-8")
    found = import_profile(read_mjcf(path))
    assert found.profile.body.mass == pytest.approx(1.8)
    (note,) = [note for note in found.notes if note.startswith("joints that are not of a leg are fixed at zero: ")]
    assert sorted(note.split(": ")[1].split(", ")) == ["look (ball)", "pan", "up (slide and hinge)"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<mujoco><worldbody><body/></worldbody></mujoco>", "a trunk and hinges below it expected, found no hinge"),
        ("<mujoco><nothing/></mujoco>", "MJCF expected: .*nothing"),
        (
            HEXAPOD.replace('<joint name="lf knee"', '<joint type="slide" name="lf knee"'),
            r"found 6 \(.*; of other kinds: lf knee \(slide\)\)",
        ),
    ],
)
def test_other_models_are_an_error(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "model.xml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DescriptionError, match=words):
        import_profile(read_mjcf(path))


def test_names_that_are_not_utf8_are_an_error(tmp_path: Path) -> None:
    path = tmp_path / "model.xml"
    path.write_bytes(HEXAPOD.encode().replace(b"lf knee", b"lf \xff"))
    with pytest.raises(DescriptionError, match="MJCF expected"):
        read_mjcf(path)


def test_warnings_of_mujoco_leave_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("model.xml").write_text(HEXAPOD.replace('pos="0.07 0 0"', 'pos="nan 0 0"'), encoding="utf-8")
    with pytest.raises(DescriptionError):
        import_profile(read_mjcf(Path("model.xml")))
    assert [path.name for path in tmp_path.iterdir()] == ["model.xml"]
