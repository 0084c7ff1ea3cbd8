"""Say what a campaign shows: data quality, figures, what twins lack, whether the champion fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from prefect import flow

from dtwin.kinds.registry import kind_named
from dtwin.lifecycle.drift import DriftCheck
from dtwin.twins.on_campaign import TwinView
from flows import _artifacts, _plots, _tasks

WHAT_IT_IS = (
    "Quality gates, standard figures, error curves, the diagnosis of every twin that was fitted "
    "to the campaign, other twins of the machine against it, and the champion's error on runs it "
    "never saw."
)
_FIGURES = (
    ("circular deviation µm", "circular_deviation_um"),
    ("RMS µm", "rms_um"),
    ("centre a µm", "centre_a_um"),
    ("centre b µm", "centre_b_um"),
    ("mean feed mm/min", "feed_mm_min"),
)


@flow(name="diagnose", flow_run_name="diagnose {campaign}")
def diagnose_flow(campaign: str) -> dict[str, Any]:
    """Publish findings, figures and curves of a campaign, and judge the champion on it.

    Args:
        campaign: Campaign in the lake.
    """
    figures, curves = _tasks.campaign_figures(campaign)
    findings = publish_figures(campaign, figures, f"Data quality of {campaign}. {WHAT_IT_IS}")
    if curves:
        images = [_plots.markdown(name, _plots.polar(name, ways)) for name, ways in curves.items()]
        _artifacts.publish_markdown(
            f"curves-{campaign}",
            "\n\n".join(images),
            "Error over the path angle as the file counts it from its own start, first run of "
            "each condition, without its own centre and radius",
        )
    twins = _tasks.look_at_twins(figures["machine"], campaign)
    kind = kind_named(figures["kind"])
    judged = kind.offers("champion_error")
    check = _tasks.champion_drift(figures["machine"], campaign) if judged else None
    publish_twins(campaign, twins)
    publish_drift(check)
    return {
        "campaign": campaign,
        "runs": len(figures["runs"]),
        "errors": sum(f["severity"] == "error" for _, f in findings),
        "warnings": sum(f["severity"] == "warning" for _, f in findings),
        "twins": {view.name: view.headline for view in twins},
        "drift": check.as_dict() if check else None,
        "not_judged": "" if judged else kind.lacks("champion_error").message,
        "scope": WHAT_IT_IS,
    }


def publish_figures(campaign: str, figures: Mapping[str, Any], description: str) -> list[tuple[str, Mapping[str, Any]]]:
    """Leave findings and standard figures, and return the findings with their runs.

    Args:
        campaign: Name of the campaign or file.
        figures: As ``check_source`` or ``campaign_figures`` gives them.
        description: What to say of the findings.
    """
    findings = [("", f) for f in figures.get("findings", ())]
    findings += [(run["run"], f) for run in figures["runs"] for f in run["findings"]]
    _artifacts.publish_findings(campaign, findings, description)
    _artifacts.publish_table(
        f"figures-{campaign}",
        ("run", *(title for title, _ in _FIGURES)),
        [_row(run) for run in figures["runs"]],
        "Least-squares circle of every run, by the angles of its file",
    )
    return findings


def publish_twins(campaign: str, views: Sequence[TwinView]) -> None:
    """Leave what each twin says of a campaign.

    Args:
        campaign: Name of the campaign.
        views: One for each twin of the machine.
    """
    for view in views:
        done = "lacks" if view.diagnosed else "against these runs"
        text = f"## What twin {view.name} {done}\n\n{view.headline}\n\n```\n{view.text}\n```"
        _artifacts.publish_markdown(f"twin-{view.name}-{campaign}", text, f"Twin {view.name}, version {view.version}")


def publish_drift(check: DriftCheck | None) -> None:
    """Leave the diagnosis of a champion on a campaign.

    Args:
        check: None leaves nothing.
    """
    if check is None:
        return
    title = "The champion has drifted" if check.drifted else "The champion on new runs"
    lines = [f"## {title}", "", f"{check.reason[:1].upper()}{check.reason[1:]}."]
    if check.error is not None:
        outside = 100 * check.error.outside_box_share
        lines += ["", f"Outside its validity box at {outside:z.1f} % of the rows."]
    if check.drifted:
        lines += [
            "",
            "What to do: look at the machine first (play, mounting, tool, temperature); "
            "when it is sound, measure a training campaign and train again.",
        ]
    _artifacts.publish_markdown(f"diagnosis-{check.campaign}", "\n".join(lines), f"Champion {check.version}")


def _row(run: Mapping[str, Any]) -> list[str]:
    figures = run.get("by_file_indices") or {}
    return [run["run"], *(_number(figures.get(key)) for _, key in _FIGURES)]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{float(value):z.1f}"
