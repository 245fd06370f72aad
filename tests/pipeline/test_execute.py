"""The modules of later stages are imported while a stage leaves a core idle."""

import dataclasses
import sys
import threading

import fake_stages
import pytest
from fake_stages import TABLE, bring, job_at

from recon_cli.config.stages import ComputeConfig
from recon_cli.errors import InputError, SfmError
from recon_cli.pipeline.execute import importing_ahead
from recon_cli.render import registry
from recon_cli.workspace.records import Frame, FrameList, Group


@pytest.fixture
def rows(tmp_path, monkeypatch):
    """Returns a table whose training stage stands in a module of the test."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "late_stage.py").write_text(
        "import threading\nTHREAD = threading.get_ident()\nrun = 1")
    yield tuple(dataclasses.replace(row, module="late_stage") if row.name == "train" else row
                for row in TABLE)
    sys.modules.pop("late_stage", None)


def test_the_next_stage_that_renders_is_imported_in_a_thread(tmp_path, rows):
    job = dataclasses.replace(job_at(tmp_path), table=rows, asked=("sfm", "train", "prune"))
    with importing_ahead(job) as while_idle:
        assert "late_stage" not in sys.modules
        while_idle()
    assert threading.get_ident() != sys.modules["late_stage"].THREAD


def test_kernels_are_loaded_where_they_are_compiled(tmp_path, rows, monkeypatch):
    job = dataclasses.replace(
        job_at(tmp_path), table=rows, asked=("train",), compute=ComputeConfig(device="cpu"))
    prepared = []
    monkeypatch.setattr(registry, "prepare", lambda name, _: prepared.append(name) or 0.0)
    for to_compile in (12, 0):
        monkeypatch.setattr(registry, "kernels_to_compile", lambda _, left=to_compile: left)
        with importing_ahead(job) as while_idle:
            while_idle()
        assert prepared == ["numba"] * (to_compile == 0)


@pytest.mark.parametrize("asked", [(), ("ingest", "sfm")])
def test_nothing_is_imported_for_stages_that_do_not_render(tmp_path, rows, asked):
    job = dataclasses.replace(job_at(tmp_path), table=rows, asked=asked)
    with importing_ahead(job) as while_idle:
        while_idle()
    assert "late_stage" not in sys.modules


def test_what_cannot_be_imported_fails_where_it_is_needed(tmp_path, rows):
    (tmp_path / "late_stage.py").write_text("raise RuntimeError('half installed')")
    job = dataclasses.replace(job_at(tmp_path), table=rows, asked=("train",))
    with importing_ahead(job) as while_idle:
        while_idle()
    assert "late_stage" not in sys.modules


def test_the_error_of_a_stage_names_photos_by_their_own_files(tmp_path, monkeypatch):
    job = job_at(tmp_path / "ws")
    source = tmp_path / "room.mp4"
    source.write_bytes(b"a video")
    bring(job, "ingest", video=source)
    FrameList("photos", (Group("room", 60, 40),), (
        Frame("000000.png", None, "28.jpg", None, held_out=False),)).write(
            job.workspace.folder("ingest"))

    def fail():
        raise SfmError("000000.png is blurred.", hint="Take 000000.png anew.")

    monkeypatch.setitem(fake_stages.actions, "denoise", fail)
    with pytest.raises(SfmError) as caught:
        bring(job, "denoise")
    assert (caught.value.message, caught.value.hint) == ("28.jpg is blurred.", "Take 28.jpg anew.")


def test_a_capture_that_is_refused_leaves_no_unfinished_work(tmp_path, monkeypatch):
    job = job_at(tmp_path / "ws")
    source = tmp_path / "room.mp4"
    source.write_bytes(b"a video")

    def end_by(error):
        def run(_config, _inputs, _out, ctx):
            ctx.record(1, 6)
            raise error

        monkeypatch.setattr(fake_stages, "run", run)

    end_by(InputError("It is dark."))
    with pytest.raises(InputError):
        bring(job, "ingest", video=source)
    assert not job.workspace.root.exists()
    end_by(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        bring(job, "ingest", video=source)
    assert job.workspace.partial_run("ingest").done == 1
    end_by(InputError("It is dark."))
    with pytest.raises(InputError):
        bring(job, "ingest", video=source)
    assert job.workspace.partial_run("ingest").done == 1, "work of an earlier run is not lost"
