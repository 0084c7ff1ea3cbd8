"""Make the example campaigns: ``python data/make_examples.py FOLDER``.

The virtual mill is measured as by ``dtwin simulate --machine mill --quick``. Of its files the three
columns are kept that any ball bar gives, and every third sample, so that the examples stay small.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from pathlib import Path

from dtwin.acquire.virtual_mill import simulate_mill

KEPT_COLUMNS = ("t_s", "angle_deg", "deviation_um")
KEEP_EVERY = 3
# Folder, fault of the mill, seed, run that is spoilt.
EXAMPLES = (
    ("hidden-effect", "backlash", 11, None),
    ("nothing-hidden", "none", 12, None),
    ("spoilt-run", "backlash", 13, "r017"),
)
# A chip between ball and magnetic cup from this angle on: the bar reads too long by so much.
CHIP_FROM_DEG, CHIP_TO_DEG, CHIP_UM = 200.0, 290.0, 12.0


def make_examples(folder: Path) -> None:
    """Write every example campaign below ``folder``."""
    for name, fault, seed, spoilt in EXAMPLES:
        with tempfile.TemporaryDirectory() as measured:
            simulate_mill(Path(measured), seed=seed, quick=True, hidden=fault)
            _shorten(Path(measured), folder / name, spoilt)


def _shorten(source: Path, target: Path, spoilt: str | None) -> None:
    target.mkdir(parents=True, exist_ok=True)
    for file in sorted(source.glob("*.csv")):
        with file.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))[::KEEP_EVERY]
        with (target / file.name).open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(KEPT_COLUMNS)
            for row in rows:
                if file.stem == spoilt:
                    _add_chip(row)
                writer.writerow([row[column] for column in KEPT_COLUMNS])
    campaign = (source / "campaign.toml").read_text(encoding="utf-8").splitlines()
    told = [f'name = "{target.name}"' if s.startswith("name = ") else s for s in campaign]
    # The name of the fault is for who wants to compare, not for the campaign.
    told = [line for line in told if not line.startswith("hidden = ")]
    (target / "campaign.toml").write_text("\n".join([*told, ""]), encoding="utf-8")
    (target / "truth.toml").write_bytes((source / "truth.toml").read_bytes())


def _add_chip(row: dict[str, str]) -> None:
    if CHIP_FROM_DEG <= float(row["angle_deg"]) % 360.0 <= CHIP_TO_DEG:
        row["deviation_um"] = f"{float(row['deviation_um']) + CHIP_UM:.4f}"


if __name__ == "__main__":
    make_examples(Path(sys.argv[1]))
