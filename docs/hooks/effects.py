"""One page for each effect, made from the library, with its signature drawn."""

from __future__ import annotations

import numpy as np
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from dtwin.physics.effect import Effect
from dtwin.physics.library import Library, campaign_instances
from dtwin.physics.state import circular_state
from dtwin.schema import Direction, Plane, RunMeta

_ROBOT = {"type": "ur10e", "centre_mm": [-550.0, 0.0, 300.0], "tcp_mm": [0.0, 0.0, 158.3]}
_SIZE, _CIRCLE, _DRAWN = 300, 100, 28
_COLOURS = {"CCW": "#0072B2", "CW": "#D55E00"}


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
    parameters = "\n".join(f"| {p.name.replace('_', ' ')} | {p.unit} | {p.typical:g} |" for p in effect.parameters)
    shapes = "\n".join(f"| {s.name.replace('_', ' ')} | {s.unit} | searched, from {s.start:g} |" for s in effect.shapes)
    needs = f"\nNeeds the logged columns {', '.join(effect.needs)}.\n" if effect.needs else ""
    return f"""# {effect.title}

`{effect.name}`, one for each {effect.per.replace("_", " ")}; campaigns: {", ".join(effect.kinds)}

{effect.meaning}

{_signature(effect)}

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
    """Draw the error round the circle, counter-clockwise and clockwise."""
    if "circular" not in effect.kinds or effect.on_spread:
        return ""
    plane: Plane = "ZX" if effect.name == "gravity_sag" else "XY"
    axes = ["Z", "X"] if plane == "ZX" else ["X", "Y"]
    wanted = campaign_instances({effect.name: effect}, "circular", [plane], axes, _ROBOT)
    curves = {}
    angle = (np.arange(1440) + 0.5) * 2 * np.pi / 1440
    columns = {
        name: np.full(1440, 1.0)
        for name in (
            "temperature_c",
            "temperature_rise_c",
            "abbe_offset_mm",
            "time_h",
            "setup_first_um",
            "setup_second_um",
        )
    }
    for instance in wanted:
        for name in ("CCW", "CW"):
            direction: Direction = "CCW" if name == "CCW" else "CW"
            meta = RunMeta("r", plane=plane, direction=direction, radius_mm=100, feed_mm_min=3000)
            state = circular_state(meta, angle, feed_mm_s=50.0, columns=columns, geometry=_ROBOT)
            curves[name] = effect.columns(state, instance.axis, effect.start_shape)[:, 0]
        if any(np.ptp(c) > 0 or c.any() for c in curves.values()):
            return _svg(effect, instance.label, angle, curves)
    return ""


def _svg(effect: Effect, label: str, angle: np.ndarray, curves: dict[str, np.ndarray]) -> str:
    largest = max(float(np.abs(c).max()) for c in curves.values())
    middle = _SIZE / 2
    parts = [
        f'<svg viewBox="0 0 {_SIZE} {_SIZE}" width="{_SIZE}" role="img" '
        f'aria-label="error of {label} round the circle">',
        f'<circle cx="{middle}" cy="{middle}" r="{_CIRCLE}" fill="none" stroke="#999" stroke-dasharray="3 3"/>',
    ]
    for name, curve in curves.items():
        radius = _CIRCLE + _DRAWN * curve / largest
        x, y = middle + radius * np.cos(angle), middle - radius * np.sin(angle)
        path = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
        dash = ' stroke-dasharray="6 3"' if name == "CW" else ""
        parts.append(f'<polygon points="{path}" fill="none" stroke="{_COLOURS[name]}" stroke-width="1.6"{dash}/>')
    parts.append("</svg>")
    caption = (
        f"First parameter of {label} at R = 100 mm, F = 3000 mm/min: counter-clockwise blue, "
        "clockwise orange and dashed; dotted: the nominal circle."
    )
    return "".join(parts) + f"\n\n*{caption}*"
