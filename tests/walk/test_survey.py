"""A passage survey during a walk: it shows the ground, and the walk is unaffected."""

import itertools
from dataclasses import replace

import numpy as np

from benchmarks.peers.foothold_model import LENGTH, ORIGIN, WIDTH, Asker
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.scenario.terrain import Box
from sextant.shared.wire import codec, topics
from tests.support.walks import flat, walk

BLOCK = Box((1.0, 0.35), (0.2, 0.3), 0.06)


def test_passage_survey_during_walk_matches_ground_ahead() -> None:
    plain = flat(0.3)
    scenario = replace(plain, terrain=(*plain.terrain, BLOCK))
    over = walk(scenario, 1000, (topics.PASSAGE, topics.TERRAIN), guests=[Asker()])
    assert over.report.success, over.report.reason
    told = over.heard.of(topics.PASSAGE)
    maps = over.heard.of(topics.TERRAIN)
    assert len(told) > 10
    assert all(b.stamp_ns > a.stamp_ns for a, b in itertools.pairwise(told))
    assert max(len(codec.encode(m)) for m in told) < 500_000
    last = told[-1]
    assert last.elevation.shape == (round(LENGTH / last.resolution), round(WIDTH / last.resolution))
    np.testing.assert_allclose(last.origin, np.array([ORIGIN[0], -WIDTH / 2]) + last.resolution / 2)
    # {world} begins where the robot stood, at the simulator's origin.
    x = last.origin[0] + last.resolution * np.arange(last.elevation.shape[0])
    y = last.origin[1] + last.resolution * np.arange(last.elevation.shape[1])
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    true = build_terrain(scenario, np.random.default_rng(0)).height_at(points).reshape(last.elevation.shape)
    off_edges = ((np.abs(x[:, None] - 1.0) > 0.13) | (np.abs(y - 0.35) > 0.18)) | (
        (np.abs(x[:, None] - 1.0) < 0.07) & (np.abs(y - 0.35) < 0.12)
    )
    known = np.isfinite(last.elevation) & off_edges
    assert np.sqrt(np.mean((last.elevation - true)[known] ** 2)) < 0.006
    assert known.mean() > 0.4
    assert last.unseen_share == np.isnan(last.elevation).mean()
    assert "cells not seen" in last.reason
    # The maps keep their rate.
    period = np.median(np.diff([m.stamp_ns for m in maps]))
    assert period < 1.2e9 / topics.TERRAIN.rate_hz
