"""Alerts through a real broker."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from datetime import date
from pathlib import Path

import pytest
from mqtt_broker import running_broker
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from dtwin.config import home
from dtwin.fleet.alerts import Alert, tell
from dtwin.fleet.channels import channels_of

pytestmark = pytest.mark.system


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[int]:
    with running_broker(tmp_path) as port:
        yield port


def test_who_subscribes_gets_what_is_new_once(broker: int) -> None:
    got: list[dict[str, object]] = []
    listener = Client(CallbackAPIVersion.VERSION2)
    ready: list[object] = []
    listener.on_subscribe = lambda *_: ready.append(True)
    listener.on_message = lambda _client, _data, message: got.append(json.loads(message.payload))
    listener.connect("127.0.0.1", broker)
    listener.subscribe("plant/#", qos=1)
    listener.loop_start()
    try:
        until = time.monotonic() + 300.0
        while not ready and time.monotonic() < until:
            time.sleep(0.02)
        home().root.mkdir(parents=True)
        stated = f'[mqtt]\nbroker = "127.0.0.1:{broker}"\ntopic = "plant/alerts"\n'
        (home().root / "alerts.toml").write_text(stated, encoding="utf-8")
        late = Alert("overdue", "mill-1", "a test was due on 2026-11-01")
        day = date(2026, 11, 24)
        assert tell(home(), [late], channels_of(home()), day).sent == {"mqtt": 1}
        assert tell(home(), [late], channels_of(home()), day).sent == {}
        while not got and time.monotonic() < until:
            time.sleep(0.02)
    finally:
        listener.disconnect()
        listener.loop_stop()
    assert [message["title"] for message in got] == ["dtwin: 1 to look at: mill-1"]


def test_a_broker_that_is_away_is_said(broker: int) -> None:
    home().root.mkdir(parents=True)
    (home().root / "alerts.toml").write_text('[mqtt]\nbroker = "127.0.0.1:9"\n', encoding="utf-8")
    failed = tell(home(), [Alert("failed", "x", "y")], channels_of(home()), date(2026, 11, 24)).failed
    assert "refused" in failed["mqtt"]
