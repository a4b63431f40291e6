"""`sextant order`: what it prints when the robot refuses, and how a client that fails ends."""

import contextlib
import threading
from types import SimpleNamespace
from typing import Any

import pytest

from sextant.deploy import cli
from sextant.deploy.live import client_run
from sextant.deploy.live.send_command import Order
from sextant.shared.wire import topics
from sextant.shared.wire.messages import StopOrder
from sextant.shared.wire.transport import Endpoints


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


def test_client_that_fails_ends_its_order_and_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[object] = []

    def fail(_order: Order, _link: object, _stop: threading.Event, **_: Any) -> None:
        raise ZeroDivisionError("a defect")

    link = SimpleNamespace(send=lambda topic, _: sent.append(topic))
    monkeypatch.setattr(client_run, "ZenohLink", lambda _: contextlib.nullcontext(link))
    monkeypatch.setattr(client_run, "run_live", fail)
    order = Order("walk", "me")
    monkeypatch.setattr(order, "withdraw", lambda: (StopOrder(0, "stop", 1, "me"),))
    with pytest.raises(ZeroDivisionError, match="a defect"):
        client_run.run_client(order, Endpoints(("tcp/127.0.0.1:1",)), lambda _: None)
    assert sent == [topics.STOP]
