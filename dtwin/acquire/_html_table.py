"""The one plain table of a page in HTML, as rows of text."""

from __future__ import annotations

from contextlib import suppress
from html.parser import HTMLParser

_NOT_SHOWN = ("script", "style", "title")
_MOST_SPANNED = 32
# Characters: what is longer is no cell of a table of readings.
_LONGEST = 1000


class _Page(HTMLParser):
    """Lines of a page: rows of the table, and text outside it as rows of one cell; ``doubt``: cells are hidden, span rows, or a great many columns."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[list[str]] = []
        self.tables = self.spanned = 0
        self.inside = ""
        self.doubt = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        told = {name: (value or "").replace(" ", "").lower() for name, value in attrs}
        self.tables += tag == "table"
        self.doubt |= told.get("rowspan", "1") != "1" or "hidden" in told or "display:none" in told.get("style", "")
        if tag in (*_NOT_SHOWN, "td", "th"):
            self.inside = tag
        if tag == "tr":
            self.lines.append([])
        elif tag in ("td", "th") and self.lines:
            span = told.get("colspan", "1")
            self.spanned = max(int(span), 1) if span.isdecimal() and len(span) < 5 else 1
            self.doubt |= self.spanned > _MOST_SPANNED
            self.lines[-1] += [""] * min(self.spanned, _MOST_SPANNED)

    def handle_endtag(self, tag: str) -> None:
        self.inside = "" if tag == self.inside else self.inside

    def handle_data(self, data: str) -> None:
        text = " ".join(data.split())
        if self.inside in ("td", "th") and self.lines and self.lines[-1]:
            at = -min(self.spanned, _MOST_SPANNED)
            self.lines[-1][at] = f"{self.lines[-1][at]} {text}".strip()[:_LONGEST]
        elif text and self.inside not in _NOT_SHOWN:
            self.lines.append([text])


def table_of_page(page: str) -> list[list[str]]:
    """Return the rows of the table of a page, text around it as rows of one cell; empty of a page without one, or with several, or in doubt."""
    parser = _Page()
    # Of a file in MIME the text is encoded; what the parser cannot part is an assertion of it.
    with suppress(AssertionError):
        parser.feed(page if page.lstrip()[:4].lower() != "mime" else "")
    return [] if parser.tables != 1 or parser.doubt else [line for line in parser.lines if any(line)]
