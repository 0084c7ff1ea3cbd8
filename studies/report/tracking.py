"""The source thesis's tracking chain as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.report.text import table
from dtwin.units import shown_number


def tracking_text(found: Mapping[str, Any]) -> str:
    """Return published figures, what was reproduced, and what does not follow.

    ``found``: ``Chain.as_dict``.
    """
    return "\n\n".join([_published(found), _reproduced(found), _does_not_follow(found)])


def _published(found: Mapping[str, Any]) -> str:
    told = found["published"]
    feeds = [f["feed_mm_min"] for f in found["feeds"]]
    rows = [
        (
            f"{feed:g}",
            *(f"{told[k][i]:g}" for k in ("ball_bar", "encoder", "accelerometer")),
            f"{told['reduction_pct'][i]:g} %",
        )
        for i, feed in enumerate(feeds)
    ]
    head = ("feed, mm/min", "ball bar, µm", "encoder, µm", "with accelerometer, µm", "reduction")
    return "\n".join(
        [
            "what the thesis reports (table 4-3: UR10e, XY, R100, 3 repeats, CCW and CW)",
            table(head, rows),
            f"mean of the five per cents: {told['mean_of_per_cents']:z.1f} % ± "
            f"{told['half_width_pct']:z.0f} (95 %, the feed as unit); reduction of the summed gap: "
            f"{told['per_cent_of_sums']:z.1f} %; spread of repeats: not published",
        ]
    )


def _reproduced(found: Mapping[str, Any]) -> str:
    rows = [
        (
            f"{f['feed_mm_min']:g}",
            str(f["runs"]),
            *(f"{f[k + '_um']:z.1f} ± {f[k + '_floor_um']:z.1f}" for k in ("ball_bar", "encoder", "accelerometer")),
            f"{f['reduction_pct']:z.1f} %",
        )
        for f in found["feeds"]
    ]
    head = ("feed, mm/min", "runs", "ball bar, µm", "encoder, µm", "with accelerometer, µm", "reduction")
    return "\n".join(
        [
            "the same chain on the virtual cobot (mean over the middle half ± what repeats of a "
            "direction disagree by; unit: the run)",
            table(head, rows),
            f"mean of the five per cents: {found['reduction_pct']:z.1f} % ± "
            f"{found['reduction_half_width_pct']:z.1f} (95 %, the feed as unit); without the feed at "
            f"which the threshold was tuned: {found['reduction_of_feeds_not_tuned_pct']:z.1f} %",
        ]
    )


def _does_not_follow(found: Mapping[str, Any]) -> str:
    told, path = found["published"], found["along_the_path"]
    constant, other = found["controls_pct"].values()
    circles = table(
        ("circle", "middle half, µm", "full circle, µm", "centre offset, µm"),
        [
            (c["circle"], f"{c['middle_half_um']:z.1f}", f"{c['full_circle_um']:z.1f}", f"{c['centre_offset_um']:z.1f}")
            for c in found["set_up"]
        ],
    )
    largest = max(abs(f["encoder_um"]) for f in found["feeds"])
    return "\n".join(
        [
            "what does not follow",
            "1. That a sensor closed the gap. One constant, the mean gap of the other four feeds, "
            f"would have closed {told['constant_of_other_feeds_pct']:z.0f} % of it in the published "
            f"table and {constant:z.0f} % here; the accelerometer of another feed closes "
            f"{other:z.1f} % here.",
            "2. That the gap is an error of the robot. The mean over half of a circle holds the "
            "centre offset of the mounting; over the full circle that cancels:",
            circles,
            "3. That the shape of the error is found. With centre and radius fitted to every run, "
            f"the gap is {path['gap_um']:z.1f} µm RMS without and {path['left_um']:z.1f} µm with the "
            f"displacement: {path['change_um']:+z.1f} ± {path['change_half_width_um']:z.1f} µm "
            f"(95 %, {path['runs']:z.0f} runs), correlation {path['correlation']:z.2f}.",
            "4. The threshold. It minimises the figure that is reported, on the same runs; "
            f"here the swarm chose {shown_number(found['threshold_g2'], 2)} g^2 at "
            f"F{found['tuned_at_feed_mm_min']:g}.",
            "not reproduced: the encoder's 40 to 49 µm. The virtual controller's own position stays "
            f"within {largest:z.1f} µm of its command on average; where the thesis's offset comes "
            "from is not stated.",
        ]
    )
