"""Scheduled training without Prefect: real lake, real MLflow store, a machine that wears."""

from __future__ import annotations

import fcntl
import json
from dataclasses import replace
from pathlib import Path

import pytest
from running_servers import MACHINE, few_candidates, measured

from dtwin.acquire.amending import leave_out
from dtwin.acquire.runner import run_campaign
from dtwin.acquire.virtual import VirtualCobotBench
from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError
from dtwin.kinds.circular._evidence import checked_circles
from dtwin.kinds.machine import EvidenceRequest, Request, Simulated, VirtualMachine
from dtwin.lake.store import Lake
from dtwin.lifecycle.drift import check_drift, trained_rows
from dtwin.lifecycle.evidence import make_champion, measure
from dtwin.lifecycle.recheck import recheck
from dtwin.lifecycle.schedule import news, scheduled_training
from dtwin.lifecycle.train import put_on_trial, train
from dtwin.machines.cobot import VirtualCobot
from dtwin.pipeline.measuring import ingest
from dtwin.plan import EvidencePlan, training_plan
from dtwin.progress import Progress
from dtwin.serve.pointer import resolve
from dtwin.train.promotion import check_version
from dtwin.train.promotion_books import history
from dtwin.train.registry import Registry
from dtwin.train.still_helps import CheckedRun

pytestmark = pytest.mark.system
_CORRECTED = "a correction was in force while it was measured"
CIRCLES = EvidencePlan((("YZ", 150.0, 5000.0),), 2, (4000.0, 6000.0))


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Home:
    """A champion that was trained on the sound machine."""
    made = Home(tmp_path_factory.mktemp("scheduled"))
    measured(made, "quick", radii=2)
    with few_candidates():
        registered = train(made, "quick")
    put_on_trial(made, registered.version)
    measure(made, registered.version, seed=0, plan=CIRCLES)
    path, reason = make_champion(made, registered.version)
    assert path, reason
    return made


def test_an_empty_lake_is_skipped_with_the_reason(tmp_path: Path) -> None:
    done = scheduled_training(Home(tmp_path / "empty"))
    assert (done.outcome, done.registered) == ("skipped", None)
    assert "no campaign" in done.reason


def test_what_was_trained_on_is_not_new(home: Home) -> None:
    done = scheduled_training(home)
    assert (done.outcome, done.campaigns) == ("skipped", {"quick": "0 new runs", f"evidence-{MACHINE}-v1": _CORRECTED})
    assert done.reason.endswith("since version 1 of virtual-cobot (quick)")


def test_a_run_that_is_left_out_after_the_training_is_a_reason_to_train_again(home: Home) -> None:
    registry, lake = Registry(home), Lake(home.lake)
    run = lake.runs("quick")[0]["run_id"]
    leave_out(lake, "quick", [run], "the magnet slipped")
    (item,) = (item for item in news(home, registry) if item.campaign == "quick")
    assert (item.new_runs, item.is_new, item.told) == (0, True, "0 new runs, 1 left out since the last training")
    with pytest.raises(GateRefusal, match="left out now"):
        put_on_trial(home, registry.version(MACHINE, "1"))
    path, reason = make_champion(home, registry.version(MACHINE, "1"))
    assert path is None
    assert run in reason
    leave_out(lake, "quick", [run], "it had not", out=False)
    assert not any(item.is_new for item in news(home, registry) if item.campaign == "quick")


def test_two_schedules_do_not_train_at_once(home: Home) -> None:
    with (home.root / "locks" / "scheduled-training.lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        done = scheduled_training(home)
    assert (done.outcome, done.reason) == ("skipped", "another scheduled training is at work")


def test_training_data_are_read_back_at_the_version_s_own_table_version(home: Home) -> None:
    registry, lake = Registry(home), Lake(home.lake)
    champion = registry.champion(MACHINE)
    assert champion is not None
    before = {row["content_sha256"] for row in trained_rows(registry, lake, champion)}
    assert len(before) == 16
    # More runs of the same campaign come in later: they are new, and the champion's are not.
    plan = training_plan(radii_mm=(100.0,), feeds_mm_min=(5000.0,), planes=("YZ",), repeats=2, name="grown")
    run_campaign(plan, VirtualCobotBench(0), home.campaigns / "grown")
    toml = home.campaigns / "grown" / "campaign.toml"
    text = toml.read_text(encoding="utf-8").replace('name = "grown"', 'name = "quick"')
    for number in (1, 2):
        text = text.replace(f'id = "t{number:03d}', f'id = "later{number}')
    toml.write_text(text, encoding="utf-8")
    ingest(home.campaigns / "grown", home)
    assert {row["content_sha256"] for row in trained_rows(registry, lake, champion)} == before
    # Beside them, the runs of its own evidence: nothing is trained on these.
    assert {item.campaign: item.new_runs for item in news(home, registry)} == {"quick": 4, f"evidence-{MACHINE}-v1": 8}
    check = check_drift(home, champion, "quick")
    assert check.error is not None
    assert check.error.n_runs == 4
    assert not check.drifted, check.reason


def test_wear_is_a_diagnosis_and_other_noise_is_not(home: Home) -> None:
    measured(home, "sound", repeats_from=4, radii=2)
    champion = Registry(home).champion(MACHINE)
    assert champion is not None
    sound = check_drift(home, champion, "sound")
    assert sound.error is not None
    assert not sound.drifted, sound.reason
    assert sound.finding is None

    measured(home, "worn", repeats_from=8, worn=2.5)
    with few_candidates():
        done = scheduled_training(home)
    assert done.outcome == "trained", done.reason
    assert [check.campaign for check in done.drift] == ["worn"]
    finding = done.drift[0].finding
    assert finding is not None, done.drift[0].reason
    assert finding.code == "champion.drift"
    assert finding.numbers["excess_um"] > finding.numbers["noise_floor_um"]
    assert done.drift[0].error is not None
    assert sound.error.rms_um < done.drift[0].error.rms_um

    found = done.comparison
    assert found is not None
    assert (found.champion, found.candidate) == ("1", "2")
    assert (found.n_runs, found.seen_by_champion) == (24, 0)
    assert found.champion_um == pytest.approx(done.drift[0].error.rms_um)
    assert found.candidate_um < found.before_um

    registry = Registry(home)
    assert registry.version(MACHINE, "champion").version == "1", "the schedule promoted"
    tags = registry.version(MACHINE, "1").tags
    assert tags["drift.worn"].startswith("DRIFT: ")
    assert registry.read_json(champion, "drift.worn.json")["drifted"] is True
    candidate = registry.version(MACHINE, "candidate")
    assert candidate.tags["against_champion"] == found.verdict
    assert found.verdict in registry.description(candidate)
    assert json.loads(json.dumps(done.as_dict()))["comparison"]["verdict"] == found.verdict

    again = scheduled_training(home)
    assert (again.outcome, again.drift) == ("skipped", ()), "the same runs were judged twice"
    assert again.campaigns["worn"] == "0 new runs"
    assert "older than" in again.campaigns["sound"]


def test_a_campaign_that_cannot_train_still_judges_the_champion(home: Home, real_recording: Path) -> None:
    ingest(real_recording, home)
    plan = training_plan(radii_mm=(150.0,), feeds_mm_min=(5000.0,), planes=("YZ",), repeats=2, name="check")
    run_campaign(plan, VirtualCobotBench(0), home.campaigns / "check")
    ingest(home.campaigns / "check", home)
    done = scheduled_training(home)
    assert done.outcome == "checked", done.reason
    assert [(check.campaign, check.drifted) for check in done.drift] == [("check", False)]
    assert "one feed only" in done.campaigns["check"]
    assert "no controller signals" in " ".join(done.campaigns.values())
    tags = Registry(home).version(MACHINE, "champion").tags
    assert "drift.check" in tags


class TurnedGears(VirtualMachine):
    """The machine after its gears were put back half a turn of the error round: its sign flipped."""

    name = "cobot"

    def simulate(self, request: Request, progress: Progress) -> Simulated:
        raise self.lacks("a campaign", "only its check by pairs is asked for here")

    def checked(self, request: EvidenceRequest, blocks: int) -> list[CheckedRun]:
        sound = VirtualCobot(seed=0).parameters
        flipped = tuple(tuple(-size for size in row) for row in sound.joints.order_amplitude_urad)
        joints = replace(sound.joints, order_amplitude_urad=flipped)
        return checked_circles(request, blocks, VirtualCobot(replace(sound, joints=joints), seed=0))


def test_a_champion_that_still_helps_is_kept(home: Home) -> None:
    before = resolve("latest", MACHINE, home).proved
    done = recheck(home, MACHINE, blocks=2, seed=0)
    assert (done.found.verdict, done.withdrawn) == ("helps", False), done.found.reason
    proved = resolve("latest", MACHINE, home).proved
    assert before < proved == Registry(home).version(MACHINE, "champion").tags["proved"]
    assert done.found.conditions[-1].after_um < done.found.conditions[-1].before_um
    champion = Registry(home).version(MACHINE, "champion")
    assert champion.version == done.version.version
    assert " helps: " in champion.tags["recheck"]
    assert resolve("latest", MACHINE, home).state == "champion"


def test_a_champion_that_harms_a_changed_machine_is_rolled_back(home: Home) -> None:
    # The version of the worn machine has its turn, so that there is one to go back to.
    registry = Registry(home)
    first = registry.version(MACHINE, "champion")
    later = registry.version(MACHINE, "2")
    put_on_trial(home, later)
    measure(home, later, seed=0, plan=CIRCLES)
    path, reason = make_champion(home, later)
    assert path, reason
    done = recheck(home, MACHINE, virtual=TurnedGears(), blocks=2, seed=0)
    assert (done.found.verdict, done.withdrawn, done.restored) == ("worse", True, first.version)
    assert resolve("latest", MACHINE, home).version == int(first.version)
    withdrawn = registry.version(MACHINE, "2")
    assert withdrawn.tags["state"] == "withdrawn"
    assert withdrawn.tags["withdrawn_why"] == done.found.reason
    last = history(home, MACHINE)[-1]
    assert (last["action"], last["comment"]) == ("rollback", done.found.reason)
    assert check_version(registry, withdrawn)[1][-1].passed is False


def test_without_a_champion_before_nothing_is_served_any_more(home: Home) -> None:
    done = recheck(home, MACHINE, virtual=TurnedGears(), blocks=2, seed=0)
    assert (done.withdrawn, done.restored) == (True, "")
    with pytest.raises(GateRefusal, match="may not correct a machine") as refused:
        resolve("latest", MACHINE, home)
    assert "larger with the correction" in (refused.value.got or "")
    with pytest.raises(InputError):
        Registry(home).version(MACHINE, "champion")
