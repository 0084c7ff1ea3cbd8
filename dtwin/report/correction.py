"""A twin's correction as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.report.text import table


def correction_text(found: Mapping[str, Any]) -> str:
    """Return what is corrected, what is not and why, and what the gates say, of ``Correction.as_dict``."""
    grades = {g["label"]: g["grade"] for g in found["grades"]}
    terms = [
        (t["label"], "yes" if t["included"] else "no", grades.get(t["label"], "-"), t["how"]) for t in found["terms"]
    ]
    digits = 2 if max(p["rms_before_um"] for p in found["predicted"]) >= 10.0 else 3
    predicted = [
        (p["condition"], f"{p['rms_before_um']:z.{digits}f}", f"{p['rms_predicted_um']:z.{digits}f}")
        for p in found["predicted"]
    ]
    gates = [f"{'pass' if g['passed'] else 'FAIL'}  {g['gate']}: {g['reason']}" for g in found["gates"]]
    lines = [
        f"twin {found['twin']} version {found['twin_version']} ({found['verdict']}) is version "
        f"{found['version']} of {found['machine']}",
        table(("effect", "corrected", "grade", "how, or why not"), terms),
        "",
        table(("condition", "before, µm RMS", "predicted, µm RMS"), predicted),
        *([found["by_others"]["told"]] if found["by_others"] else []),
        "",
        *gates,
        *([f"left: {found['left']}"] if found["left"] else []),
    ]
    promote = f"dtwin promote {found['version']} --machine {found['machine']}"
    if found["trial_only"]:
        lines += ["for a trial only: " + "; ".join(found["objections"]), f"next: {promote} --trial"]
    elif found["virtual"]:
        lines.append(f"next: {promote}")
    else:
        lines.append(
            f"next: {promote} --trial, then measure with and without it; or, for a control "
            f"that dtwin does not serve: dtwin export {found['twin']} --as FORM --out FILE"
        )
    return "\n".join(lines)
