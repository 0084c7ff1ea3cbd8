"""A table of measurements that lies alone: what must be told besides, and its campaign of one run."""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from dtwin.acquire._tabular import kind_of_table, read_columns
from dtwin.acquire.campaign_folder import RUN_KEYS, CampaignFolder, campaign_from, entry_from
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.schema import DEVICE

_EXAMPLE = {"plane": "XY", "radius_mm": "150", "feed_mm_min": "2000", "axis": "X"}


def open_table(path: Path, told: Mapping[str, Any], made_of: Path | None = None) -> CampaignFolder:
    """Return a campaign of one run: a table that lies alone, and what is told of it.

    ``path``: ``.csv`` or ``.parquet``.
    ``made_of``: the file that the user knows, where the table was made of it.
    ``told``: settings of a run as in ``campaign.toml``, besides ``campaign``, ``kind``, ``machine``, ``axis``, ``instrument`` and ``screw_pitch_mm``.
    Direction and campaign may be left away: the angle runs one way, the file has a name.
    """
    kind = str(told.get("kind") or kind_of_table(path))
    told = {**kind_named(kind).told_above(path), **{name: value for name, value in told.items() if value is not None}}
    needed = kind_named(kind).stated
    missing = [name for name in needed or () if told.get(name) is None]
    if needed is None or missing:
        examples = {**_EXAMPLE, **kind_named(kind).examples}
        raise InputError(
            f"a table of a {kind} test does not say under which conditions it was measured",
            code="ingest.condition",
            where=str(made_of or path),
            got=", ".join(sorted(k for k, v in told.items() if v is not None)) or "the file alone",
            allowed="a folder with a file for each run" if needed is None else "with " + ", ".join(needed),
            hint=f'name it in a campaign.toml with kind = "{kind}": docs/how-to/ingest-your-own.md'
            if needed is None
            else (
                f"dtwin import {quote(str(made_of))} --out FOLDER " if made_of else f"dtwin ingest {quote(str(path))} "
            )
            + (f"--kind {kind} " if told.get("kind") else "")
            + " ".join(f"--{name.split('_')[0]} {examples[name]}" for name in needed)
            + " --machine NAME",
        )
    round_ = kind_named(kind).goes_round
    foreign = ("axis", "screw_pitch_mm") if round_ else ("plane", "radius_mm", "direction")
    stray = [name for name in foreign if told.get(name) is not None]
    if told.get("instrument") is not None and "condition.instrument" not in kind_named(kind).read_with:
        stray.append("instrument")
    if stray:
        raise InputError(
            f"the table is taken for one of a {kind} test, which has no {' and no '.join(stray)}",
            code="ingest.kind",
            where=str(path),
            got=", ".join(f"{name} {told[name]}" for name in stray),
            allowed=f"a {kind} test without them" + ("" if round_ else ", or a table of a circle"),
            hint="leave them away; another test has other heads"
            if round_
            else "columns that belong to no circle, such as temperatures beside coordinates, may have to be left away",
        )
    run = {n: v for n, v in told.items() if v is not None and n in RUN_KEYS}
    if kind_named(kind).goes_round and "direction" not in run and kind_named(kind).reader_of(path) is None:
        angle = read_columns(path, kind)[0]["angle_deg"]
        # Of most steps, not of the ends: an angle that wraps ends where it began.
        run["direction"] = "CW" if angle.size > 1 and np.median(np.diff(angle)) < 0.0 else "CCW"
    if condition := {name: told[name] for name in ("axis", "instrument") if told.get(name) is not None}:
        run["condition"] = condition
    name = told.get("campaign") or safe_name(path.stem)
    pitch_mm = told.get("screw_pitch_mm")
    geometry = {} if pitch_mm is None else {"screw_pitch_mm": pitch_mm}
    head = {"name": name, "machine": told.get("machine") or "unknown", "kind": kind, "machine_geometry": geometry}
    entry = entry_from({"id": safe_name(path.stem), "file": path.name, **run}, 1, path)
    return CampaignFolder(campaign_from(head, path), (entry,))


_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"})


def safe_name(text: str) -> str:
    """Return a text, or what a file is called, as a name: what is not allowed in one becomes a hyphen, and CON is table-con.

    Letters of other alphabets are told by a hash: two machines with names of them are two.
    """
    # Of a file that was packed: kreis.csv.gz.
    text = unicodedata.normalize("NFC", re.sub(r"\.(csv|tsv|txt|dat)$", "", text, flags=re.I))
    plain = unicodedata.normalize("NFKD", text.translate(_UMLAUTS))
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", "".join(c for c in plain if not unicodedata.combining(c)))
    name = re.sub(r"\.{2,}", ".", name.strip("-._")[:80].lower()) or "unnamed"
    name = f"table-{name}" if DEVICE.fullmatch(name) else name
    foreign = any(c.isalnum() and not c.isascii() for c in plain)
    return f"{name}-{hashlib.sha256(text.encode(errors='replace')).hexdigest()[:6]}" if foreign else name
