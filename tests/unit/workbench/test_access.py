from __future__ import annotations

from pathlib import Path

import pytest
from entered_workbench import enter
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route
from starlette.testclient import TestClient

from dtwin.config import Home
from dtwin.own_address import is_foreign, names_this_computer
from dtwin.people import add_person
from dtwin.workbench._access import KEY, Access, Guarded


async def said(_request: object) -> PlainTextResponse:
    return PlainTextResponse("said")


def client(access: Access) -> TestClient:
    app = Starlette(routes=[Route("/{path:path}", said, methods=["GET", "POST", "PUT"])])
    return TestClient(Guarded(app, access), base_url="http://127.0.0.1:8765")


@pytest.mark.parametrize(
    "host",
    [
        "localhost:8765/evil",
        "localhost:8765?x",
        "evil.example",
        "localhost.evil.example",
        "",
        "127.0.0.1@evil",
        "[::1]evil",
        "localhost:8765 evil",
        "192.0.2.1",
    ],
)
def test_a_host_that_is_not_one_is_no_name_of_ours(host: str) -> None:
    assert not names_this_computer(host)
    assert client(Access("127.0.0.1", 8765)).get("/", headers={"host": host}).status_code == 403


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:1", "127.0.0.1:8765", "[::1]:8765"])
def test_own_names(host: str) -> None:
    assert names_this_computer(host)


def test_another_port_is_another_site() -> None:
    assert is_foreign("http://127.0.0.1:1", "127.0.0.1:2")
    assert is_foreign("https://127.0.0.1:2", "127.0.0.1:2")
    assert is_foreign("null", "127.0.0.1:2")
    assert not is_foreign("http://127.0.0.1:2", "127.0.0.1:2")
    assert not is_foreign(None, "127.0.0.1:2")


@pytest.mark.parametrize(
    ("site", "code"), [("cross-site", 403), ("same-site", 403), ("same-origin", 200), ("none", 200)]
)
def test_pages_are_not_computed_for_other_sites(site: str, code: int) -> None:
    opened = client(Access("127.0.0.1", 8765))
    assert opened.get("/twins/x", headers={"sec-fetch-site": site}).status_code == code


def test_reading_needs_the_token_on_a_private_server() -> None:
    access = Access("127.0.0.1", 8765, private=True)
    opened = client(access)
    assert opened.get("/campaigns").status_code == 403
    assert opened.get("/static/workbench.css").status_code == 200
    enter(opened, access.token)
    assert opened.get("/campaigns").status_code == 200


def test_what_another_server_of_this_computer_is_sent_changes_nothing(tmp_path: Path) -> None:
    home = Home(tmp_path)
    access = Access("127.0.0.1", 8765, home=home)
    own = {"origin": "http://127.0.0.1:8765"}
    tokens = access.token, add_person(home, "max", ["train"]), add_person(home, "lena", ["train"])
    browsers = [client(access) for _ in tokens]
    for opened, token in zip(browsers, tokens, strict=True):
        enter(opened, token)
    for opened in browsers:
        assert opened.post("/api/twins", headers=own).status_code == 200
        # A cookie goes to every port: it lets nobody enter, nor change, whoever has a key of his own.
        sent = opened.cookies[access.cookie]
        assert opened.get("/", params={"token": sent}).status_code == 403
        for key in ("", sent, *(other.headers[KEY] for other in browsers if other is not opened)):
            assert opened.post("/api/twins", headers=own | {KEY: key}).status_code == 403
    (tmp_path / "people.toml").unlink()
    assert [opened.post("/api/twins", headers=own).status_code for opened in browsers] == [200, 403, 403]


def test_a_request_that_is_long_or_does_not_say_how_long_is_not_read() -> None:
    access = Access("127.0.0.1", 8765)
    opened = client(access)
    enter(opened, access.token)
    own = {"origin": "http://127.0.0.1:8765"}
    assert opened.post("/api/twins", content=b"x" * 1_000_000, headers=own).status_code == 200
    assert opened.post("/api/twins", content=b"x" * 1_000_001, headers=own).status_code == 413
    assert opened.post("/api/twins", content=iter([b"x"]), headers=own).status_code == 413
    assert opened.post("/api/twins", headers=own | {"content-length": "9" * 5000}).status_code == 413
    # Files go to the disk as they come, and what receives them counts.
    assert opened.put("/api/trays/a", content=b"x" * 1_000_001, headers=own).status_code == 200
    assert opened.post("/api/trays/a/ingest", content=b"x" * 1_000_001, headers=own).status_code == 413


@pytest.mark.parametrize("path", ["//evil.example/", "///evil.example", "/\\evil.example"])
def test_the_way_in_leads_nowhere_else(path: str) -> None:
    access = Access("127.0.0.1", 8765)
    page = client(access).get(f"http://127.0.0.1:8765{path}", params={"token": access.token}).text
    target = page.partition("url=")[2].partition('"')[0]
    assert target.startswith("/")
    assert not target.startswith(("//", "/\\"))
