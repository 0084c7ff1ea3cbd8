"""Photograph pages of the workbench for the front page of the documentation: ``python docs/pictures/workbench.py``.

Fills a home with the quick demo and with two tests of the virtual mill, starts ``dtwin ui`` on it, and writes the pictures beside
itself; ``--home FOLDER`` takes one that is filled. It wants Debian's ``chromium`` and the package ``playwright``.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from playwright.sync_api import Page, sync_playwright

BESIDE = Path(__file__).parent
LARGEST_KB = 150
_WIDTH, _HEIGHT = 1100, 640
_PATIENCE_MS = 60_000
_FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-lcd-text", "--disable-background-networking"]


class Picture(NamedTuple):
    """A page of the workbench: file, address, and where in the page the picture begins."""

    file: str
    address: str
    top: str = "h1"


PICTURES = (
    Picture("test-sheet.png", "/campaigns/mill-backlash"),
    Picture("diagnosis.png", "/twins/mill/diagnose"),
    Picture("evidence.png", "/models/virtual-cobot/1", "#evidence"),
    Picture("gates.png", "/models/virtual-cobot/1"),
)


def filled(home: Path) -> None:
    """Run the quick demo, and measure, fit and diagnose the virtual mill."""
    mill = home.parent / "mill"
    for words in (
        ("demo", "--quick"),
        ("simulate", "--machine", "mill", "--quick", "--out", str(mill)),
        ("ingest", str(mill)),
        ("machine", "add", "virtual-mill", "--type", "3-axis mill", "--tolerance", "G(b)=10"),
        ("twin", "fit", "mill-backlash", "--effects", "scale_mismatch,squareness", "--name", "mill"),
        ("twin", "diagnose", "mill"),
    ):
        print("dtwin", *words, flush=True)
        subprocess.run(
            [sys.executable, "-m", "dtwin", *words], env=_environment(home), stdout=subprocess.DEVNULL, check=True
        )


def photographed(home: Path, folder: Path, pictures: tuple[Picture, ...] = PICTURES) -> list[Path]:
    """Write a picture of each page of the workbench on a home, and return the files.

    Raises:
        ValueError: When a page is not drawn, or its picture is too large.
    """
    made = []
    with _workbench(home) as address, sync_playwright() as playwright:
        program = os.environ.get("CHROMIUM", "/usr/bin/chromium")
        browser = playwright.chromium.launch(executable_path=program, args=_FLAGS)
        page = browser.new_page(viewport={"width": _WIDTH, "height": _HEIGHT}, color_scheme="light", locale="en")
        page.set_default_timeout(_PATIENCE_MS)
        page.goto(address)
        page.wait_for_url("**/machines")
        for picture in pictures:
            file = folder / picture.file
            _photograph(page, address.partition("/?")[0] + picture.address, file, picture.top)
            if file.stat().st_size > 1000 * LARGEST_KB:
                raise ValueError(f"{file} has {file.stat().st_size / 1000:.0f} kB; {LARGEST_KB} at most")
            made.append(file)
        browser.close()
    return made


def _photograph(page: Page, address: str, file: Path, top: str) -> None:
    answer = page.goto(address)
    if answer is None or not answer.ok:
        raise ValueError(f"{address} answered {answer and answer.status}")
    page.wait_for_selector("body[data-drawn]")
    page.wait_for_function("!document.querySelector('[aria-busy]')")
    page.wait_for_load_state("networkidle")
    # The path of the home, and a footer, are nobody's business.
    page.add_style_tag(
        content="footer, .skip { display: none } * { animation: none !important; caret-color: transparent }"
    )
    page.locator(top).first.evaluate("part => window.scrollTo(0, part.getBoundingClientRect().top + scrollY - 70)")
    page.screenshot(path=file, animations="disabled")


@contextmanager
def _workbench(home: Path) -> Iterator[str]:
    process = subprocess.Popen(
        [sys.executable, "-m", "dtwin", "ui", "--no-browser"], env=_environment(home), stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        found = re.search(r"http://\S+", process.stdout.readline())
        if found is None:
            raise ValueError("the workbench did not start")
        yield found[0]
    finally:
        process.terminate()
        process.wait(30)


def _environment(home: Path) -> dict[str, str]:
    return os.environ | {"DTWIN_HOME": str(home), "DTWIN_MLFLOW": "now"}


def main() -> None:
    """Write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--home", type=Path, help="a home that is filled already")
    parser.add_argument("--out", type=Path, default=BESIDE, help="folder of the pictures; beside this file without")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        home = asked.home or Path(made) / "home"
        if asked.home is None:
            filled(home)
        for file in photographed(home.resolve(), asked.out):
            print(f"{file} {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
