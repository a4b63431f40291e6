"""`sextant order`: what it prints when the robot refuses."""

import contextlib
import threading
from typing import Any

import pytest

from sextant.deploy import cli
from sextant.deploy.live import client_run
from sextant.deploy.live.send_command import Order


def test_refusal_names_the_robot_that_was_asked(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def refuse(order: Order, _link: object, stop: threading.Event, **_: Any) -> None:
        order.failed = "`stand` of me refused: you holds the lease"
        order.finished = True
        stop.wait()

    monkeypatch.setattr(client_run, "ZenohLink", lambda _: contextlib.nullcontext())
    monkeypatch.setattr(client_run, "run_live", refuse)
    assert cli.main(["order", "stand", "--connect", "tcp/127.0.0.1:1", "--namespace", "alpha"]) == 1
    refused = "sextant order: the robot at tcp/127.0.0.1:1, namespace alpha: `stand` of me refused: you holds the lease"
    assert capsys.readouterr().err.splitlines()[-1] == refused
