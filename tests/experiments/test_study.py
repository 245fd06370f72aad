"""The study on a tiny scene: what is kept, what is made again, and the command around it."""

import dataclasses
import importlib.util
import json

import pytest
from facts import assert_facts, raises
from posed_sets import make_replica
from tiny_scene import make_inputs

from recon_cli.cli import main
from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.errors import FormatError
from recon_cli.experiments import runner
from recon_cli.experiments.runner import (
    RECORDS_FILE,
    CurvePoint,
    key_of,
    open_records,
    run_trial,
)
from recon_cli.experiments.scenes import SceneFolders, load_for_training
from recon_cli.experiments.study import (
    EQUAL_SECONDS,
    EQUAL_STEPS,
    VARIANTS,
    Study,
    StudyRequest,
    StudyResult,
    correct_steps,
    equal_seconds,
)
from recon_cli.experiments.variants import TrainingRun
from recon_cli.io.training_scene import PlacedCapture
from recon_cli.progress import NullProgress

STEPS = 20
BASE = RunConfig(
    iterations=1, max_size=48, max_gaussians=80, densify_every=5, validation=0.0)
COSTS = {"reference": 0.5, "paper": 0.4, "budget": 0.25, "budget-pruned": 0.2}  # seconds a step


@pytest.fixture
def scene(tmp_path):
    folders = SceneFolders("tiny", PlacedCapture.read(make_inputs(tmp_path / "tiny").folders))
    return load_for_training(folders, "test", BASE, StageContext(backend="numba"))


@pytest.fixture
def made(monkeypatch):
    """Gives runs the seconds of COSTS, and lists which were made; `made.stop_at` kills one."""
    class Made(list):
        stop_at = None

    runs = Made()

    def run_timed(loaded, run, score_at, *, on_step):
        if len(runs) == runs.stop_at:
            raise KeyboardInterrupt
        runs.append((run.variant.name, run.iterations, run.seed))
        points = run_trial(loaded, run, score_at, on_step=on_step)
        seconds = COSTS[run.variant.name] * run.iterations
        return tuple(dataclasses.replace(point, seconds=seconds, cpu_seconds=2 * seconds)
                     for point in points)

    monkeypatch.setattr(runner, "run_trial", run_timed)
    return runs


def values(scene, comparison, variant, figure):
    """Returns a figure by seed."""
    return StudyResult(None, 1, BASE, "wall", {"tiny": scene}, {}).values(
        "tiny", comparison, variant, figure)


def work(folder, seeds=2, **changes):
    folder.mkdir(exist_ok=True)
    request = StudyRequest(
        scenes=(), seeds=seeds, iterations=STEPS, base=BASE, out=folder, **changes)
    return Study(request, open_records(folder), NullProgress(), "a machine")


# ---- equal seconds ----

def test_cheaper_steps_give_more_of_them():
    assert equal_seconds(100, {"a": 10.0, "b": 5.0, "c": 4.0}) == {"a": 100, "b": 200, "c": 250}
    assert equal_seconds(100, {"a": 10.0, "b": 0.0}) == {"a": 100, "b": 100}


def test_a_guess_is_corrected_on_the_line_through_two_runs():
    # 100 steps in 4 s and 250 in 13 s: 6 s for 100 steps, so that 10 s hold 200
    assert correct_steps(100, 250, 4.0, 13.0, 10.0) == 200
    assert correct_steps(100, 250, 4.0, 10.4, 10.0) == 250  # near enough
    assert correct_steps(100, 100, 10.0, 12.0, 10.0) == 100  # the slowest arm
    assert correct_steps(100, 250, 4.0, 3.0, 10.0) == 250  # a line that falls says nothing


@pytest.mark.integration
def test_arms_whose_steps_grow_dearer_still_take_the_same_seconds(
    scene, made, tmp_path, monkeypatch
):
    class Dearer(float):
        def __mul__(self, steps):  # 0.25 s a step at first, 0.5 s after the first 20
            return 0.25 * steps + 0.25 * max(0, steps - STEPS)

    monkeypatch.setitem(COSTS, "budget", Dearer())
    studied = work(tmp_path / "out", seeds=2).run_scene(scene)
    assert values(studied, EQUAL_SECONDS, VARIANTS[2], "steps") == [30, 30]
    assert values(studied, EQUAL_SECONDS, VARIANTS[2], "seconds") == pytest.approx([10.0, 10.0])
    assert made.count(("budget", 40, 0)) == 1  # the guess


@pytest.mark.integration
def test_arms_take_the_steps_that_fit_into_the_seconds_of_the_slowest(scene, made, tmp_path):
    studied = work(tmp_path / "out", seeds=1).run_scene(scene)
    expected = {"reference": 20, "paper": 25, "budget": 40, "budget-pruned": 50}
    for variant in VARIANTS:
        assert values(studied, EQUAL_STEPS, variant, "steps") == [STEPS]
        assert values(studied, EQUAL_SECONDS, variant, "steps") == [expected[variant.name]]
        assert values(studied, EQUAL_SECONDS, variant, "seconds") == pytest.approx([10.0])
    # the slowest arm's run serves both comparisons
    assert made.count(("reference", STEPS, 0)) == 1
    assert len(made) == 7


@pytest.mark.integration
def test_steps_at_equal_seconds_stay_fixed_when_seeds_are_added(
    scene, made, tmp_path, monkeypatch
):
    work(tmp_path / "out", seeds=1).run_scene(scene)
    monkeypatch.setitem(COSTS, "budget", 0.1)  # a quieter hour
    studied = work(tmp_path / "out", seeds=2).run_scene(scene)
    assert values(studied, EQUAL_SECONDS, VARIANTS[2], "steps") == [40, 40]
    assert [one[2] for one in made] == [0] * 7 + [1] * 7


@pytest.mark.integration
def test_the_seconds_that_are_made_equal_can_be_chosen(scene, made, tmp_path):
    for clock in ("wall", "cpu"):
        work(tmp_path / "out", seeds=1, clock=clock).run_scene(scene)
    assert len(made) == 7  # the same ratios: steps are fixed anew, runs are taken again
    lines = (tmp_path / "out" / RECORDS_FILE).read_text().splitlines()
    assert sum("steps" in json.loads(line)["result"] for line in lines) == 2


# ---- resuming ----

@pytest.mark.integration
@pytest.mark.parametrize("stop_at", [0, 3, 10, 13])
def test_a_study_that_was_killed_gives_the_same_figures(scene, made, tmp_path, stop_at):
    whole = work(tmp_path / "whole").run_scene(scene)
    once = list(made)
    made.clear()
    made.stop_at = stop_at
    with pytest.raises(KeyboardInterrupt):
        work(tmp_path / "killed").run_scene(scene)
    made.stop_at = None
    assert work(tmp_path / "killed").run_scene(scene).runs == whole.runs
    assert sorted(made) == sorted(once)  # nothing twice


@pytest.mark.integration
def test_the_time_is_estimated_before_the_second_scene_is_loaded(scene, made, tmp_path, caplog):
    def loading():
        assert_facts(caplog.text, 16, 20, "runs", "steps")
        yield scene
        assert_facts(caplog.text, "minutes", "short", "runs")
        yield scene

    assert work(tmp_path / "out", seeds=1).load(loading(), 2) == [scene, scene]
    assert_facts(caplog.text, 16, 0, "runs", "made")
    work(tmp_path / "out", seeds=1).run_scene(scene)
    caplog.clear()
    work(tmp_path / "out", seeds=1).load([scene], 1)
    assert_facts(caplog.text, 8, "runs", "kept")
    assert "minutes" not in caplog.text
    assert made


@pytest.mark.integration
def test_a_line_that_a_kill_cut_short_is_dropped(scene, made, tmp_path):
    one = work(tmp_path / "out", seeds=1)
    first = one.run_scene(scene)
    path = tmp_path / "out" / RECORDS_FILE
    text = path.read_text()
    lines = text.splitlines(True)
    path.write_text("".join(lines[:-2]) + lines[-2][:40])  # the last one holds the fixed steps
    made.clear()
    assert work(tmp_path / "out", seeds=1).run_scene(scene).runs == first.runs
    assert len(made) == 1
    assert path.read_text() == text


def test_a_line_that_is_damaged_inside_is_refused(tmp_path):
    (tmp_path / RECORDS_FILE).write_text("{}\n")
    with raises(FormatError, 1, "line"):
        open_records(tmp_path)


def test_a_key_tells_everything_apart_that_decides(scene, monkeypatch):
    run = TrainingRun(VARIANTS[0], BASE, 20, 0)
    others = [
        dataclasses.replace(run, seed=1), dataclasses.replace(run, iterations=21),
        dataclasses.replace(run, variant=VARIANTS[1]),
        dataclasses.replace(run, base=dataclasses.replace(BASE, ssim_weight=0.1))]
    keys = {key_of(scene, one) for one in (run, *others)}
    folders = SceneFolders("other", scene.folders.capture)
    folders.__dict__["digest"] = "of other images"
    keys.add(key_of(dataclasses.replace(scene, folders=folders), run))
    keys.add(key_of(dataclasses.replace(scene, ctx=StageContext(backend="torch")), run))
    monkeypatch.setattr(runner, "__version__", "another")
    keys.add(key_of(scene, run))
    assert len(keys) == 8
    monkeypatch.undo()
    threads = dataclasses.replace(scene, ctx=StageContext(backend="numba", threads=9))
    assert key_of(threads, run) == key_of(scene, run)


def test_the_arms_are_those_of_the_paper_and_ours():
    configs = {
        variant.name: variant.config(BASE, iterations=30_000, seed=0) for variant in VARIANTS}
    assert [configs[variant.name].densify for variant in VARIANTS] == [
        "reference", "reference", "budget", "budget"]
    paper = VARIANTS[1].prune
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
    assert_facts(text, "Scores", "equal", "steps")
    assert_facts(text, "paper", "Table", "beside")
    assert (out / "study.svg").exists() == bool(importlib.util.find_spec("matplotlib"))
    assert (out / "scenes" / "office0" / "sfm" / "manifest.json").exists()


@pytest.mark.integration
def test_a_second_call_runs_nothing_and_says_the_same(studied, capsys, monkeypatch):
    base, words = studied
    monkeypatch.setattr(runner, "run_trial", lambda *_, **__: pytest.fail("ran"))
    before = (base / "out" / "study.md").read_bytes()
    assert main(words) == 0
    said = capsys.readouterr()
    assert (base / "out" / "study.md").read_bytes() == before
    assert_facts(said.err, 16, "runs", "kept")
    assert_facts(said.out, "Scores", "equal", "seconds")


@pytest.mark.integration
def test_an_interrupted_study_says_so(studied, tmp_path, capsys, monkeypatch):
    _, words = studied

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "run_trial", interrupt)
    monkeypatch.setattr(runner, "run_pilot", lambda *_: CurvePoint(1, 1, 1, 1, 1, 1, 1))
    assert main([*words, "--out", str(tmp_path / "new")]) == 130
    assert_facts(capsys.readouterr().err, "command", "again", "resume")
    assert not (tmp_path / "new" / "study.json").exists()


@pytest.mark.integration
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
    monkeypatch.setattr(Study, "run_scene", lambda *_: pytest.fail("ran"))
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    make_replica(tmp_path / "room", tests=0)
    assert main(["study", *words]) == code
    assert said in capsys.readouterr().err
