"""One page for each effect, made from the library, with its signature drawn."""

from __future__ import annotations

from german import german_of
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from dtwin.physics.effect import Effect
from dtwin.physics.library import Library
from dtwin.report.signatures import signature_caption, signature_svg
from dtwin.units import shown_parameter, shown_unit


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the pages into the navigation."""
    library = Library()
    pages = [{library[name].title: f"effects/{name}.md"} for name in sorted(library)]
    config.nav.append({"Effects": ["effects/index.md", *pages]})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages."""
    library = Library()
    for name in sorted(library):
        page = _page(library[name], library)
        files.append(File.generated(config, f"effects/{name}.md", content=page))
    files.append(File.generated(config, "effects/index.md", content=_index(library)))
    return files


def _index(library: Library) -> str:
    rows = [
        f"| [{e.title}]({e.name}.md) | `{e.name}` | {e.looks_like} | {_law(e)} |"
        for e in (library[name] for name in sorted(library))
    ]
    head = "| effect | name | what the plot shows | law |\n| --- | --- | --- | --- |\n"
    return (
        "# Effects\n\nEvery physical cause that `dtwin twin diagnose` knows. A law says how the "
        "amplitude grows with feed F and radius R, and whether it changes sign with the direction "
        "of motion. Your own effect is [one Python file](../how-to/add-an-effect.md).\n\n"
        + head
        + "\n".join(rows)
        + "\n"
    )


def _page(effect: Effect, library: Library) -> str:
    confused = ", ".join(f"[{library[c].title}]({c}.md)" for c in effect.confusables) or "nothing"
    parameters = "\n".join(
        f"| {shown_parameter(p.name)} | {shown_unit(p.unit)} | {p.typical:g} |" for p in effect.parameters
    )
    shapes = "\n".join(
        f"| {s.name.replace('_', ' ')} | {shown_unit(s.unit)} | searched, from {s.start:g} |" for s in effect.shapes
    )
    needs = f"\nNeeds the logged columns {', '.join(effect.needs)}.\n" if effect.needs else ""
    return f"""# {effect.title}

`{effect.name}`, one for each {effect.per.replace("_", " ")}; campaigns: {", ".join(effect.kinds)}

{effect.meaning}

{_signature(effect)}

**In German.** {german_of(effect)}

**What the plot shows.** {effect.looks_like}

**Formula.** `{effect.formula}`

**Law.** {_law(effect)}
{needs}
| parameter | unit | typical |
| --- | --- | --- |
{parameters}
{shapes}

**Confused with.** {confused}

**Told apart by.** {effect.separate_by}

**Remedy.** {effect.remedy}

**Correction by offsets.** {effect.correctable or "Not possible."}

**Reference.** {effect.reference}
"""


def _law(effect: Effect) -> str:
    law = effect.law
    feed = f"F^{law.feed:g}" if law.feed is not None else "no power law of F"
    radius = f"R^{law.radius:g}" if law.radius is not None else "no power law of R"
    return f"{feed}, {radius}, {law.direction} in direction"


def _signature(effect: Effect) -> str:
    """Draw the error round the circle, or along an axis, with what is drawn."""
    picture = signature_svg(effect)
    return f"{picture}\n\n*{signature_caption(effect)}*" if picture else ""
