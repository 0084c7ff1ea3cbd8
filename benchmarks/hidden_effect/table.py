"""The table of the exam from the marked cases."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from controls import CONTROLS
from rows import PUBLISHED, ROWS, Row

Record = Mapping[str, Any]
OUTSIDE = "outside the library called unknown, or by a name that is right as well"


def wilson(hits: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """Return the 95 % interval of a share."""
    if n == 0:
        return 0.0, 1.0
    share, extra = hits / n, z * z / n
    middle = (share + extra / 2) / (1 + extra)
    half = z * math.sqrt(share * (1 - share) / n + extra / n / 4) / (1 + extra)
    return max(0.0, middle - half), min(1.0, middle + half)


def table_text(records: Sequence[Record]) -> str:
    """Return the whole table as Markdown."""
    by_row: dict[str, list[Record]] = defaultdict(list)
    for record in records:
        by_row[record["row"]].append(record)
    parts = ["## Figures that must be reached", _figures(by_row), "", "## Every row", _rows(by_row)]
    parts += ["", "## Nothing told", _untold(by_row)]
    published = by_row.get("published_from_nothing", [])
    if published:
        parts += ["", "## Published machines from nothing", _published(published)]
    parts += ["", "## By hidden effect (full design)", _by_effect(by_row)]
    parts += ["", "## Controls, on the same cases", _controls(by_row)]
    return "\n".join(parts) + "\n"


UNTOLD = {3: 0.98, 4: 0.98, 5: 0.98, 8: 0.97, 12: 0.92}
MOST_FALSE = 0.10


def _limits(row: Row) -> tuple[float, float] | None:
    """Return the share that must be named and how many false names may be; published and drawn machines have no limit."""
    if row.machine in ("published", "drawn"):
        return None
    if row.everyday:
        return 0.85, 0.20
    several = row.unknown or row.kind != "circular"
    return (0.90 if several else UNTOLD[row.how_many]), MOST_FALSE


def _untold(by_row: Mapping[str, list[Record]]) -> str:
    """Return what was found of many faults at once; the unit of replication is the machine."""
    lines = [
        "| row | faults named, in groups of at most three (everyday: four effects) | must reach | false names per machine | must stay "
        "| unresolved said | sizes covered (k = 2), named alone | in a group | held-out systematic RMS / floor | with a map | s | machines |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in ROWS.items():
        records = by_row.get(name, [])
        if row.right != "every":
            continue
        if not records:
            lines.append(f"| {name} | not run | | | | | | | | | | 0 ({row.cases}) |")
            continue
        lines.append(_of_many(name, row, records))
        if all("discover" in r for r in records):
            # What is held out is told by the first diagnosis; what is left, by the last one.
            rounds = [{"seconds": r["seconds"], "floor_um": r["floor_um"], **r["discover"]} for r in records]
            lines.append(_of_many(f"{name}, all rounds of `discover`", row, rounds))
    return "\n".join(lines)


def _of_many(name: str, row: Row, records: Sequence[Record]) -> str:
    named, of = sum(r["named"] for r in records), sum(r["of"] for r in records)
    limits = _limits(row)
    false = sum(r["false"] for r in records) / len(records)
    alone, grouped = _covered(records)
    held, mapped = (_over_floor(records, key) for key in ("held_out_um", "held_out_map_um"))
    return (
        f"| {name} | {named}/{of} = {named / of:.3f} "
        f"| {f'{limits[0]:.2f} {_said(named / of >= limits[0])}' if limits else '-'} | {false:.2f} "
        f"| {f'{limits[1]:.2f} {_said(false <= limits[1])}' if limits else '-'} "
        f"| {sum(r['unresolved'] for r in records)}/{len(records)} "
        f"| {sum(alone)}/{len(alone)} | {sum(grouped)}/{len(grouped)} | {held} | {mapped} "
        f"| {np.median([r['seconds'] for r in records]):.1f} | {len(records)} ({row.cases}) |"
    )


def _over_floor(records: Sequence[Record], key: str) -> str:
    """Return the median over the machines of what is left, in noise floors."""
    left = [r[key] / r["floor_um"] for r in records if key in r]
    return f"{np.median(left):.2f}" if left else "-"


def _covered(records: Sequence[Record]) -> tuple[list[bool], list[bool]]:
    """Return whether each interval holds the truth: of effects named alone, and of the first of a group, as if it were alone."""
    alone: list[bool] = []
    grouped: list[bool] = []
    for record in records:
        single = {group[0] for group in record["groups"] if len(group) == 1}
        for name, truth, value, expanded in record["covered"]:
            label = " ".join(part for part in name.split("|")[:2] if part)
            (alone if label in single else grouped).append(abs(value - truth) <= expanded)
    return alone, grouped


def _published(records: Sequence[Record]) -> str:
    """Return machine by machine what was named, what was missed and what is false."""
    lines = ["| machine | spike constant in | named | missed | false |", "|---|---|---|---|---|"]
    for record in sorted(records, key=lambda r: int(r["case"])):
        name, law = PUBLISHED[record["case"]]
        false = "; ".join(" or ".join(group) for group in record["false_groups"])
        lines.append(
            f"| {name} | {law} | {record['named']}/{record['of']} "
            f"| {', '.join(record['missed']) or '-'} | {false or '-'} |"
        )
    return "\n".join(lines)


def _share(records: Sequence[Record], what: str) -> tuple[int, int]:
    return sum(bool(r[what]) for r in records), len(records)


def _pooled(by_row: Mapping[str, list[Record]], *names: str) -> list[Record]:
    return [r for name in names for r in by_row.get(name, [])]


def _figures(by_row: Mapping[str, list[Record]]) -> str:
    lines = ["| figure | must reach | reached | cases | reached? |", "|---|---|---|---|---|"]
    nulls = [n for n in by_row if ROWS[n].right == "nothing" and ROWS[n].kind == "circular"]
    if nulls:
        worst = max(nulls, key=lambda n: 1 - _ratio(by_row[n]))
        wrong, n = len(by_row[worst]) - _share(by_row[worst], "right")[0], len(by_row[worst])
        low, high = wilson(wrong, n)
        lines.append(
            f"| false alarm, worst noise row ({worst}) | upper bound <= 8 % | "
            f"{wrong / n:.1%} ({low:.1%} to {high:.1%}) | {n} | {_said(high <= 0.08)} |"
        )
    shares = [
        ("truth in the group, single, k = 1/2", ("single_half",), 0.95),
        ("truth in the group, single, k = 1/4", ("single_quarter",), 0.90),
        (OUTSIDE, tuple(n for n in by_row if n.startswith("unknown_") and ROWS[n].right != "lagging"), 0.95),
        ("growth that lags told as growth of its axis, or unknown", ("unknown_hysteretic_heat",), 0.95),
        ("both of a pair found, k = 1", ("pair_one",), 0.95),
        ("thermal growth named with a cool-down, k = 1", ("heat_cool_down",), 0.90),
        ("lateral play named, k = 1/2", ("lateral_play_half",), 0.95),
    ]
    for label, names, limit in shares:
        lines.append(_share_line(label, _pooled(by_row, *names), limit))
    lines.append(_channel_line(by_row.get("unknown_coolant", [])))
    lines += _along(by_row)
    lines += _beside(by_row.get("pair_one", []))
    single = _pooled(by_row, "single_half", "single_quarter")
    if single:
        wrong = _share(single, "wrong_name")[0]
        share = wrong / len(single)
        lines.append(
            f"| wrong name though the truth is in the library | <= 2 % | {share:.1%} "
            f"{_interval(wrong, len(single))} | {len(single)} | {_said(share <= 0.02)} |"
        )
        sizes = [len(r["group"]) for r in single if r["group"]]
        if sizes:
            lines.append(
                f"| mean size of the group | <= 1.5 | {np.mean(sizes):.2f} | {len(sizes)} "
                f"| {_said(np.mean(sizes) <= 1.5)} |"
            )
    lines += _held_out(by_row) + _coverage(by_row) + _times(by_row)
    return "\n".join(lines)


def _along(by_row: Mapping[str, list[Record]]) -> list[str]:
    """Return the figures of positioning tests and of tones, in which nothing is told."""
    lines = []
    for kind, words in (("linear", "axis"), ("sinusoidal", "tones")):
        rows = [row for row in ROWS.values() if row.kind == kind]
        null = _pooled(by_row, *(r.name for r in rows if r.right == "nothing"))
        if null:
            wrong = len(null) - _share(null, "right")[0]
            share = wrong / len(null)
            lines.append(
                f"| {words}: false alarm | <= 5 % | {share:.1%} {_interval(wrong, len(null))} "
                f"| {len(null)} | {_said(share <= 0.05)} |"
            )
        for right, said in (
            ("name", "one fault named"),
            ("unknown", "outside the library called unknown"),
            ("channel", "logged channel named"),
        ):
            names = tuple(r.name for r in rows if r.right == right)
            lines.append(_share_line(f"{words}: {said}", _pooled(by_row, *names), 0.90))
    return lines


def _ratio(records: Sequence[Record]) -> float:
    hits, n = _share(records, "right")
    return hits / max(n, 1)


def _said(reached: bool) -> str:
    return "yes" if reached else "**no**"


def _interval(hits: int, n: int) -> str:
    low, high = wilson(hits, n)
    return f"({low:.1%} to {high:.1%})"


def _beside(pairs: Sequence[Record]) -> list[str]:
    rungs = [not set(group) & set(r["truth"]) for r in pairs for group in r["rungs"]]
    if not rungs:
        return []
    share = sum(rungs) / len(rungs)
    return [
        f"| rungs of these pairs that name nothing hidden | - | {share:.1%} "
        f"{_interval(sum(rungs), len(rungs))} | {len(rungs)} rungs of {len(pairs)} cases | |"
    ]


def _share_line(label: str, records: Sequence[Record], limit: float) -> str:
    if not records:
        return f"| {label} | >= {limit:.2f} | not run | 0 | - |"
    hits, n = _share(records, "right")
    if label == OUTSIDE:
        # Whether the logged channel behind it was named, too, is a line of its own.
        hits = sum(r["right"] or r["verdict"] == "unknown_effect" for r in records)
    return f"| {label} | >= {limit:.2f} | {hits / n:.3f} {_interval(hits, n)} | {n} | {_said(hits / n >= limit)} |"


def _channel_line(records: Sequence[Record]) -> str:
    hits, n = _share(records, "right")
    return (
        f"| logged channel behind the unknown named (unknown_coolant) | - | {hits}/{n} {_interval(hits, n)} | {n} | |"
    )


def _held_out(by_row: Mapping[str, list[Record]]) -> list[str]:
    pairs = [r["held_out"] for rs in by_row.values() for r in rs if r.get("held_out")]
    if not pairs:
        return []
    before, after = np.sqrt((np.array(pairs) ** 2).mean(axis=0))
    return [
        f"| systematic RMS on held-out conditions, after / before, k >= 1 | <= 0.3 | "
        f"{after / before:.2f} | {len(pairs)} | {_said(after <= 0.3 * before)} |"
    ]


def _coverage(by_row: Mapping[str, list[Record]]) -> list[str]:
    cases = [r for rs in by_row.values() for r in rs if r.get("coverage")]
    inside = [abs(v - t) <= u for r in cases for _, t, v, u in r["coverage"]]
    if not inside:
        return []
    share = float(np.mean(inside))
    return [
        f"| stated uncertainty covers the truth | 93 to 97 % | {share:.1%} "
        f"{_interval(sum(inside), len(inside))} | {len(inside)} parameters of {len(cases)} cases "
        f"| {_said(0.93 <= share <= 0.97)} |"
    ]


def _times(by_row: Mapping[str, list[Record]]) -> list[str]:
    spent = [r["seconds"] for rs in by_row.values() for r in rs if r.get("runs") == 36]
    if not spent:
        return []
    return [
        f"| time of one diagnosis of 36 runs, median | <= 2 s | {np.median(spent):.2f} s "
        f"(90 %: {np.quantile(spent, 0.9):.2f} s) | {len(spent)} | {_said(np.median(spent) <= 2)} |"
    ]


def _rows(by_row: Mapping[str, list[Record]]) -> str:
    lines = [
        "| row | design | k | right answer | right | 95 % | cases (full table) | wrong name | median s | answers |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in ROWS.items():
        records = by_row.get(name, [])
        if not records:
            lines.append(f"| {name} | {row.design} | {row.k:g} | {row.right} | not run | | 0 ({row.cases}) | | | |")
            continue
        hits, n = _share(records, "right")
        wrong = _share(records, "wrong_name")[0]
        spent = np.median([r["seconds"] for r in records])
        said = ", ".join(f"{v} {c}" for v, c in Counter(r["verdict"] for r in records).most_common())
        lines.append(
            f"| {name} | {row.design} | {row.k:g} | {row.right} | {hits / n:.2f} | "
            f"{_interval(hits, n)} | {n} ({row.cases}) | {wrong / n:.2f} | {spent:.1f} | {said} |"
        )
    return "\n".join(lines)


def _by_effect(by_row: Mapping[str, list[Record]]) -> str:
    lines = ["| effect | k = 1/4 | k = 1/2 | k = 1 | k = 2 | most frequent other answer |", "|---|---|---|---|---|---|"]
    rows = ("single_quarter", "single_half", "single_one", "single_two")
    seen = _pooled(by_row, *rows)
    for effect in sorted({r["truth"][0].split()[0] for r in seen}):
        mine = [[r for r in by_row.get(n, []) if r["truth"][0].split()[0] == effect] for n in rows]
        cells = [f"{_share(rs, 'right')[0]}/{len(rs)}" if rs else "-" for rs in mine]
        wrong = Counter(_short(r) for rs in mine for r in rs if not r["right"])
        often = ", ".join(f"{a} {c}" for a, c in wrong.most_common(2))
        lines.append(f"| {effect} | {' | '.join(cells)} | {often} |")
    return "\n".join(lines)


def _short(record: Record) -> str:
    if record["group"]:
        return str(record["group"][0])
    return str(record["verdict"]) + (f" ({record['closest']})" if record["closest"] else "")


def _controls(by_row: Mapping[str, list[Record]]) -> str:
    nulls = [r for n, rs in by_row.items() if n.startswith("null") for r in rs if r.get("controls")]
    single = [r for n in ("single_half", "single_quarter") for r in by_row.get(n, []) if r.get("controls")]
    foreign = [r for n, rs in by_row.items() if n.startswith("unknown_") for r in rs if r.get("controls")]
    lines = [
        f"| selector | names something when nothing is hidden (n = {len(nulls)}) | truth among its names, "
        f"k <= 1/2 (n = {len(single)}) | names | and nothing else | unknown called unknown (n = {len(foreign)}) |",
        "|---|---|---|---|---|---|",
    ]
    for name in ("dtwin", *CONTROLS):
        lines.append(_control_line(name, nulls, single, foreign))
    return "\n".join(lines)


def _names(record: Record, selector: str) -> list[str]:
    if selector != "dtwin":
        return list(record["controls"][selector])
    return list(record["group"]) or (["?"] if record["verdict"] == "unknown_effect" else [])


def _control_line(name: str, nulls: Sequence[Record], single: Sequence[Record], foreign: Sequence[Record]) -> str:
    alarms = [bool(_names(r, name)) for r in nulls]
    hits = [r["truth"][0] in _names(r, name) for r in single]
    alone = [_names(r, name) == [r["truth"][0]] for r in single]
    sizes = [len(_names(r, name)) for r in single]
    unknown = [_names(r, name) == ["?"] for r in foreign]

    def mean(values: Sequence[float], form: str = "{:.2f}") -> str:
        return form.format(float(np.mean(values))) if len(values) else "-"

    return f"| {name} | {mean(alarms)} | {mean(hits)} | {mean(sizes, '{:.1f}')} | {mean(alone)} | {mean(unknown)} |"
