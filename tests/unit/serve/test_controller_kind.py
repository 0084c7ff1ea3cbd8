"""What a controller is taken for that answers anything."""

from __future__ import annotations

import contextlib
import socket
import threading

import pytest

from dtwin.serve.controller_kind import is_virtual


@pytest.mark.parametrize("rubbish", [bytes(3), b"\x00\x05V", b"\xff"])
def test_rubbish_without_an_end_is_no_virtual_controller(rubbish: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    known, ended = threading.Event(), threading.Event()

    def talk(listening: socket.socket) -> None:
        connection, _ = listening.accept()
        with connection, contextlib.suppress(OSError):
            for _ in range(1000):
                if known.wait(0.01):
                    return
                connection.sendall(rubbish)
        ended.set()

    with socket.create_server(("127.0.0.1", 0)) as listening:
        monkeypatch.setattr("dtwin.serve.controller_kind.RTDE_PORT", listening.getsockname()[1])
        thread = threading.Thread(target=talk, args=(listening,))
        thread.start()
        assert not is_virtual("127.0.0.1", timeout_s=0.2)
        assert not ended.is_set()
        known.set()
        thread.join()
