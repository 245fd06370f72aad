"""`recon report` in process: what it writes, where it does not, and what it says is amiss."""

import dataclasses
import errno
import json
import os
import re
import shutil

import numpy as np
import pytest
from facts import assert_facts
from jinja2 import ChoiceLoader, DictLoader
from report_workspace import RUN, TABLE, change, page_of, report, section

from recon_cli.cli import main
from recon_cli.io.images import write_png
from recon_cli.report import build
from recon_cli.report.sections import SECTIONS, Section
from recon_cli.workspace import atomic
from recon_cli.workspace.digests import read_source
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.manifest import Manifest, PartialRun

pytestmark = pytest.mark.floors

STALE = "The result shown here is out of date"


def files(workspace):
    return {path: path.read_bytes() for path in workspace.rglob("*")
            if path.is_file() and path.name != "report.html"}


@pytest.mark.integration
def test_the_page_is_one_file_and_nothing_else_changes(workspace, capsys):
    before = files(workspace)
    assert report(workspace) == 0
    assert str(workspace / "report.html") in capsys.readouterr().out
    assert files(workspace) == before
    assert main(["status", "--json", "-w", str(workspace)]) == 0
    states = {stage["state"] for stage in json.loads(capsys.readouterr().out)["stages"]}
    assert states == {"fresh"}


@pytest.mark.integration
def test_the_page_shows_what_the_stages_say(workspace):
    page = page_of(workspace)
    metrics = json.loads((workspace / "evaluate" / "metrics.json").read_text())
    for model in metrics["models"].values():
        assert f"{model['psnr_db']:.2f}" in section(page, "scores")
        for view in model["views"]:
            assert f"{view['psnr_db']:.2f}" in section(page, "scores")
    low = metrics["pruned_minus_base"]["psnr_db"]["low"]
    assert f"{low:+.2f} to " in section(page, "scores")
    assert_facts(page, "trusted", "12 of 12")
    assert "splats.spz" in section(page, "exports")
    settings = section(page, "settings")
    assert f"room.mp4 -w {workspace}\n" in settings
    assert "recon train --iterations 60 " in settings
    assert_facts(settings, "sfm 0", "train 0")
    assert_facts(section(page, "overview"), "88%")
    for lacking in ("is stale", "is missing", "is not shown", "are not shown"):
        assert lacking not in page


@pytest.mark.integration
def test_every_option_of_every_stage_is_there_with_what_was_decided(workspace):
    settings = section(page_of(workspace), "settings")
    for row in TABLE:
        config = json.loads((workspace / row.name / "manifest.json").read_text())["config"]
        for name in config:
            assert f'<th scope="row">{name}</th>' in settings
    decided = json.loads((workspace / "train" / "config.json").read_text())["max_size"]
    assert f'max_size</th><td class="text">automatic</td><td class="text">{decided}<' in settings


def test_a_section_is_a_row_and_its_template(workspace, monkeypatch):
    templates = ChoiceLoader([DictLoader({"new.html.j2": "<p>{{ steps }} steps</p>"}),
                              build._environment().loader])
    monkeypatch.setattr(build._environment(), "loader", templates)
    row = Section("new", "A new one", ("train",), lambda stages, _: {
        "steps": stages["train"].summary["iterations"]})
    monkeypatch.setattr(build, "SECTIONS", (*SECTIONS, row))
    (workspace / "recon.toml").write_text("[train]\niterations = 7\n")
    page = page_of(workspace)
    made = section(page, "new")
    assert f"<p>{RUN['iterations']} steps</p>" in made
    assert "<h2>A new one</h2>" in made
    assert "<strong>train is stale</strong>" in made
    names = [row.name for row in SECTIONS] + ["new"]
    assert re.findall(r'role="tab" [^>]*aria-controls="(\w+)"', page) == names
    assert re.findall(r'<section [^>]*id="(\w+)"', page) == names


def test_an_empty_workspace_is_4_and_names_the_first_command(tmp_path, capsys):
    assert report(tmp_path / "none") == 4
    said = capsys.readouterr().err
    assert_facts(said, "error:", "report", "ingest")
    assert_facts(said, "hint:", "recon ingest VIDEO")
    assert not (tmp_path / "none").exists()


def test_what_is_missing_is_said_in_its_place_with_the_command(workspace):
    for row in TABLE[1:]:
        shutil.rmtree(workspace / row.name)
    page = page_of(workspace)
    for name, stage, command in (
            ("capture", "sfm", "sfm"), ("training", "train", "train"),
            ("scores", "evaluate", "eval"), ("views", "evaluate", "eval"),
            ("exports", "export", "export"), ("pruning", "prune", "prune")):
        assert_facts(section(page, name), stage, "missing")
        assert f"<code>recon {command} -w {workspace}</code>" in section(page, name)
    assert "<svg" not in section(page, "training")
    assert STALE not in page


@pytest.mark.integration
def test_no_section_shows_figures_of_a_stale_stage_without_saying_so(workspace):
    (workspace / "recon.toml").write_text("[train]\niterations = 7\n")
    page = page_of(workspace)
    for name, stages in {
            "overview": ("train", "prune", "evaluate", "export"), "training": ("train", "prune"),
            "views": ("evaluate",), "scores": ("evaluate",), "pruning": ("prune",),
            "exports": ("export",), "settings": ("train", "prune", "evaluate", "export")}.items():
        for stage in stages:
            assert f"<strong>{stage} is stale</strong>" in section(page, name)
        assert STALE in section(page, name)
    assert "training (stale)" in section(page, "training")
    head = page[:page.index('role="tablist"')]
    # the word, PSNR, the well seen share, Gaussians and time; cameras are fresh
    assert head.count('class="tag">stale') == 5
    assert_facts(page, "train.iterations", "60 -&gt; 7")


@pytest.mark.integration
def test_scores_that_were_changed_by_hand_are_stale_and_may_hold_anything(workspace):
    metrics = workspace / "evaluate" / "metrics.json"
    change(metrics, lambda value: value["models"]["base"].update(psnr_db=99.0))
    scores = section(page_of(workspace), "scores")
    assert "99.00" in scores
    assert "(stale)" in section(page_of(workspace), "training")
    assert_facts(scores, "metrics.json", "hand")
    for content in ("{", "[]", '{"models": {"base": {"views": 3}}}',
                    '{"models": {"base": {"psnr_db": NaN}}}'):
        metrics.write_text(content)
        page = page_of(workspace)
        for name in ("scores", "views"):
            assert_facts(section(page, name), "scores", "not shown")


@pytest.mark.integration
def test_a_log_that_cannot_be_read_is_said_in_its_place(workspace):
    (workspace / "train" / "log.jsonl").write_text('{"iteration": "many"}\n')
    training = section(page_of(workspace), "training")
    assert_facts(training, "train", "not shown", "log.jsonl")
    assert "after pruning" in training  # which has a log of its own


@pytest.mark.integration
def test_a_log_that_was_changed_or_is_gone_is_said_in_its_place(workspace):
    log = workspace / "train" / "log.jsonl"
    log.write_text("".join(log.read_text().splitlines(True)[:-1]))
    assert_facts(section(page_of(workspace), "training"), "log", "train", "changed")
    log.unlink()
    assert_facts(section(page_of(workspace), "training"), "log.jsonl", "train", "not shown")


@pytest.mark.integration
def test_pictures_that_are_gone_are_said_and_the_others_are_shown(workspace):
    (workspace / "evaluate" / "truth" / "000004.png").unlink()
    (workspace / "evaluate" / "renders" / "base" / "000008.png").write_bytes(b"no picture")
    views = section(page_of(workspace), "views")
    for name in ("000004.png", "000008.png"):
        assert_facts(views, name, "not shown")
    assert views.count('class="shot"') == 1
    shutil.rmtree(workspace / "evaluate" / "truth")
    assert 'class="shot"' not in section(page_of(workspace), "views")


@pytest.mark.integration
def test_a_damaged_manifest_is_said_and_a_damaged_first_one_is_7(workspace, capsys):
    (workspace / "train" / "manifest.json").write_text("{")
    page = page_of(workspace)
    assert_facts(section(page, "training"), "train", "damaged")
    assert_facts(section(page, "training"), f"recon train --again -w {workspace}")
    assert "<svg" not in section(page, "scores")
    (workspace / "ingest" / "manifest.json").write_text("{")
    assert report(workspace) == 7
    assert "`recon clean ingest" in capsys.readouterr().err


@pytest.mark.integration
def test_an_unfinished_run_is_said(workspace):
    place = Workspace(workspace)
    key = Manifest.read(workspace / "train").key
    shutil.rmtree(workspace / "train")
    place.begin(key)
    place.record(PartialRun(key, 3, 10))
    training = section(page_of(workspace), "training")
    assert_facts(training, "train", "unfinished", "3 of 10")
    assert_facts(training, "recon train --iterations 60")


@pytest.mark.integration
def test_a_damaged_model_leaves_out_the_plan_alone(workspace):
    (workspace / "place" / "undistorted" / "sparse" / "images.bin").write_bytes(b"short")
    capture = section(page_of(workspace), "capture")
    assert_facts(capture, "plan", "not shown")
    assert 'class="plan"' not in capture
    assert "<figcaption>000000.png</figcaption>" in capture  # thumbnails, without a sheet


@pytest.mark.integration
def test_contact_sheets_take_the_place_of_thumbnails_and_many_are_counted(workspace):
    for number in range(6):
        write_png(workspace / "ingest" / f"{number:02d}_contact.png",
                  np.full((30, 40, 3), 9, np.uint8))
    capture = section(page_of(workspace), "capture")
    assert capture.count('alt="Contact sheet of the capture"') == 4
    assert_facts(capture, 2, "contact", "ingest/")
    assert "<figcaption>000000.png</figcaption>" not in capture


@pytest.mark.integration
def test_what_is_fixed_to_the_camera_is_shown(workspace):
    masked = 'alt="A frame with the masked area in red"'
    assert masked not in section(page_of(workspace), "capture")
    write_png(workspace / "ingest" / "overlay.png", np.full((30, 40, 3), 9, np.uint8))
    assert section(page_of(workspace), "capture").count(masked) == 1
    (workspace / "ingest" / "overlay.png").write_bytes(b"short")
    capture = section(page_of(workspace), "capture")
    assert_facts(capture, "Masked", "not shown")
    assert "<figcaption>000000.png</figcaption>" in capture  # the frames still are


def test_frames_without_a_camera_are_lost_in_the_legend(workspace):
    def edit(value):
        value["frames"].append({**value["frames"][-1], "name": "000099.png"})

    change(workspace / "ingest" / "frames.json", edit)
    capture = section(page_of(workspace), "capture")
    assert_facts(capture, 1, "camera")
    assert "000099.png (lost" in capture


@pytest.mark.integration
def test_a_part_that_was_left_out_is_said_with_its_place_in_the_video(workspace):
    added = [f"00009{i}.png" for i in range(4)]

    def add_frames(value):
        value["frames"] += [
            {**value["frames"][-1], "name": name, "time_seconds": 9 + i / 2, "held_out": i == 1}
            for i, name in enumerate(added)]

    change(workspace / "ingest" / "frames.json", add_frames)
    manifest = Manifest.read(workspace / "place")
    broken = "The model is broken between 000008.png and 000090.png."
    summary = {**manifest.run.summary, "left_out": added[:3],
               "lines": [broken, *manifest.run.summary["lines"]]}
    dataclasses.replace(
        manifest, run=dataclasses.replace(manifest.run, summary=summary)).write(workspace / "place")
    change(workspace / "evaluate" / "metrics.json", lambda value: value.update(
        frames=16, training_views=8, unregistered=added, unregistered_test=added[1:2]))
    page = page_of(workspace)
    assert "3 left out</dd>" in page  # of the figures in the head
    assert broken in section(page, "overview")
    capture = section(page, "capture")
    assert_facts(capture, 3, "trusted", 1, "held", "000090.png", "000092.png", "9.0", "10.0 s")
    assert_facts(capture, "3 left", "1 without")  # the legend
    assert_facts(capture, "000091.png (left", "9.5 s")
    assert_facts(section(page, "scores"), "8 of 16", 4, 1, "scored")


@pytest.mark.parametrize("place", ["train/report.html", "evaluate/truth/a.html", ".partial/a.html"])
def test_a_page_in_the_folder_of_a_stage_is_refused(workspace, place, capsys):
    assert report(workspace, "-o", workspace / place) == 2
    assert_facts(capsys.readouterr().err, "error:", workspace / place)
    assert not (workspace / place).exists()


def test_a_page_among_the_inputs_would_be_one_of_them(workspace, tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    manifest = Manifest.read(workspace / "ingest")
    source = read_source(tmp_path / "photos", without=workspace)
    dataclasses.replace(manifest, key=dataclasses.replace(
        manifest.key, sources=(source,))).write(workspace / "ingest")
    assert report(workspace, "-o", tmp_path / "photos" / "report.html") == 2
    assert_facts(capsys.readouterr().err, "error:", tmp_path / "photos")
    assert list((tmp_path / "photos").iterdir()) == []


@pytest.mark.integration
def test_a_file_name_that_is_no_utf8_is_shown_as_it_can_be(workspace):
    manifest = Manifest.read(workspace / "ingest")
    source = dataclasses.replace(manifest.key.sources[0], path="/gone/b\udcff.mp4")
    dataclasses.replace(manifest, key=dataclasses.replace(
        manifest.key, sources=(source,))).write(workspace / "ingest")
    page = page_of(workspace)
    assert_facts(section(page, "overview"), "/gone/b\\udcff.mp4")
    assert_facts(page, "video:", "b\\udcff.mp4")


@pytest.mark.parametrize("name", ["room.mp4", "report", "folder.html"])
def test_what_is_no_page_is_refused_and_left_as_it_was(workspace, tmp_path, name, capsys):
    (tmp_path / "folder.html").mkdir()
    (tmp_path / "room.mp4").write_text("a video")
    assert report(workspace, "-o", tmp_path / name) == 2
    said = capsys.readouterr().err
    assert_facts(said, "error:", tmp_path / name, "HTML")
    assert_facts(said, "hint:", ".html")
    assert (tmp_path / "room.mp4").read_text() == "a video"


@pytest.mark.integration
def test_a_page_goes_where_it_is_told(workspace, tmp_path):
    assert report(workspace, "-o", tmp_path / "new" / "room.HTML") == 0
    assert (tmp_path / "new" / "room.HTML").stat().st_size > 10_000
    assert not (workspace / "report.html").exists()


@pytest.mark.integration
@pytest.mark.parametrize(("number", "said"), [
    (errno.ENOSPC, "The disk is full"), (errno.EACCES, "not writable"),
    (errno.EIO, "cannot be written")])
def test_a_disk_that_fails_leaves_the_old_page(workspace, monkeypatch, number, said, capsys):
    old = page_of(workspace)

    def fail(_descriptor):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(atomic.os, "fsync", fail)
    assert report(workspace) == 7
    assert said in capsys.readouterr().err
    assert (workspace / "report.html").read_text(encoding="utf-8") == old
    assert not list(workspace.glob(".report*"))


def test_a_page_that_is_a_link_to_itself_is_replaced(workspace):
    (workspace / "report.html").unlink(missing_ok=True)
    (workspace / "report.html").symlink_to("report.html")
    assert report(workspace) == 0
    assert not (workspace / "report.html").is_symlink()
    assert "<html" in (workspace / "report.html").read_text()


def test_a_place_that_cannot_be_is_an_error_that_says_so(workspace, tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    assert report(workspace, "-o", tmp_path / "file" / "report.html") == 7
    assert_facts(capsys.readouterr().err, "hint:", "-o")


@pytest.mark.integration
def test_the_whole_file_stays_within_its_bounds(workspace, monkeypatch):
    rng = np.random.default_rng(0)
    for path in (workspace / "evaluate").rglob("*.png"):
        write_png(path, rng.integers(0, 256, (300, 400, 3)).astype(np.uint8))
    page = page_of(workspace)
    assert_facts(section(page, "views"), "400x300")
    assert "evaluate scored" not in page
    limit = int(0.4 * len(page.encode()))
    monkeypatch.setattr(build, "MAX_FILE_BYTES", limit)
    page = page_of(workspace)
    assert len(page.encode()) <= limit
    assert_facts(page, "evaluate scored", "400x300")


def test_the_page_calls_photos_by_their_own_names_escaped(workspace):
    def name(frames):
        for index, frame in enumerate(frames["frames"]):
            frame.update(time_seconds=None, source=f"<b>&{index}.jpg")

    change(workspace / "ingest" / "frames.json", name)
    page = page_of(workspace)
    names = [frame["name"] for frame in json.loads(
        (workspace / "ingest" / "frames.json").read_text())["frames"]]
    assert not [one for one in names if one in page]
    assert "&lt;b&gt;&amp;" in page
    assert "<b>&" not in page
