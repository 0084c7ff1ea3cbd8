"""Alerts by real SMTP and HTTP, and what is told when."""

from __future__ import annotations

import json
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from datetime import date
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from aiosmtpd.controller import Controller
from fleet_lake import fill
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import Home, home
from dtwin.errors import InputError
from dtwin.fleet.alerts import Alert, silence, tell
from dtwin.fleet.channels import channels_of, try_channels
from dtwin.fleet.nightly import nightly
from dtwin.machine_record import keep_record

DAY = date(2026, 11, 24)
LATE = Alert("overdue", "mill-1", "a test was due on 2026-11-01")
FAILED = Alert("failed", "c07", "diagnose: the file is damaged")


class Inbox:
    """Keeps what a mail server hands over."""

    def __init__(self) -> None:
        self.mails: list[Any] = []

    async def handle_RCPT(self, server: Any, session: Any, envelope: Any, address: str, options: Any) -> str:
        if address.startswith("left"):
            return "550 no such person"
        envelope.rcpt_tos.append(address)
        return "250 OK"

    async def handle_DATA(self, server: Any, session: Any, envelope: Any) -> str:
        self.mails.append(envelope)
        return "250 OK"


@pytest.fixture
def inbox() -> Iterator[tuple[Inbox, int]]:
    kept = Inbox()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    server = Controller(kept, hostname="127.0.0.1", port=port)
    server.start()
    try:
        yield kept, port
    finally:
        server.stop()


@pytest.fixture
def hook() -> Iterator[tuple[list[dict[str, Any]], int]]:
    got: list[dict[str, Any]] = []

    class Taker(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            got.append(body | {"authorization": self.headers.get("Authorization")})
            if self.path == "/moved":
                self.send_response(302)
                self.send_header("Location", "/elsewhere")
            else:
                self.send_response(204 if self.path == "/alerts" else 500)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Taker)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield got, server.server_address[1]
    finally:
        server.shutdown()
        server.server_close()


def state(text: str) -> Home:
    home().root.mkdir(parents=True, exist_ok=True)
    (home().root / "alerts.toml").write_text(text, encoding="utf-8")
    return home()


def test_new_alerts_are_one_mail_and_told_once_while_they_last(inbox: tuple[Inbox, int]) -> None:
    kept, port = inbox
    where = state(f'[email]\nsmtp = "127.0.0.1:{port}"\nsender = "dtwin@plant.example"\nto = ["shop@plant.example"]\n')
    assert tell(where, [LATE, FAILED], channels_of(where), DAY).sent == {"email": 2}
    (mail,) = kept.mails
    assert mail.rcpt_tos == ["shop@plant.example"]
    text = mail.content.decode()
    assert "Subject: dtwin: 2 to look at: c07, mill-1" in text
    assert text.index("failed    c07: diagnose: the file is damaged") < text.index("overdue   mill-1")
    assert tell(where, [LATE, FAILED], channels_of(where), DAY).sent == {}
    # It ended, and came again.
    tell(where, [FAILED], channels_of(where), DAY)
    assert tell(where, [LATE, FAILED], channels_of(where), DAY).sent == {"email": 1}
    assert len(kept.mails) == 2


def test_one_of_several_whom_the_server_refuses_is_owed_it_and_the_others_nothing(
    inbox: tuple[Inbox, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, port = inbox
    where = state(
        f'[email]\nsmtp = "127.0.0.1:{port}"\nsender = "a@b.example"\nto = ["shop@b.example", "left@b.example"]\n'
    )
    for night in (1, 2):
        told = tell(where, [LATE], channels_of(where), DAY)
        assert told.sent == ({"email to shop@b.example": 1} if night == 1 else {})
        assert "550" in told.failed["email to left@b.example"]
    assert [mail.rcpt_tos for mail in kept.mails] == [["shop@b.example"]]
    monkeypatch.delattr(Inbox, "handle_RCPT")
    assert tell(where, [LATE], channels_of(where), DAY).sent == {"email to left@b.example": 1}


def test_what_is_silenced_is_not_told_until_its_day(inbox: tuple[Inbox, int]) -> None:
    kept, port = inbox
    where = state(f'[email]\nsmtp = "127.0.0.1:{port}"\nsender = "a@b.example"\nto = ["c@d.example"]\n')
    assert silence(where, LATE.key, 7, DAY) == "2026-12-01"
    told = tell(where, [LATE], channels_of(where), DAY)
    assert (dict(told.sent), told.silenced) == ({}, (LATE.key,))
    assert tell(where, [LATE], channels_of(where), date(2026, 12, 1)).sent == {"email": 1}
    silence(where, LATE.key, 7, DAY)
    silence(where, LATE.key, 0, DAY)
    assert tell(where, [FAILED], channels_of(where), DAY).silenced == ()
    assert len(kept.mails) == 2


def test_a_channel_that_cannot_be_reached_is_told_the_next_time(
    hook: tuple[list[dict[str, Any]], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    got, port = hook
    monkeypatch.setenv("HOOK_TOKEN", "secret")
    url = f'[webhook]\nurl = "http://127.0.0.1:{port}/%s"\ntoken_from = "HOOK_TOKEN"\n'
    where = state(url % "broken")
    failed = tell(where, [LATE], channels_of(where), DAY).failed
    assert "500" in failed["webhook"]
    state(url % "moved")
    assert "302" in tell(where, [LATE], channels_of(where), DAY).failed["webhook"]
    state(url % "alerts")
    assert tell(where, [LATE], channels_of(where), DAY).sent == {"webhook": 1}
    assert [body["authorization"] for body in got] == ["Bearer secret"] * 3
    assert got[-1]["alerts"] == [{"sort": "overdue", "about": "mill-1", "text": LATE.text, "key": "overdue:mill-1"}]
    assert got[-1]["title"] == "dtwin: 1 to look at: mill-1"


def test_what_happened_once_is_owed_to_a_channel_that_could_not_be_reached(
    hook: tuple[list[dict[str, Any]], int],
) -> None:
    got, port = hook
    url = f'[webhook]\nurl = "http://127.0.0.1:{port}/%s"\n'
    where = state(url % "broken")
    gone = Alert("withdrawn", "mill-2", "the champion was withdrawn")
    assert tell(where, [LATE, gone], channels_of(where), DAY).failed
    # The next night nothing is withdrawn, and the test was made.
    state(url % "alerts")
    assert tell(where, [], channels_of(where), DAY).sent == {"webhook": 1}
    assert [alert["key"] for alert in got[-1]["alerts"]] == ["withdrawn:mill-2"]
    assert tell(where, [], channels_of(where), DAY).sent == {}


def test_alerts_of_one_name_are_all_told_and_a_second_change_anew(hook: tuple[list[dict[str, Any]], int]) -> None:
    got, port = hook
    where = state(f'[webhook]\nurl = "http://127.0.0.1:{port}/alerts"\n')
    twice = [Alert("failed", "c07", "diagnose: damaged"), Alert("failed", "c07", "recheck: no machine")]
    assert tell(where, twice, channels_of(where), DAY).sent == {"webhook": 2}
    assert [alert["text"] for alert in got[-1]["alerts"]] == ["diagnose: damaged", "recheck: no machine"]
    march, june = (Alert("changed", "mill-1 G(b)", "it changed", day) for day in ("2026-03-01", "2026-06-01"))
    for one, sent in ((march, 1), (march, 0), (june, 1)):
        assert sum(tell(where, [one], channels_of(where), DAY).sent.values()) == sent


def test_a_file_whose_name_is_no_text_holds_no_message_up(inbox: tuple[Inbox, int]) -> None:
    kept, port = inbox
    where = state(f'[email]\nsmtp = "127.0.0.1:{port}"\nsender = "a@b.example"\nto = ["c@d.example"]\n')
    bad = [Alert("failed", os.fsdecode(b"pr\xfcfung.b5r"), "no"), Alert("failed", "a\nBcc: x@y.example", "no")]
    assert tell(where, [*bad, LATE], channels_of(where), DAY).sent == {"email": 3}
    assert kept.mails[0].rcpt_tos == ["c@d.example"]
    assert b"\nBcc" not in kept.mails[0].content


def test_half_a_day_of_silence_is_a_day() -> None:
    assert silence(home(), LATE.key, 0.5, DAY) == "2026-11-25"
    assert tell(home(), [LATE], [], DAY).silenced == (LATE.key,)


def test_a_night_tells_the_newest_change_of_a_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    fill(home(), 1)
    june = {"text": "G(b) changed by +2 µm in June", "seen": "2026-06-01"}
    march = {"text": "G(b) changed by +1 µm in March", "seen": "2026-03-01"}
    series = [
        {"name": "G(b)", "state": "changed", "crossing": None, "changes": [june, march]},
        {"name": "H", "state": "trend", "crossing": None, "changes": [march]},
    ]
    monkeypatch.setattr(
        "dtwin.fleet.nightly.machine_history", lambda *_: {"next_test": None, "series": series, "champion": None}
    )
    night = nightly(home(), workers=1, today=DAY)
    assert [(alert.about, alert.text) for alert in night.alerts] == [
        ("mill-0 G(b)", june["text"]),
        ("mill-0 H", march["text"]),
    ]


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("[pager]\nnumber = 1\n", "pager"),
        ("email = 3\n", "3"),
        ("[email]\nsmtp = 'mail:25'\nsender = 'a@b.c'\n", "no to"),
        ("[email]\nsmtp = 'mail'\nsender = 'a@b.c'\nto = ['d@e.f']\n", "mail"),
        ("[email]\nsmtp = 'mail:25'\nsender = 'a@b.c'\nto = 'd@e.f'\n", "d@e.f"),
        ("[email]\nsmtp = 'mail:25'\nsender = 'a@b.c'\nto = [\"d@e.f\\nBcc: g@h.i\"]\n", "d@e.f\nBcc: g@h.i"),
        ("[webhook]\nurl = 'http://plant.example/x'\n", "http://plant.example/x"),
        ("[webhook]\nurl = 'file:///etc/passwd'\n", "file:///etc/passwd"),
        ("[webhook]\nurl = 'https://me:hush@plant.example/x'\n", "https://...@plant.example"),
        ("[webhook]\nurl = 'https://plant.example/x'\npassword = 'p'\n", None),
        ("[mqtt]\nbroker = 'plant:1883'\ntopic = 'a/#'\n", "a/#"),
        ("[mqtt\n", None),
        ("a = " + "[" * 90_000, None),
    ],
)
def test_channels_that_cannot_be_used_are_refused(text: str, got: str | None) -> None:
    with pytest.raises(InputError) as refused:
        channels_of(state(text))
    assert refused.value.code == "alert.channels"
    if got is not None:
        assert refused.value.got == got


def test_a_secret_that_is_not_there_is_a_failure_of_its_channel(hook: tuple[list[dict[str, Any]], int]) -> None:
    where = state(f'[webhook]\nurl = "http://127.0.0.1:{hook[1]}/alerts"\ntoken_from = "NOT_SET_ANYWHERE"\n')
    assert "not usable" in try_channels(where)["webhook"]
    assert hook[0] == []


def test_no_secret_stands_in_what_is_said(
    hook: tuple[list[dict[str, Any]], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    where = state(f'[webhook]\nurl = "http://127.0.0.1:{hook[1]}/alerts"\ntoken_from = "HOOK_TOKEN"\n')
    monkeypatch.setenv("HOOK_TOKEN", "hush\nhush")
    assert "hush" not in try_channels(where)["webhook"] != ""
    monkeypatch.setenv("HOOK_TOKEN", "hush\n")
    assert try_channels(where) == {"webhook": ""}
    assert hook[0][-1]["authorization"] == "Bearer hush"
    state('[email]\nsmtp = "a.example:25"\nsender = "a@b.example"\nto = ["a@b.example"]\npassword = "hush"\n')
    with pytest.raises(InputError) as refused:
        channels_of(where)
    assert refused.value.got == "password"


def test_a_mail_server_whose_answer_has_no_last_line_is_given_up() -> None:
    """All its lines were kept: some 30 MB a second, and for ever."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def talk() -> None:
            connected, _ = server.accept()
            with connected, suppress(OSError):
                while True:
                    connected.sendall(b"220-and more\r\n")

        threading.Thread(target=talk, daemon=True).start()
        address = f"127.0.0.1:{server.getsockname()[1]}"
        where = state(f'[email]\nsmtp = "{address}"\nsender = "a@b.example"\nto = ["a@b.example"]\n')
        assert "more than 1000 lines" in try_channels(where)["email"]


def test_a_server_that_never_ends_its_answer_holds_nothing_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dtwin.fleet.channels._LONGEST_S", 0.5)
    over = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def drip() -> None:
            connected, _ = server.accept()
            with connected:
                connected.sendall(b"HTTP/1.1 200 OK\r\nX-Slow: ")
                while not over.wait(0.05):
                    connected.sendall(b".")

        threading.Thread(target=drip, daemon=True).start()
        where = state(f'[webhook]\nurl = "http://127.0.0.1:{server.getsockname()[1]}/alerts"\n')
        assert try_channels(where) == {"webhook": "TimeoutError: its answer did not end within 0.5 s"}
        over.set()


def test_what_is_not_encrypted_takes_no_proxy(
    hook: tuple[list[dict[str, Any]], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    where = state(f'[webhook]\nurl = "http://127.0.0.1:{hook[1]}/alerts"\n')
    assert try_channels(where) == {"webhook": ""}


def test_the_command_tries_every_channel(hook: tuple[list[dict[str, Any]], int]) -> None:
    shell = CliRunner()
    assert shell.invoke(app, ["alert", "test"]).exit_code == 1
    state(f'[webhook]\nurl = "http://127.0.0.1:{hook[1]}/alerts"\n')
    done = shell.invoke(app, ["alert", "test"])
    assert (done.exit_code, done.stdout) == (0, "webhook: sent\n")
    assert hook[0][0]["title"] == "dtwin: a test"
    state(f'[webhook]\nurl = "http://127.0.0.1:{hook[1]}/broken"\n')
    assert shell.invoke(app, ["alert", "test"]).exit_code == 1


@pytest.mark.parametrize(
    ("key", "days"), [("mill-1", 7.0), ("late:mill-1", 7.0), ("overdue:", 7.0), ("overdue:x", 1e9)]
)
def test_what_no_alert_is_called_cannot_be_silenced(key: str, days: float) -> None:
    with pytest.raises(InputError):
        silence(home(), key, days)


def test_a_night_takes_in_diagnoses_and_lists_what_is_late_and_failed(
    tmp_path: Path, hook: tuple[list[dict[str, Any]], int]
) -> None:
    where = state(f'[webhook]\nurl = "http://127.0.0.1:{hook[1]}/alerts"\n')
    fill(where, 4)
    keep_record(where, "mill-0", {"test_every_days": 30.0})
    keep_record(where, "mill-1", {"test_every_days": 3000.0})
    arriving = tmp_path / "arriving"
    (arriving / "mill-0").mkdir(parents=True)
    (arriving / "mill-0" / "spoilt.b5r").write_text("<no>", encoding="utf-8")
    night = nightly(where, folder=arriving, workers=1, today=DAY, settle_s=0.0)
    assert sorted(night.diagnosed.done) == ["c00", "c01", "c02", "c03"]
    assert [(alert.sort, alert.about) for alert in night.alerts] == [
        ("failed", "mill-0/spoilt.b5r"),
        ("overdue", "mill-0"),
    ]
    assert "due on 2026-04-02" in night.alerts[1].text
    (told,) = hook[0]
    assert [alert["key"] for alert in told["alerts"]] == ["failed:mill-0/spoilt.b5r", "overdue:mill-0"]
    # The next night: nothing new, nothing told again; the spoilt file is looked at again when it changes.
    again = nightly(where, folder=arriving, workers=1, today=DAY, settle_s=0.0)
    assert not again.diagnosed.done
    assert [alert.key for alert in again.alerts] == ["overdue:mill-0"]
    assert len(hook[0]) == 1


def test_a_night_without_its_scheduler_tells_so_and_all_else(
    hook: tuple[list[dict[str, Any]], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dtwin.fleet.run._CONNECT_S", 0.3)
    where = state(f'[webhook]\nurl = "http://127.0.0.1:{hook[1]}/alerts"\n')
    fill(where, 1)
    keep_record(where, "mill-0", {"test_every_days": 30.0})
    nightly(where, on="dask://127.0.0.1:9", today=DAY)
    assert [alert["key"] for alert in hook[0][0]["alerts"]] == ["failed:fleet diagnose", "overdue:mill-0"]


def test_a_file_that_was_refused_on_a_night_that_was_killed_is_told_the_next_night(
    tmp_path: Path, hook: tuple[list[dict[str, Any]], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    where = state(f'[webhook]\nurl = "http://127.0.0.1:{hook[1]}/alerts"\n')
    arriving = tmp_path / "arriving"
    arriving.mkdir()
    (arriving / "spoilt.b5r").write_text("<no>", encoding="utf-8")
    with monkeypatch.context() as killed:
        killed.setattr("dtwin.fleet.nightly.tell", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            nightly(where, folder=arriving, workers=1, today=DAY, settle_s=0.0)
    for alerts in (["failed:spoilt.b5r"], []):
        night = nightly(where, folder=arriving, workers=1, today=DAY, settle_s=0.0)
        assert [alert.key for alert in night.alerts] == alerts
    assert len(hook[0]) == 1
