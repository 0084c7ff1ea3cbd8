"""MkDocs hook: the German words of effects and certificates, so that a search for one finds its page."""

from __future__ import annotations

import logging
import tomllib
from importlib.resources import files

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from dtwin.physics.effect import Effect
from dtwin.physics.library import Library
from dtwin.report.language import Language

_PATH = "reference/german.md"
_CERTIFICATE, _TWINS = (
    tomllib.loads(files("dtwin.report").joinpath(name).read_text("utf-8"))
    for name in ("german.toml", "german_twins.toml")
)

_PAGES = {
    "Ball bar, circular test": (
        "ingest-your-own",
        "Kreisformtest, Kreisformmessung, Kugelstab, DBB, Kreisformprüfgerät",
    ),
    "Laser, positioning test": (
        "positioning-table",
        "Laserinterferometer, Positioniergenauigkeit, Positionsunsicherheit, Positionierunsicherheit, Lagemessung, Linearachse",
    ),
    "Rotary axis": ("positioning-table", "Rundachse, Drehachse, Rotationsachse, Rundtisch, Schwenkachse"),
    "Spindle, run-out": ("rotation", "Spindel, Rundlauf, Planlauf, Unwucht"),
    "Robot, poses": ("robot-poses", "Roboter, Cobot, Posegenauigkeit, Lasertracker, Kinematik, Kalibrierung"),
    "Drift, heat": ("drift", "Temperaturgang, Wärmegang, thermische Drift, Verlagerung"),
    "Machine tool, its history": (
        "test-sheet",
        "Werkzeugmaschine, Fräsmaschine, Abnahme, Prüfmittelüberwachung, Verlauf",
    ),
    "Control, compensation": (
        "controls",
        "Steuerung, Kompensation, Losekompensation, Spindelsteigungsfehlerkompensation, Durchhangkompensation, Quadrantenfehlerkompensation",
    ),
    "What else you know": ("coming-from", "Umstieg, Begriffe, Renishaw, Kreisformtest der Steuerung"),
}
"""What is measured and corrected: page, and German words for it."""

_log = logging.getLogger("mkdocs.hooks.german")


def german_of(effect: Effect) -> str:
    """Return the German name of an effect, with what shops call it."""
    return ", ".join([Language("de").drawn(effect.title), *_TWINS["also"].get(effect.name, ())])


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the page of words."""
    files.append(File.generated(config, _PATH, content=_page()))
    return files


def _page() -> str:
    library = Library()
    for name in sorted(set(_TWINS["also"]) - set(library)):
        _log.warning("german_twins.toml has other words for what is no effect: %s", name)
    effects = [f"| [{library[n].title}](../effects/{n}.md) | {german_of(library[n])} |" for n in sorted(library)]
    phrases = [f"| {english} | {german} |" for english, german in _CERTIFICATE["phrases"].items()]
    head = "| English | Deutsch |\n| --- | --- |\n"
    return (
        "# German words\n\nWhat reports and certificates call things in German (`--language de`), from the files that "
        "translate them.\n\n## Effects\n\n"
        + head
        + "\n".join(effects)
        + "\n\n## Machines and tests\n\n"
        + head
        + "\n".join(f"| [{what}](../how-to/{page}.md) | {words} |" for what, (page, words) in _PAGES.items())
        + "\n\n## Test sheets\n\nFigures and words of [test sheets](../how-to/test-sheet.md) and certificates.\n\n"
        + head
        + "\n".join(phrases)
        + "\n"
    )
