"""Read vendor XML that is slightly broken, without trusting it."""

from __future__ import annotations

import math
import re
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from dtwin.errors import InputError

_MAX_BYTES = 32 * 1024 * 1024
_MAX_ELEMENTS = 20_000
_MAX_DEPTH = 40
_MAX_TAG_CHARS = 4_000

# <AVERAGING_ENABLED="True" /> : a value without an attribute name.
_NAMELESS_VALUE = re.compile(rb"<([A-Za-z_][\w.-]*)=(\"[^\"<>]*\")")
_BARE_AMPERSAND = re.compile(rb"&(?!#?\w{1,10};)")
# A name may begin with any letter, of other alphabets, too.
_TAG = re.compile(rb"<(/?)[^\s<>!?/][^<>]*?(/?)>")


def read_bounded(path: Path, max_bytes: int = _MAX_BYTES) -> bytes:
    """Return the bytes of a file, refusing what is empty, absent or absurdly large.

    ``max_bytes``: largest size that is still read.

    Raises ``InputError`` when the file cannot be read, is empty, or exceeds ``max_bytes``.
    """
    require_bounded(path, max_bytes)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from error
    if not data.strip():
        raise InputError("the file is empty", code="file.empty", where=str(path))
    return data


def require_bounded(path: Path, max_bytes: int) -> None:
    """Refuse what is no plain file, empty or absurdly large; raises as :func:`read_bounded`."""
    try:
        if not path.is_file():
            what = "a folder is no file" if path.is_dir() else "no such file"
            raise InputError(what, code="file.missing", where=str(path), hint="check the path")
        size = path.stat().st_size
    except OSError as error:
        raise _unreadable(path, error) from error
    if size > max_bytes:
        raise InputError(
            "the file is too large for its type",
            code="file.too_large",
            where=str(path),
            got=f"{size / 1e6:z.1f} MB",
            allowed=f"up to {max_bytes / 1e6:z.0f} MB",
        )
    if not size:
        raise InputError("the file is empty", code="file.empty", where=str(path))


def _unreadable(path: Path, error: OSError) -> InputError:
    return InputError("the file cannot be read", code="file.unreadable", where=str(path), got=str(error))


def parse_vendor_xml(data: bytes, where: str) -> Element:
    """Parse XML tolerantly of known vendor slips, and safely.

    Entities and document types are refused, and so are absurd depth and element counts.
    Two slips are mended: a value without an attribute name, and a bare ampersand.
    """
    if b"\x00" in data[:4096] and data[:2] not in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError("not an XML file", code="xml.binary", where=where)
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        data = _decode_utf16(data, where)
    _refuse_absurd_structure(data, where)
    # Each slip that is mended costs a hundred times its size; what has more of them stays broken.
    mended = _NAMELESS_VALUE.sub(rb"<\1 VALUE=\2", data, count=_MAX_ELEMENTS)
    mended = _BARE_AMPERSAND.sub(b"&amp;", mended, count=_MAX_ELEMENTS)
    try:
        root: Element = fromstring(mended, forbid_dtd=True)
    except DefusedXmlException as error:
        raise InputError(
            "a document type or entities are declared, which no such file needs",
            code="xml.hostile",
            where=where,
            got=type(error).__name__,
            hint="do not open files of unknown origin; export the test again",
        ) from error
    except (ParseError, ValueError, LookupError) as error:
        raise InputError(
            "the XML is broken or cut short",
            code="xml.malformed",
            where=where,
            got=str(error)[:200],
            hint="export the test again from the vendor's software",
        ) from error
    return root


def _decode_utf16(data: bytes, where: str) -> bytes:
    try:
        text = data.decode("utf-16")
    except UnicodeDecodeError as error:
        raise InputError("the text is not valid UTF-16", code="xml.encoding", where=where) from error
    return re.sub(r"^<\?xml[^>]*\?>", "", text.lstrip("\ufeff")).encode("utf-8")


def _refuse_absurd_structure(data: bytes, where: str) -> None:
    """Count tags before any parser builds a tree of them."""
    depth = deepest = 0
    for count, tag in enumerate(_TAG.finditer(data), start=1):
        if tag.group(1):
            depth -= 1
        elif not tag.group(2):
            depth += 1
            deepest = max(deepest, depth)
        if count > _MAX_ELEMENTS or deepest > _MAX_DEPTH or tag.end() - tag.start() > _MAX_TAG_CHARS:
            raise InputError(
                "the structure is absurd for such a file",
                code="xml.absurd",
                where=where,
                got=f"{count} tags, {deepest} levels, a tag of {tag.end() - tag.start()} characters",
                allowed=f"{_MAX_ELEMENTS} tags, {_MAX_DEPTH} levels, {_MAX_TAG_CHARS} characters a tag",
            )


def child_text(element: Element, tag: str) -> str:
    """Return the text of a child, empty when there is none."""
    return (element.findtext(tag) or "").strip()


def number_or_none(text: str) -> float | None:
    """Return a finite number, None when the text is none; ``1_000`` is one to Python alone."""
    try:
        value = math.nan if "_" in text else float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
