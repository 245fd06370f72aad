"""The study on a tiny scene: what is kept, what is made again, and the command around it."""

import dataclasses
import importlib.util
import json

import pytest
from posed_sets import make_replica
from tiny_scene import make_inputs

from recon_cli.cli import main
from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.errors import FormatError
from recon_cli.experiments import records as records_module
from recon_cli.experiments import study_run as work_module
from recon_cli.experiments import trial
from recon_cli.experiments.records import FILE, Record, Records, key_of
from recon_cli.experiments.scenes import Place
from recon_cli.experiments.study_result import ARMS, EQUAL_SECONDS, EQUAL_STEPS, Request
from recon_cli.experiments.study_run import Ground, Work, corrected, equal_seconds
from recon_cli.experiments.trial import Run, stand
from recon_cli.progress import NullProgress

STEPS = 20
BASE = RunConfig(
    iterations=1, max_size=48, max_gaussians=80, densify_every=5, validation=0.0)
COSTS = {"reference": 0.5, "paper": 0.4, "budget": 0.25, "budget-pruned": 0.2}  # seconds a step


@pytest.fixture
def ground(tmp_path):
    place = Place("tiny", make_inputs(tmp_path / "tiny"))
    return Ground(stand(place, "test", BASE, StageContext(backend="numba")), place.digest)


@pytest.fixture
def made(monkeypatch):
    """Gives runs the seconds of COSTS, and lists which were made; `made.stop_at` kills one."""
    class Made(list):
        stop_at = None

    found = Made()

    def run_timed(where, run, looks, *, on_step):
        if len(found) == found.stop_at:
            raise KeyboardInterrupt
        found.append((run.arm.name, run.iterations, run.seed))
        points = trial.run_trial(where, run, looks, on_step=on_step)
        seconds = COSTS[run.arm.name] * run.iterations
        return tuple(dataclasses.replace(point, seconds=seconds, cpu_seconds=2 * seconds)
                     for point in points)

    monkeypatch.setattr(work_module, "run_trial", run_timed)
    return found


def work(folder, seeds=2, **changes):
    folder.mkdir(exist_ok=True)
    request = Request((), seeds, STEPS, BASE, folder)
    return Work(dataclasses.replace(request, **changes), Records(folder), "a machine")


# ---- equal seconds ----

def test_cheaper_steps_give_more_of_them():
    assert equal_seconds(100, {"a": 10.0, "b": 5.0, "c": 4.0}) == {"a": 100, "b": 200, "c": 250}
    assert equal_seconds(100, {"a": 10.0, "b": 0.0}) == {"a": 100, "b": 100}


def test_a_guess_is_corrected_on_the_line_through_two_runs():
    # 100 steps in 4 s and 250 in 13 s: 6 s for 100 steps, so that 10 s hold 200
    assert corrected(100, 250, 4.0, 13.0, 10.0) == 200
    assert corrected(100, 250, 4.0, 10.4, 10.0) == 250  # near enough
    assert corrected(100, 100, 10.0, 12.0, 10.0) == 100  # the slowest arm
    assert corrected(100, 250, 4.0, 3.0, 10.0) == 250  # a line that falls says nothing


@pytest.mark.integration
def test_arms_whose_steps_grow_dearer_still_take_the_same_seconds(
    ground, made, tmp_path, monkeypatch
):
    class Dearer(float):
        def __mul__(self, steps):  # 0.25 s a step at first, 0.5 s after the first 20
            return 0.25 * steps + 0.25 * max(0, steps - STEPS)

    monkeypatch.setitem(COSTS, "budget", Dearer())
    found = work(tmp_path / "out", seeds=2).done(ground, NullProgress())
    assert found.values(EQUAL_SECONDS, ARMS[2], "steps") == [30, 30]
    assert found.values(EQUAL_SECONDS, ARMS[2], "seconds") == pytest.approx([10.0, 10.0])
    assert made.count(("budget", 40, 0)) == 1  # the guess


def test_arms_take_the_steps_that_fit_into_the_seconds_of_the_slowest(ground, made, tmp_path):
    found = work(tmp_path / "out", seeds=1).done(ground, NullProgress())
    expected = {"reference": 20, "paper": 25, "budget": 40, "budget-pruned": 50}
    for arm in ARMS:
        assert found.values(EQUAL_STEPS, arm, "steps") == [STEPS]
        assert found.values(EQUAL_SECONDS, arm, "steps") == [expected[arm.name]]
        assert found.values(EQUAL_SECONDS, arm, "seconds") == pytest.approx([10.0])
    # the slowest arm's run serves both comparisons
    assert made.count(("reference", STEPS, 0)) == 1
    assert len(made) == 7


def test_steps_at_equal_seconds_stay_fixed_when_seeds_are_added(
    ground, made, tmp_path, monkeypatch
):
    work(tmp_path / "out", seeds=1).done(ground, NullProgress())
    monkeypatch.setitem(COSTS, "budget", 0.1)  # a quieter hour
    found = work(tmp_path / "out", seeds=2).done(ground, NullProgress())
    assert found.values(EQUAL_SECONDS, ARMS[2], "steps") == [40, 40]
    assert [one[2] for one in made] == [0] * 7 + [1] * 7


def test_the_seconds_that_are_made_equal_can_be_chosen(ground, made, tmp_path):
    for clock in ("wall", "cpu"):
        work(tmp_path / "out", seeds=1, clock=clock).done(ground, NullProgress())
    assert len(made) == 7  # the same ratios: steps are fixed anew, runs are taken again
    lines = (tmp_path / "out" / FILE).read_text().splitlines()
    assert sum("steps" in json.loads(line)["value"] for line in lines) == 2


# ---- resuming ----

@pytest.mark.integration
@pytest.mark.parametrize("stop_at", [0, 3, 10, 13])
def test_a_study_that_was_killed_gives_the_same_figures(ground, made, tmp_path, stop_at):
    whole = work(tmp_path / "whole").done(ground, NullProgress())
    once = list(made)
    made.clear()
    made.stop_at = stop_at
    with pytest.raises(KeyboardInterrupt):
        work(tmp_path / "killed").done(ground, NullProgress())
    made.stop_at = None
    assert work(tmp_path / "killed").done(ground, NullProgress()).runs == whole.runs
    assert sorted(made) == sorted(once)  # nothing twice


@pytest.mark.integration
def test_what_is_kept_is_announced(ground, made, tmp_path):
    before = work(tmp_path / "out", seeds=1).announced([ground], NullProgress())
    assert before.startswith("about 8 runs are to be made, 0 are kept from before; about")
    work(tmp_path / "out", seeds=1).done(ground, NullProgress())
    after = work(tmp_path / "out", seeds=1).announced([ground], NullProgress())
    assert after == "all 8 runs are kept from before"
    assert made


@pytest.mark.integration
def test_a_line_that_a_kill_cut_short_is_dropped(ground, made, tmp_path):
    one = work(tmp_path / "out", seeds=1)
    first = one.done(ground, NullProgress())
    path = tmp_path / "out" / FILE
    text = path.read_text()
    lines = text.splitlines(True)
    path.write_text("".join(lines[:-2]) + lines[-2][:40])  # the last one holds the fixed steps
    made.clear()
    assert work(tmp_path / "out", seeds=1).done(ground, NullProgress()).runs == first.runs
    assert len(made) == 1
    assert path.read_text() == text


def test_a_line_that_is_damaged_inside_is_refused(tmp_path):
    (tmp_path / FILE).write_text("{}\n")
    with pytest.raises(FormatError, match="line 1"):
        Records(tmp_path)


def test_a_key_tells_everything_apart_that_decides(ground, monkeypatch):
    run = Run(ARMS[0], BASE, 20, 0)
    others = [
        dataclasses.replace(run, seed=1), dataclasses.replace(run, iterations=21),
        dataclasses.replace(run, arm=ARMS[1]),
        dataclasses.replace(run, base=dataclasses.replace(BASE, ssim_weight=0.1))]
    keys = {key_of(ground.stand, "a", one) for one in (run, *others)}
    keys.add(key_of(ground.stand, "b", run))
    torch = dataclasses.replace(ground.stand, ctx=StageContext(backend="torch"))
    keys.add(key_of(torch, "a", run))
    monkeypatch.setattr(records_module, "__version__", "another")
    keys.add(key_of(ground.stand, "a", run))
    assert len(keys) == 8
    monkeypatch.undo()
    threads = dataclasses.replace(ground.stand, ctx=StageContext(backend="numba", threads=9))
    assert key_of(threads, "a", run) == key_of(ground.stand, "a", run)


def test_a_record_comes_back_as_it_was(tmp_path):
    point = trial.Point(1, 2.0, 3.0, 4, 5, 6.789, 0.123)
    record = Record(point, "a machine", "original images, far")
    Records(tmp_path).add_run("key", record, Run(ARMS[0], BASE, 1, 0), "tiny")
    assert Records(tmp_path).run("key") == record
    assert Records(tmp_path).run("other") is None


def test_the_arms_are_those_of_the_paper_and_ours():
    configs = {arm.name: arm.config(BASE, iterations=30_000, seed=0) for arm in ARMS}
    assert [configs[arm.name].densify for arm in ARMS] == [
        "reference", "reference", "budget", "budget"]
    paper = ARMS[1].prune
    assert round(paper.at * 30_000) == 20_000
    assert (paper.config.ratio, paper.config.score) == (0.6, "paper")


# ---- the command ----

WORDS = ["--seeds", "2", "--iterations", "15", "--max-size", "32", "--max-gaussians", "200",
         "--threads", "1", "--device", "cpu"]


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    """A study of a data set of one of the paper's names, with what it says on both outputs."""
    base = tmp_path_factory.mktemp("study")
    make_replica(base / "office0", frames=8, tests=2)
    words = ["study", "--scenes", str(base / "office0"), "--out", str(base / "out"), *WORDS]
    assert main(words) == 0
    return base, words


@pytest.mark.integration
def test_the_command_leaves_tables_figures_and_a_picture(studied):
    base, _ = studied
    out = base / "out"
    record = json.loads((out / "study.json").read_text())
    assert record["seeds"] == 2
    assert record["scenes"]["office0"]["views"] == 2
    text = (out / "study.md").read_text()
    assert "### Scores at equal steps" in text
    assert "### The paper's Table I beside this study" in text
    assert (out / "study.svg").exists() == bool(importlib.util.find_spec("matplotlib"))
    assert (out / "scenes" / "office0" / "sfm" / "manifest.json").exists()


@pytest.mark.integration
def test_a_second_call_runs_nothing_and_says_the_same(studied, capsys, monkeypatch):
    base, words = studied
    monkeypatch.setattr(work_module, "run_trial", lambda *_, **__: pytest.fail("ran"))
    before = (base / "out" / "study.md").read_bytes()
    assert main(words) == 0
    said = capsys.readouterr()
    assert (base / "out" / "study.md").read_bytes() == before
    assert "all 16 runs are kept from before" in said.err
    assert "Scores at equal seconds" in said.out


@pytest.mark.integration
def test_an_interrupted_study_says_so(studied, tmp_path, capsys, monkeypatch):
    _, words = studied

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(work_module, "run_trial", interrupt)
    monkeypatch.setattr(work_module, "pilot", lambda *_, **__: trial.Point(1, 1, 1, 1, 1, 1, 1))
    assert main([*words, "--out", str(tmp_path / "new")]) == 130
    assert "run the same command again to resume" in capsys.readouterr().err
    assert not (tmp_path / "new" / "study.json").exists()


@pytest.mark.parametrize(("words", "code", "said"), [
    ([], 2, "No scene was given"),
    (["--scenes", "nothing"], 3, "does not exist"),
    (["--scenes", "empty"], 3, "neither a workspace with cameras nor a data set"),
    (["--scenes", "room", "--seeds", "0"], 2, "--seeds"),
    (["--scenes", "room", "--set", "train.validation=0.2"], 2, "has no effect here"),
    (["--scenes", "room", "--set", "compute.threads=2"], 2, "has no effect here"),
    (["--scenes", "room", "--out", "file"], 2, "--out"),
    (["--scenes", "room", "--out", "file/below"], 7, "cannot be made"),
    (["--scenes", "room", "--set", "ingest.holdout=none"], 5, "No held-out view"),
])
def test_what_cannot_be_done_is_refused_before_training(
    words, code, said, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("recon_cli.experiments.study_run.Work.done", lambda *_: pytest.fail("ran"))
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    make_replica(tmp_path / "room", tests=0)
    assert main(["study", *words]) == code
    assert said in capsys.readouterr().err
