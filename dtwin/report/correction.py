"""A twin's correction as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.report.text import table


def correction_text(correction: Mapping[str, Any]) -> str:
    """Return what is corrected, what is not and why, and what the gates say, of ``Correction.as_dict``."""
    grades = {g["label"]: g["grade"] for g in correction["grades"]}
    terms = [
        (t["label"], "yes" if t["included"] else "no", grades.get(t["label"], "-"), t["how"])
        for t in correction["terms"]
    ]
    digits = 2 if max(p["rms_before_um"] for p in correction["predicted"]) >= 10.0 else 3
    predicted = [
        (p["condition"], f"{p['rms_before_um']:z.{digits}f}", f"{p['rms_predicted_um']:z.{digits}f}")
        for p in correction["predicted"]
    ]
    gates = [f"{'pass' if g['passed'] else 'FAIL'}  {g['gate']}: {g['reason']}" for g in correction["gates"]]
    lines = [
        f"twin {correction['twin']} version {correction['twin_version']} ({correction['verdict']}) is version "
        f"{correction['version']} of {correction['machine']}",
        table(("effect", "corrected", "grade", "how, or why not"), terms),
        "",
        table(("condition", "before, µm RMS", "predicted, µm RMS"), predicted),
        *([correction["by_others"]["told"]] if correction["by_others"] else []),
        "",
        *gates,
        *([f"left: {correction['left']}"] if correction["left"] else []),
    ]
    promote = f"dtwin promote {correction['version']} --machine {correction['machine']}"
    if correction["trial_only"]:
        lines += ["for a trial only: " + "; ".join(correction["objections"]), f"next: {promote} --trial"]
    elif correction["virtual"]:
        lines.append(f"next: {promote}")
    else:
        lines.append(
            f"next: {promote} --trial, then measure with and without it; or, for a control "
            f"that dtwin does not serve: dtwin export {correction['twin']} --as FORM --out FILE"
        )
    return "\n".join(lines)
