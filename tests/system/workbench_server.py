"""``dtwin ui`` as a process, for the tests of what it serves."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from dtwin.workbench._access import KEY

START_S = 300.0


class Workbench:
    """Handle of a running ``dtwin ui``."""

    def __init__(self, home: Path, process: subprocess.Popen[str]) -> None:
        self.home = home
        self.process = process
        self.address = ""

    @property
    def base(self) -> str:
        return self.address.split("/?")[0]

    @property
    def token(self) -> str:
        return parse_qs(urlsplit(self.address).query)["token"][0]

    @cached_property
    def entered(self) -> tuple[str, str]:
        """The cookie of a browser that opened the address, and the key that its page sends with every change."""
        with urllib.request.urlopen(self.address, timeout=120) as answer:
            page = answer.read().decode()
            return answer.headers["set-cookie"].partition(";")[0], page.partition('data-key="')[2].partition('"')[0]

    @property
    def cookie(self) -> str:
        return self.entered[0]

    def await_address(self) -> None:
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], START_S)
        line = self.process.stdout.readline() if ready else ""
        found = re.search(r"http://\S+", line)
        assert found, self.complaint()
        self.address = found.group(0)

    def complaint(self) -> str:
        self.process.kill()
        assert self.process.stderr is not None
        return self.process.stderr.read()

    def stop(self) -> int:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        return self.process.wait(300)

    def ask(self, path: str, *, method: str = "GET", body: bytes | None = None, **headers: str) -> tuple[int, str]:
        """Status and text of an answer; header names with ``_`` for ``-``."""
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        request = urllib.request.Request(self.base + path, body, named, method=method)
        try:
            with urllib.request.urlopen(request, timeout=120) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    def act(self, path: str, body: bytes = b"{}", method: str = "POST") -> tuple[int, str]:
        """As the workbench's own page does."""
        own = {"cookie": self.cookie, KEY: self.entered[1], "origin": self.base}
        return self.ask(path, method=method, body=body, content_type="application/json", **own)


@contextmanager
def running_workbench(home: Path, *options: str, browser: Path | None = None) -> Iterator[Workbench]:
    """Run ``dtwin ui``. ``browser``: a program that it opens instead of none."""
    options = options if browser else ("--no-browser", *options)
    process = subprocess.Popen(
        [sys.executable, "-m", "dtwin", "ui", *options],
        env=os.environ | {"DTWIN_HOME": str(home), "OMP_NUM_THREADS": "1", "BROWSER": f"{browser} %s"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    bench = Workbench(home, process)
    try:
        bench.await_address()
        yield bench
    finally:
        bench.stop()
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()
