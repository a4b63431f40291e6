"""Warm-up of perception: no permitted parameter of the texture ends it."""

from dataclasses import replace

import pytest

from sextant.services.perception import warmup
from sextant.services.perception.config import Settings
from sextant.services.perception.registration.texture_tracking import TextureTracker
from sextant.shared.robot.profiles import load_profile


@pytest.mark.parametrize("use", [True, False])
def test_warmup_tracks_texture_if_it_is_used_whatever_its_least_gradient(use: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[float] = []
    load = TextureTracker.load
    monkeypatch.setattr(TextureTracker, "load", lambda self, gray: (made.append(gray.size), load(self, gray))[1])
    profile = load_profile("phantomx_mk2")
    profile = replace(profile, camera=replace(profile.camera, color=True))
    settings = Settings()
    warmup.compile_functions(profile, replace(settings, texture=replace(settings.texture, use=use, min_texture=100.0)))
    assert (max(made, default=0) > 0) == use
