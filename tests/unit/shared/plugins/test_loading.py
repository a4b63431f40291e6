"""Plug-ins: found by name, called, and named in every error."""

import importlib.metadata
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sextant.plugins import ElevationMap
from sextant.shared.files.config import ConfigError
from sextant.shared.plugins.loading import Plugin, PluginError, Plugins, load
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario
from tests.support import plugins

HERE = "tests.support.plugins"
PROFILE = load_profile("phantomx_mk2")


def ground(shape=(4, 5)):
    level = np.zeros(shape, dtype=np.float32)
    return ElevationMap(level, level, np.zeros(2), 0.01, PROFILE.foot.radius)


@pytest.fixture
def entry_point(monkeypatch):
    """Install an entry point `good` for a foothold rule."""
    entry = importlib.metadata.EntryPoint("good", f"{HERE}:all_good", "sextant.foothold")
    monkeypatch.setattr(
        importlib.metadata, "entry_points", lambda group: (entry,) if group == "sextant.foothold" else (), raising=True
    )


def test_name_of_an_object_finds_it():
    assert load("foothold", f"{HERE}:all_good") is plugins.all_good


def test_module_in_the_working_directory_is_found_and_replaces_no_installed_one(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    monkeypatch.chdir(tmp_path)
    for name in ("own_rules_of_a_test", "tomllib"):
        (tmp_path / f"{name}.py").write_text("def load(ground):\n    return ground.elevation\n")
    assert load("foothold", "own_rules_of_a_test:load").__module__ == "own_rules_of_a_test"
    assert Plugins(foothold="own_rules_of_a_test:load").sources() == [tmp_path / "own_rules_of_a_test.py"]
    monkeypatch.delitem(sys.modules, "tomllib")
    assert load("foothold", "tomllib:load").__module__.startswith("tomllib.")


def test_name_of_an_entry_point_finds_its_object(entry_point):
    assert load("foothold", "good") is plugins.all_good


def test_unknown_entry_point_gets_a_suggestion(entry_point):
    with pytest.raises(PluginError, match="did you mean 'good'"):
        load("foothold", "god")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("os", "package.module:Object or the name of an entry point expected, found 'os'"),
        ("a b:c", "package.module:Object"),
        ("", "package.module:Object"),
        ("no_such_package.rules:best", "there is no module no_such_package"),
        (f"{HERE}:al_good", "did you mean 'all_good'"),
        (f"{HERE}:not_callable", "a class or a function expected, found int"),
    ],
)
def test_wrong_name_gets_one_sentence(name, words):
    with pytest.raises(PluginError) as error:
        load("planner", name)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_module_that_needs_another_one_names_it(tmp_path, monkeypatch):
    (tmp_path / "needs_more.py").write_text("import no_such_library\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(PluginError, match="needs no_such_library, which is not installed"):
        load("planner", "needs_more:Anything")


def test_module_that_fails_on_import_is_named_with_its_line(tmp_path, monkeypatch):
    (tmp_path / "bad_import.py").write_text("x = 1\nraise RuntimeError('not today')\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(PluginError, match=r"bad_import cannot be imported: RuntimeError: not today \(bad_import.py:2\)"):
        load("planner", "bad_import:Anything")


def test_failure_names_plugin_and_innermost_line():
    rule = Plugin.make("foothold", f"{HERE}:failing", PROFILE)
    with pytest.raises(PluginError, match=rf"plug-in {HERE}:failing failed: KeyError: 'a name' \(plugins.py:\d+\)"):
        rule.call(lambda function: function(ground()))


def test_failure_while_it_is_made_is_named_too():
    with pytest.raises(PluginError, match=r"broken_maker failed when it was called with the robot's profile: OSError: no"):
        Plugin.make("registration", f"{HERE}:broken_maker", PROFILE)


def test_plugin_without_its_method_is_refused_when_it_is_made():
    with pytest.raises(PluginError, match="a registration with a method register expected, found StandStill"):
        Plugin.make("registration", f"{HERE}:StandStill", PROFILE)


def test_class_of_a_rule_is_made_for_the_robot():
    rule = Plugin.make("foothold", f"{HERE}:Weighted", PROFILE)
    assert (rule.call(lambda function: function(ground())) == 1.0).all()


def test_sources_are_the_files_of_the_package():
    names = {path.relative_to(Path(plugins.__file__).parents[1]).as_posix() for path in chosen().sources()}
    assert "support/plugins.py" in names


def chosen() -> Plugins:
    return Plugins(foothold=f"{HERE}:all_good")


def test_words_name_kind_and_plugin():
    assert chosen().words() == f"foothold {HERE}:all_good"
    assert Plugins().words() == ""


def test_scenario_file_cannot_name_a_plugin(tmp_path):
    source = load_scenario("flat")
    assert replace(source, plugins=chosen()).plugins.foothold
    path = tmp_path / "mine.toml"
    path.write_text('name = "mine"\n[[terrain]]\nkind = "plane"\n[goal]\ndistance = 1.0\n[plugins]\nplanner = "os:system"\n')
    with pytest.raises(ConfigError, match="a scenario is data and a plug-in is code"):
        load_scenario(str(path))
