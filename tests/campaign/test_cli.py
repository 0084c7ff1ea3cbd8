from __future__ import annotations

import io
import json
import os
import shlex
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest
import typer
from command_here import command_here

from dtwin import __version__, cli
from dtwin.cli import app, main
from dtwin.commands._output import stages
from dtwin.commands.tasks import _branch_names
from dtwin.config import home
from dtwin.machine_record import keep_record
from dtwin.progress import tell


def run(*arguments: str, code: str = "") -> subprocess.CompletedProcess[str]:
    command = ["-c", code] if code else ["-m", "dtwin", *arguments]
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, check=False)


def here(*arguments: str) -> subprocess.CompletedProcess[str]:
    """As ``run``, in this process, which costs a tenth."""
    return subprocess.CompletedProcess(arguments, *command_here(*arguments))


def test_what_long_work_does_now_is_one_line_of_a_terminal_and_nothing_in_a_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with stages(quiet=False):
        tell("piped")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "20")
    with stages(quiet=True):
        tell("JSON is wanted")
    with stages(quiet=False):
        tell("sets of effects that are many")
    tell("nobody listens")
    assert capsys.readouterr().err == "\rsets of effects tha\x1b[K\r\x1b[K"


def test_help_names_every_command_and_imports_nothing_heavy() -> None:
    shown = run("--help")
    assert shown.returncode == 0
    for command in (
        "demo",
        "plan",
        "simulate",
        "ingest",
        "runs",
        "check",
        "features",
        "train",
        "models",
        "promote",
        "rollback",
        "serve",
        "report",
        "twin",
        "effects",
        "record",
        "up",
        "ui",
        "examples",
        "analogue",
        "linuxcnc",
        "cell",
        "lathe",
        "turning",
        "dynamics",
        "volumetric",
        "papers",
    ):
        assert f"\n  {command} " in shown.stdout
    heavy = ["numpy", "pandas", "scipy", "pyarrow", "mlflow", "prefect", "sklearn", "numba", "plotly", "fastapi"]
    code = f"import dtwin.cli, sys; print([m for m in {heavy!r} if m in sys.modules])"
    assert run(code=code).stdout.strip() == "[]"


def test_without_a_command_the_help_is_shown_and_says_where_to_begin() -> None:
    shown = run()
    assert "Usage:" in shown.stdout + shown.stderr
    assert "dtwin demo --quick" in shown.stdout + shown.stderr


def test_every_command_has_its_place_and_every_place_its_command() -> None:
    from typer.main import get_command

    from dtwin.cli import app
    from dtwin.commands.tasks import _FLEET_TASKS, _TASKS, _TWIN_TASKS

    main = get_command(app)
    for group, tasks in ((main, _TASKS), (main.commands["twin"], _TWIN_TASKS), (main.commands["fleet"], _FLEET_TASKS)):
        placed = [name for task in tasks.values() for name in task]
        assert sorted(placed) == sorted(group.commands)
    assert "More:" not in here("--help").stdout


def test_no_sentence_of_the_help_is_cut_off() -> None:
    for group in ((), ("twin",)):
        assert "..." not in here(*group, "--help").stdout.replace("[ARGS]...", "")


def test_the_version_is_told() -> None:
    assert here("--version").stdout == f"dtwin {__version__}\n"


def test_a_mistyped_command_is_answered_with_the_right_one() -> None:
    for words, meant in ((["simulat"], "simulate"), (["twin", "diagnos"], "diagnose")):
        shown = here(*words)
        assert (shown.returncode, f"Did you mean '{meant}'?" in shown.stderr) == (2, True)


def test_completion_is_installed_and_completes_in_a_clean_home(tmp_path: Path) -> None:
    environment = dict(
        os.environ, HOME=str(tmp_path), PATH=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    )
    # A shell of its own, as completion is installed for the shell that asks.
    script = """
dtwin --install-completion >/dev/null || exit 1
source ~/.bashrc
COMP_WORDS=(dtwin twin dia) COMP_CWORD=2
_dtwin_completion dtwin
echo "${COMPREPLY[*]}"
"""
    done = subprocess.run(["bash", "-c", script], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout == "diagnose\n", done.stderr


def test_the_first_mistakes_in_an_empty_folder_say_what_to_try(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    for words, told in (
        (["check", "."], "it has no campaign.toml"),
        (["ingest", "nowhere"], "dtwin examples"),
        (["twin", "fit", "nowhere", "--effects", "backlash", "--name", "a"], "dtwin examples"),
        (["twin", "diagnose", "nobody"], "dtwin twin fit"),
    ):
        shown = here(*words)
        assert shown.returncode == 1
        assert told in shown.stderr
        assert "Traceback" not in shown.stderr


def test_check_speaks_json_and_nothing_else(real_recording: Path) -> None:
    found = json.loads(run("check", str(real_recording), "--json").stdout)
    codes = {f["code"] for r in found["runs"] for f in r["findings"]}
    assert {"arc.window_short", "motion.stops", "angle.misregistered", "feed.differs"} <= codes


def test_a_mistake_is_a_message_with_exit_code_1_and_json_when_wanted(tmp_path: Path) -> None:
    (tmp_path / "x.b5r").write_text("<a>")
    plain = run("check", str(tmp_path / "x.b5r"))
    assert plain.returncode == 1
    assert plain.stderr.startswith("error[xml.malformed]")
    assert "Traceback" not in plain.stderr
    wanted = here("check", str(tmp_path / "x.b5r"), "--json")
    assert json.loads(wanted.stdout)["error"]["code"] == "xml.malformed"
    assert wanted.stderr == ""


def test_a_wrong_command_line_is_json_for_a_program_that_asked_for_it() -> None:
    for words in (("runs", "--bogus"), ("machine", "show"), ("mach",), ("machine", "sho")):
        wanted = here(*words, "--json")
        assert (wanted.returncode, json.loads(wanted.stdout)["error"]["code"], wanted.stderr) == (2, "usage", "")
    plain = here("machine", "sho")
    assert (plain.returncode, plain.stdout, "Did you mean 'show'" in plain.stderr) == (2, "", True)


def test_ctrl_c_is_told_and_a_reader_that_went_away_is_no_mistake(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("dtwin.pipeline.machine_history.machine_overviews", interrupted)
    stopped = here("machine", "list", "--json")
    assert (stopped.returncode, stopped.stdout) == (130, "")
    assert "run the same command again" in stopped.stderr
    reader, writer = os.pipe()
    os.close(reader)
    listed = subprocess.run(
        [sys.executable, "-m", "dtwin", "effects", "list"], stdout=writer, stderr=subprocess.PIPE, check=False
    )
    os.close(writer)
    assert (listed.returncode, listed.stderr) == (0, b"")


@pytest.mark.parametrize("blocked", ["pyarrow", "mlflow"])
def test_a_missing_part_is_named_without_a_traceback(blocked: str) -> None:
    command = {"pyarrow": "runs", "mlflow": "models"}[blocked]
    code = (
        f"import sys; sys.modules[{blocked!r}] = None\n"
        f"sys.argv = ['dtwin', {command!r}]\n"
        "from dtwin.cli import main; main()"
    )
    done = run(code=code)
    assert done.returncode == 1
    assert f"needs the package {blocked}" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "place",
    [
        ["--bar-zero-deg", "-90"],
        ["--robot-centre-mm", "nan", "0", "75"],
        ["--robot-centre-mm", "1", "0", "75", "--bar-zero-deg", "inf"],
    ],
)
def test_a_place_of_the_bar_that_is_none_is_refused(place: list[str]) -> None:
    done = here("twin", "recording", "data/samples/ur10e_xy_r100_f5000.b5r", *place)
    assert (done.returncode, "recording.place" in done.stderr) == (1, True)


def test_models_of_a_machine_without_any_are_told_of_that_machine() -> None:
    assert "no model of machine nope is registered" in here("models", "--machine", "nope").stdout


def test_examples_are_copied_once_and_never_over_something(tmp_path: Path) -> None:
    out = tmp_path / "examples"
    copied = json.loads(here("examples", "--out", str(out), "--json").stdout)["campaigns"]
    assert [Path(c).name for c in copied] == ["hidden-effect", "nothing-hidden", "spoilt-run"]
    (out / "hidden-effect" / "campaign.toml").write_text("mine", encoding="utf-8")
    again = here("examples", "--out", str(out))
    assert (again.returncode, "examples.exists" in again.stderr) == (1, True)
    assert (out / "hidden-effect" / "campaign.toml").read_text(encoding="utf-8") == "mine"


def test_examples_that_cannot_be_copied_leave_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "source"
    source.mkdir()
    (source / "a.csv").write_text("t_s", encoding="utf-8")
    (source / "b.csv").symlink_to("nowhere")
    monkeypatch.setattr("dtwin.config.example_campaigns", lambda: source)
    done = here("examples", "--out", str(tmp_path / "examples"))
    assert (done.returncode, "examples.copy" in done.stderr, "[(" in done.stderr) == (1, True, False)
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


def test_a_registry_that_is_lost_in_the_middle_is_said_and_a_bad_home_file_does_not_spoil_the_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sqlalchemy.exc import OperationalError

    file = home().made().root / "home.toml"

    def lost() -> None:
        raise OperationalError("SELECT 1", {}, Exception("server closed the connection"))

    def held() -> None:
        raise OperationalError("SELECT 1", {}, sqlite3.OperationalError("database is locked"))

    def full() -> None:
        error = OperationalError("INSERT", {}, sqlite3.OperationalError("database or disk is full"))
        error.args = (f"(raised as a result of autoflush)\n{error.args[0]}",)
        raise error

    def full_for_ourselves() -> None:
        raise sqlite3.OperationalError("database or disk is full")

    for broken, told in (
        (held, "database is locked"),
        (full, "database or disk is full"),
        (full_for_ourselves, "database or disk is full"),
    ):
        monkeypatch.setattr("dtwin.cli.app", broken)
        with pytest.raises(SystemExit):
            cli.main()
        assert told in capsys.readouterr().err
    monkeypatch.setattr("dtwin.cli.app", lost)
    with pytest.raises(OperationalError):
        cli.main()
    with monkeypatch.context() as elsewhere:
        elsewhere.setenv("MLFLOW_TRACKING_URI", "http://models.plant:5000")
        with pytest.raises(SystemExit):
            cli.main()
    assert "registry.away" in capsys.readouterr().err
    file.write_text('registry = "http://models.plant:5000"\n')
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 1
    assert "registry.away" in capsys.readouterr().err
    file.write_text("nonsense")
    monkeypatch.setattr("dtwin.cli.app", lambda: sys.exit(0))
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["plan", "/dev/zero"], "plan.file"),
        (["machine", "measure", "m", "/dev/zero"], "plan.file"),
        (["check", "a" * 300], "store.permission"),
        # As a disk that fails, or a share that went away.
        (["check", "/proc/self/mem"], "store.permission"),
        (["effects", "template", "a" * 300], "store.permission"),
        (["robot-program", "--watchdog-s", "1e309"], "ur.limits"),
        (["robot-program", "--slew-um-s", "1e309"], "ur.limits"),
        (["machine", "next", "m"], "machine.proposals"),
        (["machine", "plan", "m", "--out", ""], "store.write"),
        (["promote", "1", "--comment", "x" * 1001], "promote.comment"),
    ],
)
def test_what_makes_no_sense_is_refused_and_nothing_hangs(
    words: list[str], code: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    keep_record(home(), "m", {"axes": {"Q": {}}})
    monkeypatch.setattr(sys, "argv", ["dtwin", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code not in (0, None)
    assert f"error[{code}]" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["runs"], ["ui", "--no-browser"], ["up"], ["home", "show"]])
@pytest.mark.parametrize("where", ["home", "s3://name:secret%2F@bucket/dtwin"])
def test_a_home_that_is_a_file_or_an_address_is_refused(
    where: str, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "home"
    file.write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DTWIN_HOME", where)
    monkeypatch.setattr(sys, "argv", ["dtwin", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code not in (0, None)
    said = capsys.readouterr().err
    assert "error[home.folder]" in said
    assert "secret" not in said
    assert [path.name for path in tmp_path.iterdir()] == ["home"]


@pytest.mark.parametrize(
    ("words", "where"), [(["check", "a\udcff.b5r"], "home"), (["machine", "add", "m"], "home-\udcc3")]
)
def test_words_that_are_no_text_are_refused_before_something_is_written(
    words: list[str], where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / where))
    monkeypatch.setattr(sys, "argv", ["dtwin", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    assert "error[command.encoding]" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_terminal_of_few_letters_gets_no_traceback() -> None:
    few = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0"}
    command = [sys.executable, "-m", "dtwin", "effects", "show", "backlash"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=few)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\\xb5m" in done.stdout


def _leaves(command: Any) -> Iterator[Any]:
    for inner in getattr(command, "commands", {}).values():
        yield from _leaves(inner)
    if not hasattr(command, "commands"):
        yield command


def test_a_seed_below_zero_is_refused_by_every_command() -> None:
    seeds = [p for command in _leaves(typer.main.get_command(app)) for p in command.params if p.name == "seed"]
    assert len(seeds) > 15
    assert {p.min for p in seeds} == {0}


def test_a_branch_alone_knows_every_command_of_the_whole_tree_and_says_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = typer.main.get_command(app)
    held = [name for branch in app.registered_groups for name in _branch_names(branch)]
    assert sorted(held) == sorted(whole.commands)  # type: ignore[attr-defined]
    for words in (["leave-out", "--help"], ["twin", "--help"], ["twin", "fitt"], ["nonsense"], []):
        monkeypatch.setattr(sys, "argv", ["dtwin", *words])
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as ended:
            whole()
        assert command_here(*words) == (ended.value.code, out.getvalue(), err.getvalue())


@pytest.mark.parametrize(
    ("streams", "code"),
    [
        ("<&- >&- 2>&-", 0),
        (">&-", 0),
        ("--json >&-", 0),
        (">/dev/full", 1),
        ("--json >/dev/full", 1),
        ("2>/dev/full", 0),
    ],
)
def test_closed_and_full_streams_end_in_no_traceback(streams: str, code: int, tmp_path: Path) -> None:
    where = {**os.environ, "DTWIN_HOME": str(tmp_path / "home")}
    command = f"{shlex.quote(sys.executable)} -m dtwin machine add mill-a {streams}"
    done = subprocess.run(["sh", "-c", command], env=where, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, "Traceback" in done.stderr) == (code, False), done.stderr
    assert (tmp_path / "home" / "machines" / "mill-a.toml").read_text() == "events = []\n\n[axes]\n\n[tolerances]\n"


def test_firmware_replaces_nothing_but_firmware(tmp_path: Path) -> None:
    kept = tmp_path / "users"
    kept.write_text("root:x:0:0\n")
    refused = here("analogue", "build", "--out", str(kept))
    assert refused.returncode == 1
    assert "no firmware" in refused.stderr
    assert kept.read_text() == "root:x:0:0\n"
