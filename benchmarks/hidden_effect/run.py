"""The hidden-effect exam: what is missing in the twin of a machine that shares no formula with it?

Run: OMP_NUM_THREADS=1 python benchmarks/hidden_effect/run.py [--short] [--rows a,b] [--cases N]
     [--jobs 2] [--minutes M] [--out FILE] [--table-only | --again N]

One JSON line for each case is added to FILE; cases that are there are skipped, so that an
interrupted run goes on where it stopped. Each line carries a check sum of the modules of
``dtwin.physics`` that were loaded; cases that were marked with other code are put again. The seed
of a case is derived from its row and number. Cases are taken in rounds over all rows, so that a run
that is cut short has some of every row.

``answers.jsonl.gz`` beside this script holds the answers of the published table. ``--table-only --out``
with that file prints the table; ``--again N`` puts N cases of each row of it again and says which
answers are others now.
"""

from __future__ import annotations

import argparse
import ast
import gzip
import hashlib
import json
import math
import re
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from cases import ROWS, make_case
from controls import answers
from judge import answer
from table import table_text

SHORT_ROWS = ("null_plain", "single_one", "one_repeat")
SHORT_CASES = 1
SHORT_CONTROLS = 1
WITH_CONTROLS = 20
_ROUNDING = 1e-6
_WORDS = ("group", "title", "meaning", "formula", "looks_like", "separate_by", "remedy", "reference")
Key = tuple[str, int]


def _check_sum(kind: str) -> str:
    """Return what identifies the code that is examined: what the marking of a kind of test has loaded of it.

    Where a module lies, what it imports and exports, which of its names are private, how µm is spelt, what
    is said in comments, docstrings and the words of an effect, effects of other kinds of test, and which other
    kinds an effect serves, is not part of it.
    """
    loaded = [sys.modules[n] for n in sys.modules if n.startswith("dtwin.physics")]
    mine = [m for m in loaded if kind in getattr(getattr(m, "EFFECT", None), "kinds", (kind,))]
    digests = sorted(_code_of(Path(m.__file__)) for m in mine if m.__file__ is not None)
    return hashlib.sha256("".join(digests).encode()).hexdigest()[:12]


def _code_of(file: Path) -> str:
    tree = ast.parse(file.read_bytes())
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            node.body = [n for n in body if not _says_nothing(n)]
        if isinstance(node, ast.Call):
            words = _WORDS if isinstance(node.func, ast.Name) and node.func.id == "Effect" else ()
            node.keywords = [k for k in node.keywords if k.arg not in ("kinds", *words)]
    code = re.sub(r"'_+(?=[a-zA-Z])", "'", ast.dump(tree)).replace("µm", "um")
    return hashlib.sha256(code.encode()).hexdigest()


def _says_nothing(node: ast.stmt) -> bool:
    """Tell whether a statement is an import, a list of exports, a string, or the declaration of an effect's words."""
    text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    exports = isinstance(node, ast.Assign | ast.AnnAssign) and "__all__" in ast.unparse(node).split("=")[0]
    words = isinstance(node, ast.AnnAssign) and ast.unparse(node.target) in _WORDS
    return text or exports or words or isinstance(node, ast.Import | ast.ImportFrom)


CODE = {kind: _check_sum(kind) for kind in {row.kind for row in ROWS.values()}}


def main() -> None:
    given = _arguments()
    rows = [name for name in given.rows.split(",") if name] or list(ROWS)
    if given.short:
        rows = list(SHORT_ROWS)
    unknown = sorted(set(rows) - set(ROWS))
    if unknown:
        raise SystemExit(f"no such row: {', '.join(unknown)}; there are {', '.join(ROWS)}")
    most = given.cases or (SHORT_CASES if given.short else None)
    done = _done(given.out)
    if given.again:
        sys.exit(_again([r for r in done.values() if r["row"] in rows], given))
    if not given.table_only:
        _run(list(_wanted(rows, most, done)), given)
    records = [r for r in _done(given.out).values() if r["row"] in rows]
    codes = Counter(r["code"] for r in records)
    print("cases by check sum of dtwin/physics:", ", ".join(f"{c} {n}" for c, n in codes.items()))
    failed = [r for r in records if "failed" in r]
    print(table_text([r for r in records if "failed" not in r]))
    for record in failed:
        print(f"FAILED {record['row']} {record['case']}: {record['failed']}")
    sys.exit(1 if failed else 0)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--short", action="store_true", help="a case of three rows")
    parser.add_argument("--rows", default="", help="names with commas")
    parser.add_argument("--cases", type=int, default=0, help="at most so many cases of a row")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=0.0, help="begin no case after that")
    parser.add_argument("--out", type=Path, default=Path("hidden-effect-cases.jsonl"))
    parser.add_argument("--table-only", action="store_true")
    parser.add_argument("--again", type=int, default=0, help="put so many cases of each row again")
    given = parser.parse_args()
    if given.out.suffix == ".gz" and not (given.table_only or given.again):
        parser.error("a packed file is only read: with --table-only or --again")
    return given


def _done(path: Path) -> dict[Key, dict[str, Any]]:
    """Return the cases of earlier runs; a line that was cut off does not count."""
    out: dict[Key, dict[str, Any]] = {}
    if path.exists():
        packed = path.read_bytes()
        text = (gzip.decompress(packed) if path.suffix == ".gz" else packed).decode()
        for line in text.splitlines():
            try:
                record = json.loads(line)
            except json.JSONDecodeError:
                continue
            out[record["row"], record["case"]] = record
    return out


def _wanted(rows: list[str], most: int | None, done: dict[Key, Any]) -> Iterator[Key]:
    """Yield cases in rounds: the share of each row that is done grows alike."""
    counts = {name: min(ROWS[name].cases, most or ROWS[name].cases) for name in rows}
    every = [((n + 1) / min(counts[name], 200), n, name) for name in rows for n in range(counts[name])]
    for _, number, name in sorted(every, key=lambda e: e[0]):
        if done.get((name, number), {}).get("code") != CODE[ROWS[name].kind]:
            yield name, number


def _run(wanted: list[Key], given: argparse.Namespace) -> None:
    began = time.monotonic()
    limit_s = 60.0 * given.minutes or float("inf")
    with given.out.open("a") as out:
        for n, record in enumerate(_marked(wanted, given, began + limit_s)):
            out.write(json.dumps(record) + "\n")
            out.flush()
            spent = time.monotonic() - began
            said = record.get("verdict", "FAILED")
            mark = "right" if record.get("right") else "wrong"
            print(
                f"{n + 1}/{len(wanted)} {spent:6.0f} s  {record['row']} {record['case']}: {said} {mark}",
                file=sys.stderr,
            )


def _again(records: list[dict[str, Any]], given: argparse.Namespace) -> int:
    """Put some cases of each row again; return 1 when an answer is another one now.

    Processors round differently: numbers that differ by less than a millionth are the same.
    """
    before = {(r["row"], r["case"]): r for r in records}
    of_row: dict[str, list[Key]] = {}
    for key in sorted(before):
        of_row.setdefault(key[0], []).append(key)
    wanted = [
        keys[i]
        for keys in of_row.values()
        for i in sorted({int(i) for i in np.linspace(0, len(keys) - 1, given.again)})
    ]
    put = partial(_marked, wanted, given, float("inf"), with_controls=0)
    others, seconds = 0, []
    for n, record in enumerate(put(), start=1):
        old = before[record["row"], record["case"]]
        changed = {
            k: (old.get(k), v)
            for k, v in record.items()
            if k in old and k not in ("code", "seconds") and not _same(json.loads(json.dumps(v)), old.get(k))
        }
        others += bool(changed)
        seconds.append((old["seconds"], record.get("seconds", float("nan"))))
        print(f"{n}/{len(wanted)} {record['row']} {record['case']}", changed or "as before")
    then, now = ({r["code"] for r in records}, {CODE[ROWS[r["row"]].kind] for r in records})
    sums = " are the same with ".join(", ".join(sorted(codes)) for codes in (then, now))
    print(f"{len(wanted) - others} of {len(wanted)} answers of check sum {sums}")
    print("median time of these cases: {:.2f} s then, {:.2f} s now".format(*np.median(seconds, axis=0)))
    return int(others > 0)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=_ROUNDING, abs_tol=_ROUNDING) or (one != one and other != other)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_same(one[k], other[k]) for k in one)
    return bool(one == other)


def _marked(
    wanted: list[Key], given: argparse.Namespace, until: float, with_controls: int | None = None
) -> Iterator[dict[str, Any]]:
    usual = SHORT_CONTROLS if given.short else WITH_CONTROLS
    jobs = given.jobs
    put = partial(one, with_controls=usual if with_controls is None else with_controls)
    if jobs <= 1:
        for key in wanted:
            if time.monotonic() > until:
                return
            yield put(key)
        return
    with ProcessPoolExecutor(jobs) as pool:
        rest, under_way = iter(wanted), set[Future[dict[str, Any]]]()
        while True:
            if time.monotonic() < until:
                under_way |= {pool.submit(put, k) for k in islice(rest, jobs - len(under_way))}
            if not under_way:
                return
            ended, under_way = wait(under_way, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in ended)


def one(key: Key, with_controls: int = WITH_CONTROLS) -> dict[str, Any]:
    """Make, put and mark one case; what goes wrong is part of the result."""
    name, number = key
    record: dict[str, Any] = {"row": name, "case": number, "code": CODE[ROWS[name].kind]}
    try:
        case = make_case(ROWS[name], number)
        record |= {"runs": len(case.runs), "sizes": list(case.sizes), **answer(case)}
        if number < with_controls and name.startswith(("null", "single", "unknown_")):
            record["controls"] = answers(case)
    except Exception as error:
        traceback.print_exc()
        record["failed"] = f"{type(error).__name__}: {error}"
    return record


if __name__ == "__main__":
    main()
