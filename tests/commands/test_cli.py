"""The command line in process: exit codes, what is said where, which files are written."""

import errno
import json
import logging
import re
from pathlib import Path

import click
import fake_stages
import pytest
from facts import assert_facts
from fake_stages import NAMES

from recon_cli import __version__, errors
from recon_cli.cli import VERBS, cli, main
from recon_cli.commands import jobs, stages, workspace
from recon_cli.errors import (
    BackendError,
    ConfigError,
    FormatError,
    InputError,
    ManifestError,
    ReconError,
    ReconstructionError,
    SfmError,
    StageError,
    TrainingError,
    WorkspaceError,
)
from recon_cli.pipeline import plan
from recon_cli.pipeline.plan import StageStatus
from recon_cli.train.plan import QUALITIES

pytestmark = pytest.mark.floors

ROOT = Path(__file__).resolve().parents[2]
PAGE = "export.html"  # which a whole run exports


@pytest.fixture(autouse=True)
def _fakes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    fake_stages.actions.clear()
    fake_stages.ran.clear()
    for module in (jobs, stages, workspace):
        monkeypatch.setattr(module, "STAGES", fake_stages.TABLE)
    monkeypatch.setattr(
        stages, "end_run", lambda job, **_: click.echo(f"the end of {job.workspace.root.name}"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RECON_WORKSPACE", raising=False)
    (tmp_path / "room.mp4").write_text("a video")


Said = pytest.CaptureFixture[str]


def config_of(stage: str, workspace: str = "workspace") -> dict[str, object]:
    return json.loads((Path(workspace) / stage / "manifest.json").read_text())["config"]


@pytest.mark.integration
def test_each_verb_runs_its_stage_and_says_what_came_of_it(capsys: Said) -> None:
    for words in (["ingest", "room.mp4"], ["denoise"], ["sfm"], ["train"], ["prune"], ["eval"],
                  ["export"]):
        assert main(words) == 0
    assert fake_stages.ran == NAMES
    out = capsys.readouterr().out
    assert "train (" in out
    assert_facts(out, "table", "evaluate")
    assert main(["train"]) == 0
    assert capsys.readouterr().out == "train is up to date\n"
    assert main(["train", "--again"]) == 0
    assert fake_stages.ran[len(NAMES):] == ["train"]


@pytest.mark.integration
def test_run_does_everything_and_ends_with_its_results(capsys: Said) -> None:
    assert main(["run", "room.mp4", "--set", "train.iterations=9"]) == 0
    assert fake_stages.ran == [*NAMES, PAGE]
    assert config_of("train")["iterations"] == 9
    assert config_of("prune")["at"] == "mid"
    out = capsys.readouterr().out
    assert out.endswith("\nthe end of workspace\n")
    assert "the table of evaluate" not in out
    assert main(["run", "--set", "train.iterations=9"]) == 0
    assert fake_stages.ran == [*NAMES, PAGE]


@pytest.mark.integration
def test_eval_prints_its_table_and_what_the_scores_mean_only_where_asked(capsys: Said) -> None:
    assert main(["run", "room.mp4", "--no-prune"]) == 0
    capsys.readouterr()
    assert main(["eval"]) == 0
    assert capsys.readouterr().out.endswith("the table of evaluate\n\n")
    assert main(["eval", "--explain"]) == 0
    before, table, explained = capsys.readouterr().out.partition("the table of evaluate\n\n")
    assert table
    assert {"PSNR", "8-bit", "SSIM", "SSIM 0-pad", "LPIPS", "masks"} <= {
        line.partition(":")[0] for line in explained.splitlines()}
    assert "PSNR:" not in before
    assert main(["eval", "--explain", "--form", "csv"]) == 2


def test_run_can_leave_pruning_out() -> None:
    assert main(["run", "room.mp4", "--no-prune"]) == 0
    assert fake_stages.ran == [*(name for name in NAMES if name != "prune"), PAGE]


@pytest.mark.integration
def test_demo_runs_on_the_bundled_video_in_a_workspace_of_its_own(
    capsys: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stages, "SAMPLE", Path("room.mp4").absolute())
    monkeypatch.setenv("RECON_WORKSPACE", "elsewhere")
    assert main(["demo", "--set", "train.iterations=10"]) == 0
    assert fake_stages.ran == [*NAMES, PAGE]
    train = config_of("train", "demo")
    assert train["iterations"] == 10  # what is typed wins
    out = capsys.readouterr().out
    assert "the end of demo" in out
    assert not Path("elsewhere").exists()


def test_demo_takes_fewer_steps_than_other_captures_get(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stages, "SAMPLE", Path("room.mp4").absolute())
    assert main(["demo"]) == 0
    assert config_of("train", "demo")["iterations"] == 1700 < QUALITIES["normal"].iterations
    assert config_of("prune", "demo")["at"] == "mid"


def test_the_bundled_video_is_there(sample_video: Path) -> None:
    assert sample_video == stages.SAMPLE
    assert stages.SAMPLE.exists()


def test_train_prune_branches_off_in_the_middle() -> None:
    assert main(["ingest", "room.mp4"]) == 0
    assert main(["train", "--prune", "--ratio", "0.25", "--iterations", "10"]) == 0
    assert fake_stages.ran == ["ingest", "denoise", "sfm", "place", "train", "prune"]
    assert config_of("train")["iterations"] == 10
    prune = config_of("prune")
    assert (prune["at"], prune["ratio"]) == ("mid", 0.25)


def test_the_compact_model_alone_needs_pruning(capsys: Said) -> None:
    assert main(["run", "room.mp4", "--compact-only", "--no-prune"]) == 2
    assert_facts(capsys.readouterr().err, "--compact-only", "--no-prune")
    assert main(["run", "room.mp4", "--compact-only"]) == 0
    assert config_of("train")["compact_only"] is True
    Path("workspace/recon.toml").write_text("[train]\ncompact_only = true\n")
    assert main(["run", "room.mp4", "--no-prune"]) == 2


def test_pruning_options_without_prune_are_a_usage_error(capsys: Said) -> None:
    assert main(["train", "--ratio", "0.25"]) == 2
    assert_facts(capsys.readouterr().err, "--ratio", "--prune")


def test_the_layers_win_in_order_defaults_toml_config_options() -> None:
    main(["ingest", "room.mp4"])
    Path("workspace/recon.toml").write_text("[train]\niterations = 1\nseed = 1\nsh_degree = 1\n")
    Path("mine.toml").write_text("[train]\niterations = 2\nseed = 2\n")
    assert main(["train", "--config", "mine.toml", "--iterations", "4"]) == 0
    train = config_of("train")
    assert (train["iterations"], train["seed"], train["sh_degree"]) == (4, 2, 1)


def test_print_config_prints_what_config_takes(capsys: Said) -> None:
    for verb in ("ingest", "denoise", "sfm", "train", "prune", "eval", "export", "run"):
        assert main([verb, "--print-config"]) == 0
        first = capsys.readouterr().out
        Path("printed.toml").write_text(first)
        assert main([verb, "--print-config", "--config", "printed.toml"]) == 0
        assert capsys.readouterr().out == first
    assert main(["train", "--prune", "--ratio", "0.25", "--print-config"]) == 0
    out = capsys.readouterr().out
    assert "ratio = 0.25" in out
    assert 'at = "mid"' in out
    assert not Path("workspace").exists()


def test_the_workspace_is_the_option_or_the_variable_or_a_folder_here(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    main(["ingest", "room.mp4"])
    monkeypatch.setenv("RECON_WORKSPACE", "two")
    main(["ingest", "room.mp4"])
    main(["ingest", "room.mp4", "-w", "three"])
    assert all(Path(name, "ingest", "manifest.json").exists()
               for name in ("workspace", "two", "three"))


@pytest.mark.integration
def test_status_shows_state_and_reason(capsys: Said) -> None:
    main(["run", "room.mp4"])
    Path("workspace/recon.toml").write_text("[train]\niterations = 7\n")
    capsys.readouterr()
    assert main(["status"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1:]] == [*NAMES, PAGE]
    assert "fresh" in lines[1]
    assert_facts(lines[1 + NAMES.index("train")], "train.iterations", 7)


def test_status_as_json_has_stable_keys(capsys: Said) -> None:
    main(["ingest", "room.mp4"])
    capsys.readouterr()
    assert main(["status", "--json"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert list(value) == ["workspace", "stages"]
    assert [stage["name"] for stage in value["stages"]] == NAMES
    assert list(value["stages"][0]) == [
        "name", "state", "reasons", "done", "total", "seconds", "summary", "notices"]
    assert value["stages"][0]["state"] == "fresh"
    assert value["stages"][1]["state"] == "missing"


def test_status_needs_no_workspace_and_makes_none(capsys: Said) -> None:
    assert main(["status", "-w", "none"]) == 0
    assert_facts(capsys.readouterr().err, Path("none").absolute())
    assert not Path("none").exists()


def test_status_says_that_an_input_is_gone(capsys: Said) -> None:
    main(["ingest", "room.mp4"])
    Path("room.mp4").unlink()
    assert main(["status"]) == 0
    assert_facts(capsys.readouterr().err, "room.mp4")


def test_a_missing_stage_is_4_and_names_the_command(capsys: Said) -> None:
    assert main(["train"]) == 4
    error, hint = capsys.readouterr().err.splitlines()
    assert_facts(error, "error:", "train", "ingest")
    assert_facts(hint, "hint:", "recon ingest VIDEO")


def test_a_missing_input_is_3(capsys: Said) -> None:
    assert main(["ingest", "none.mp4"]) == 3
    assert_facts(capsys.readouterr().err, "none.mp4")


@pytest.mark.parametrize("words", [
    ["trian"], ["train", "--iteratons", "3"], ["train", "--iterations", "many"],
    ["run", "--set", "train.iteratons=3"], ["ingest"], ["train", "--config", "none.toml"], [],
])
def test_usage_errors_are_2_and_leave_no_traceback(words: list[str], capsys: Said) -> None:
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said
    assert "error: " in said or "Usage: " in said


def test_a_recon_toml_that_leads_nowhere_is_2_and_not_passed_over(capsys: Said) -> None:
    Path("workspace").mkdir()
    Path("workspace/recon.toml").symlink_to("gone.toml")
    assert main(["status"]) == 2
    assert_facts(capsys.readouterr().err, "recon.toml")


def test_an_unknown_key_in_recon_toml_is_2(capsys: Said) -> None:
    Path("workspace").mkdir()
    Path("workspace/recon.toml").write_text("[train]\niteration = 3\n")
    assert main(["status"]) == 2
    assert_facts(capsys.readouterr().err, "mean", "iterations")


def test_a_broken_manifest_is_7(capsys: Said) -> None:
    main(["ingest", "room.mp4"])
    Path("workspace/ingest/manifest.json").write_text("{")
    assert main(["status"]) == 7
    said = capsys.readouterr()
    assert re.search(r"^ingest +damaged", said.out, re.MULTILINE)
    assert re.search(r"^train +missing", said.out, re.MULTILINE)
    assert f"recon clean ingest -w {Path('workspace').absolute()}" in said.err
    assert main(["ingest", "room.mp4", "--again"]) == 0
    assert main(["status"]) == 0


def test_a_message_with_a_name_that_is_no_utf8_is_logged() -> None:
    fake_stages.actions["ingest"] = lambda: logging.getLogger("recon").warning("b\udcff.jpg")
    assert main(["ingest", "room.mp4"]) == 0
    assert "b\\udcff.jpg" in Path("workspace/recon.log").read_text()


def _raise(error: BaseException) -> None:
    raise error


CODES: dict[type[ReconError], int] = {
    ConfigError: 2, InputError: 3, FormatError: 3, StageError: 4, ReconstructionError: 5,
    SfmError: 5, TrainingError: 5, BackendError: 6, WorkspaceError: 7, ManifestError: 7}


def test_every_class_of_errors_has_its_exit_code_here() -> None:
    assert CODES.keys() == {item for item in vars(errors).values() if isinstance(item, type)
                            and issubclass(item, ReconError) and item is not ReconError}


@pytest.mark.parametrize(("error", "code", "facts"), [
    *((kind("28.jpg is dark.", hint="Type this."), code, ["error:", "28.jpg"])
      for kind, code in CODES.items()),
    (KeyboardInterrupt(), 130, ["interrupted", "again"]),
    (OSError(errno.ENOSPC, "No space left"), 7, ["error:", "MB"]),
    (OSError(errno.EFBIG, "File too large"), 7, ["error:", "larger"]),
    (PermissionError(errno.EACCES, "Permission denied"), 7, ["error:", "writable"]),
    (ZeroDivisionError("by zero"), 1, ["error:", "ZeroDivisionError", "zero"]),
])
def test_what_a_stage_raises_becomes_an_exit_code(
    error: BaseException, code: int, facts: list[str], capsys: Said
) -> None:
    fake_stages.actions["ingest"] = lambda: _raise(error)
    assert main(["ingest", "room.mp4"]) == code
    err = capsys.readouterr().err
    assert_facts(err, *facts)
    assert "Traceback" not in err
    if isinstance(error, ReconError):
        assert_facts(err, "hint:", "Type this.")
    else:
        assert "Traceback" in Path("workspace/recon.log").read_text()
    del fake_stages.actions["ingest"]
    assert main(["ingest", "room.mp4"]) == 0


def test_verbose_shows_the_traceback(capsys: Said) -> None:
    fake_stages.actions["ingest"] = lambda: _raise(ZeroDivisionError("by zero"))
    assert main(["ingest", "room.mp4", "-v"]) == 1
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.integration
def test_clean_keeps_every_finished_result_fresh(
    capsys: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recon_cli.pipeline.clean._WORTH_BYTES", 1)
    main(["run", "room.mp4"])
    fake_stages.actions["train"] = lambda: _raise(KeyboardInterrupt())
    main(["train", "--iterations", "9"])
    assert Path("workspace/.partial/train").is_dir()
    capsys.readouterr()
    assert main(["clean", "--dry-run"]) == 0
    assert_facts(capsys.readouterr().out, "MB")
    assert Path("workspace/.partial/train").is_dir()
    assert main(["clean"]) == 0
    assert "database.db" in capsys.readouterr().out
    assert not Path("workspace/.partial/train").exists()
    assert not Path("workspace/sfm/database.db").exists()
    assert states() == ["fresh"] * len([*NAMES, PAGE])


@pytest.mark.integration
def test_clean_keeps_small_logs() -> None:
    main(["run", "room.mp4"])
    assert main(["clean"]) == 0
    assert Path("workspace/train/log.jsonl").exists()


@pytest.mark.integration
def test_clean_removes_the_results_of_named_stages(capsys: Said) -> None:
    main(["run", "room.mp4"])
    capsys.readouterr()
    assert main(["clean", "train", "prune"]) == 0
    assert_facts(capsys.readouterr().out, "MB")
    assert not Path("workspace/train").exists()
    assert [states()[NAMES.index(name)] for name in ("sfm", "train", "prune")] == [
        "fresh", "missing", "missing"]


def states() -> list[str]:
    job = fake_stages.job_at(Path("workspace"))
    found: tuple[StageStatus, ...] = plan.status(job)
    return [one.state for one in found]


def test_doctor_prints_text_and_json(capsys: Said) -> None:
    assert main(["doctor"]) == 0
    assert "torch" in capsys.readouterr().out
    assert main(["doctor", "--json"]) == 0
    assert {"versions", "backends", "cores", "writable"} <= json.loads(
        capsys.readouterr().out).keys()


def test_the_version_is_printed(capsys: Said) -> None:
    assert main(["--version"]) == 0
    assert_facts(capsys.readouterr().out, "recon", __version__)


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help_and_its_first_line_in_the_list_of_verbs(
    verb: str, capsys: Said
) -> None:
    assert main([verb, "--help"]) == 0
    assert f"Usage: recon {verb}" in capsys.readouterr().out
    assert (cli.commands[verb].help or "").splitlines()[0] == VERBS[verb][1]


@pytest.mark.parametrize("columns", ["80", "100"])
def test_help_of_train_fits_on_a_screen(
    columns: str, monkeypatch: pytest.MonkeyPatch, capsys: Said
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    assert main(["train", "--help"]) == 0
    assert len(capsys.readouterr().out.splitlines()) <= 50


@pytest.mark.parametrize(("verb", "flag"), [
    ("train", "--means-rate"), ("train", "--densify-every"), ("train", "--min-opacity"),
    ("train", "--mid"), ("train", "--ssim-weight"), ("train", "--checkpoint-every"),
    ("train", "--batch-views"), ("export", "--spz-version"), ("render", "--crf"),
    ("render", "--codec"), ("bench", "--rounds"), ("bench", "--size"), ("study", "--clock"),
    ("study", "--log-format"),
])
def test_options_for_experts_are_on_the_second_page_of_help(
    verb: str, flag: str, capsys: Said
) -> None:
    assert main([verb, "--help"]) == 0
    first = capsys.readouterr().out
    assert main([verb, "--help-all"]) == 0
    second = capsys.readouterr().out
    assert f"\n  {flag} " not in first
    assert f"\n  {flag} " in second
    hidden = second.count("\n  -") - first.count("\n  -")
    last, = [line for line in first.splitlines() if line.split()[:1] == ["--help-all"]]
    assert f"({hidden} more)" in last


def test_an_option_for_experts_can_be_set(capsys: Said) -> None:
    assert main(["train", "--means-rate", "0.5", "--print-config"]) == 0
    assert "means_rate = 0.5" in capsys.readouterr().out


def test_a_mistyped_verb_is_corrected(capsys: Said) -> None:
    assert main(["trian"]) == 2
    assert "train" in capsys.readouterr().err
