"""What scripts and servers rely on: the log's formats, --quiet, --json, variables, devices."""

import json
import logging
import os
import re
from pathlib import Path

import click
import fake_stages
import pytest
import torch
from facts import assert_facts, raises

from recon_cli.cli import VERBS, cli, main
from recon_cli.commands import jobs, stages, workspace
from recon_cli.errors import BackendError
from recon_cli.processes import forget_options
from recon_cli.render import registry

Said = pytest.CaptureFixture[str]
LOG_LINE = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d \S")


@pytest.fixture(autouse=True)
def _fakes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    fake_stages.actions.clear()
    fake_stages.ran.clear()
    for module in (jobs, stages, workspace):
        monkeypatch.setattr(module, "STAGES", fake_stages.TABLE)
    monkeypatch.setattr(stages, "end_run", lambda _call, **_: None)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RECON_WORKSPACE", raising=False)
    (tmp_path / "room.mp4").write_text("a video")
    (tmp_path / "recon.toml").write_text("[sfm]\n")


def command_of(words: tuple[str, ...]) -> click.Command:
    command = cli.commands[words[0]]
    return command.commands[words[1]] if len(words) > 1 else command


def config_of(stage: str) -> dict[str, object]:
    return json.loads(Path("workspace", stage, "manifest.json").read_text())["config"]


@pytest.mark.parametrize("words", [(verb,) for verb in VERBS], ids="-".join)
def test_every_verb_is_told_how_to_talk_and_each_option_has_a_variable_of_its_own(
    words: tuple[str, ...], capsys: Said
) -> None:
    options = [one for one in command_of(words).params if isinstance(one, click.Option)]
    names = [name for option in options for name in option.opts]
    assert {"-q", "--quiet", "--log-format", "--json"} <= set(names)
    assert len(names) == len(set(names))
    variables = [str(option.envvar) for option in options]
    assert len(variables) == len(set(variables))
    assert all(name.startswith("RECON_") for name in variables)
    assert main([*words, "-h"]) == 0
    assert "-h, --help" in capsys.readouterr().out


@pytest.mark.integration
def test_without_a_terminal_each_line_of_the_log_has_the_time(capsys: Said) -> None:
    assert main(["run", "room.mp4"]) == 0
    err = capsys.readouterr().err
    assert "\r" not in err
    assert all(LOG_LINE.match(line) for line in err.splitlines())


def test_a_stage_that_says_much_writes_four_lines_a_minute_and_every_notice(capsys: Said) -> None:
    def say_much() -> None:
        for number in range(9):
            logging.getLogger("recon").info("fact %d", number)
        logging.getLogger("recon").warning("a frame is dark")

    fake_stages.actions["ingest"] = say_much
    assert main(["ingest", "room.mp4"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 5
    assert_facts(lines[-1], "notice", "frame", "dark")
    assert "fact 8" in Path("workspace/recon.log").read_text()
    assert main(["ingest", "--again", "-v"]) == 0
    assert "fact 8" in capsys.readouterr().err


def test_the_log_as_json_has_the_same_fields_in_every_line(capsys: Said) -> None:
    assert main(["ingest", "room.mp4", "--log-format", "json"]) == 0
    said = capsys.readouterr()
    rows = [json.loads(line) for line in said.err.splitlines()]
    assert all(list(row)[:7] == ["time", "level", "stage", "event", "done", "total", "message"]
               for row in rows)
    assert [(row["event"], row["stage"]) for row in rows] == [
        ("start", "ingest"), ("done", "ingest")]
    assert said.out.startswith("ingest (")
    assert main(["train", "--log-format", "json", "-w", "none"]) == 4
    row = json.loads(capsys.readouterr().err)
    assert (row["level"], row["event"], row["exit_code"]) == ("error", "error", 4)
    assert "recon ingest" in row["hint"]


def test_quiet_leaves_errors_and_the_table_that_was_asked_for(capsys: Said) -> None:
    assert main(["ingest", "room.mp4", "-q"]) == 0
    assert capsys.readouterr() == ("", "")
    for verb in ("sfm", "train", "eval"):
        assert main([verb, "-q"]) == 0
    assert capsys.readouterr() == ("the table of evaluate\n\n", "")
    assert main(["train", "-q", "-w", "none"]) == 4
    assert_facts(capsys.readouterr().err, "error", "train", "ingest")


def test_json_is_one_object_with_the_stages_that_ran_and_their_files(capsys: Said) -> None:
    main(["ingest", "room.mp4"])
    main(["sfm"])
    capsys.readouterr()
    assert main(["train", "--json"]) == 0
    said = capsys.readouterr()
    value = json.loads(said.out)
    assert (value["verb"], value["exit_code"]) == ("train", 0)
    assert value["workspace"] == str(Path("workspace").absolute())
    assert [(stage["name"], stage["ran"]) for stage in value["stages"]] == [("train", True)]
    assert value["stages"][0]["summary"]["steps"] == fake_stages.STEPS
    assert "train/result.txt" in value["files"]
    assert "train (" in said.err  # people still see it in the log
    assert main(["train", "--json", "-q"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["stages"][0]["ran"] is False
    assert json.loads(said.out)["files"] == []
    assert said.err == ""


def test_json_keeps_the_text_of_a_verb_that_prints_some(capsys: Said) -> None:
    for verb in (["ingest", "room.mp4"], ["train"]):
        main(verb)
    capsys.readouterr()
    assert main(["eval", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["output"] == ["the table of evaluate", ""]


@pytest.mark.parametrize(("words", "code", "error"), [
    (["train", "-w", "none"], 4, "train needs ingest"),
    (["train", "--iteratons", "3"], 2, "No such option"),
    (["train", "--iterations", "many"], 2, "not a valid integer"),
    (["ingest", "none.mp4"], 3, "does not exist"),
])
def test_a_failure_is_an_object_too(
    words: list[str], code: int, error: str, capsys: Said
) -> None:
    assert main([*words, "--json"]) == code
    value = json.loads(capsys.readouterr().out)
    assert value["exit_code"] == code
    assert error in value["error"]
    assert value["hint"]


def test_a_variable_counts_as_a_typed_option_which_wins_over_it(
    monkeypatch: pytest.MonkeyPatch, capsys: Said
) -> None:
    main(["ingest", "room.mp4"])
    for name, text in [("ITERATIONS", "7"), ("SEED", "3"), ("EARLY_STOP", "0"), ("PRUNE", "1"),
                       ("RATIO", "0.25"), ("SH_DEGREE", "")]:
        monkeypatch.setenv(f"RECON_TRAIN_{name}", text)
    assert main(["train", "--seed", "4"]) == 0
    train = config_of("train")
    assert (train["iterations"], train["seed"], train["early_stop"]) == (7, 4, False)
    assert train["sh_degree"] is None  # an empty variable is none
    assert config_of("prune")["ratio"] == 0.25
    capsys.readouterr()
    assert main(["status", "--json"]) == 0  # no other verb reads them
    assert json.loads(capsys.readouterr().out)["stages"][3]["state"] == "fresh"


@pytest.mark.integration
def test_the_workspace_keeps_its_variable_and_a_list_has_spaces_between(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("RECON_WORKSPACE", "two")
    monkeypatch.setenv("RECON_RUN_SET", "train.iterations=5 train.seed=2")
    assert main(["run", "room.mp4"]) == 0
    train = json.loads(Path("two/train/manifest.json").read_text())["config"]
    assert (train["iterations"], train["seed"]) == (5, 2)


@pytest.mark.parametrize(("name", "text", "words"), [
    ("RECON_TRAIN_ITERATIONS", "many", ["train"]),
    ("RECON_TRAIN_BLOCKS", "some", ["train"]),
    ("RECON_INGEST_HOLDOUT", "all", ["ingest", "room.mp4"]),
    ("RECON_TRAIN_DEVICE", "cuda:x", ["train"]),
    ("RECON_RUN_SET", "train.iteratons=5", ["run", "room.mp4"]),
    ("RECON_TRAIN_RATIO", "0.5", ["train"]),
])
def test_a_wrong_value_names_its_variable(
    name: str, text: str, words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: Said
) -> None:
    monkeypatch.setenv(name, text)
    assert main(words) == 2
    assert_facts(capsys.readouterr().err, name, "environment")


def test_a_command_that_recon_starts_reads_no_variable_of_an_option(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kept = {"RECON_CACHE_DIR": "/cache", "RECON_WORKSPACE": "/ws", "RECON_GPU": "cuda:1"}
    environment = {"PATH": "/bin", **kept}
    monkeypatch.setattr(os, "environ", {
        **environment, "RECON_RUN_SET": "x", "RECON_TRAIN_JSON": "1"})
    forget_options()
    assert os.environ == environment


@pytest.mark.parametrize(("visible", "device", "seen"), [
    ("", "cuda:1", "1"), ("4,5", "cuda:1", "5"), ("GPU-a,GPU-b", "cuda:0", "GPU-a")])
def test_one_gpu_is_all_that_cuda_sees(
    visible: str, device: str, seen: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)  # and so put back in the end
    if not visible:
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setenv("RECON_GPU", "")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(registry, "_why_no_triton", lambda: "")
    for _ in range(2):  # a process that this one starts asks again
        assert registry.resolve("torch", device) == ("torch", "cuda")
        assert os.environ["CUDA_VISIBLE_DEVICES"] == seen


@pytest.mark.parametrize(("count", "there"), [(0, "no CUDA device"), (2, "cuda:0, cuda:1")])
def test_a_gpu_that_is_not_there_is_an_error_with_those_that_are(
    count: int, there: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RECON_GPU", raising=False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    with raises(BackendError, "cuda:2", there):
        registry.resolve("auto", "cuda:2")
