"""`recon train --view`: the training is the same, and looks are rare where they cost much."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scenes import random_splats
from tiny_scene import make_inputs
from tiny_stages import CONFIG, CONTEXT, run
from viewing import complaints, nodes, until

from recon_cli.cli import main
from recon_cli.context import TrainCallback
from recon_cli.splats.ply import read_ply
from recon_cli.stages import train
from recon_cli.viewer import live
from recon_cli.viewer.live import SHARE, LiveView
from recon_cli.viewer.server import HOST, start_server
from recon_cli.workspace.layout import Workspace

SHORT = replace(CONFIG, iterations=60)


class Spy(TrainCallback):
    """Remembers what it was told."""

    def __init__(self):
        self.begun, self.steps, self.reports = [], [], []

    def on_begin(self, label, until, cameras, splats):
        self.begun.append((label, until, len(cameras), len(splats)))

    def on_step(self, iteration, splats):
        self.steps.append((iteration, len(splats)))
        self.last = splats.means.detach().clone()

    def on_report(self, report):
        self.reports.append((report.iteration, report.validation_psnr_db))


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The inputs of a training, and its splats.ply without anybody looking on."""
    folder = tmp_path_factory.mktemp("plain")
    inputs = make_inputs(folder)
    run(train, SHORT, inputs, folder / "train")
    return inputs, (folder / "train" / "splats.ply").read_bytes()


@pytest.mark.integration
def test_a_callback_sees_every_step_and_changes_nothing(plain, tmp_path):
    inputs, expected = plain
    spy = Spy()
    run(train, SHORT, inputs, tmp_path / "train", replace(CONTEXT, callbacks=(spy,)))
    assert (tmp_path / "train" / "splats.ply").read_bytes() == expected
    assert [(label, until, cameras) for label, until, cameras, _ in spy.begun] == [
        ("train", 60, 8)]
    assert [iteration for iteration, _ in spy.steps] == list(range(1, 61))
    assert spy.reports[-1][0] == 60
    last = read_ply(tmp_path / "train" / "splats.ply")
    assert torch.equal(last.means, spy.last)
    log = [json.loads(line) for line in (tmp_path / "train" / "log.jsonl").open()]
    assert log[-1]["validation_psnr_db"] == spy.reports[-1][1]


def test_a_training_that_is_looked_at_in_a_browser_is_the_same_to_the_byte(
    plain, page, tmp_path, elsewhere, monkeypatch
):
    monkeypatch.setattr(live, "SHARE", 0.9)  # many updates in a short training
    inputs, expected = plain
    with start_server(HOST, None, label="x") as (server, address):
        view = LiveView(server, Workspace(tmp_path))
        page.page.set_viewport_size({"width": 640, "height": 240})  # a narrow panel is folded
        page.page.goto(address)
        page.page.get_by_text("Waiting for the training").wait_for(timeout=60_000)
        until(page, server.get_clients)
        done = elsewhere.submit(
            run, train, SHORT, inputs, tmp_path / "train", replace(CONTEXT, callbacks=(view,)))
        until(page, done.done)
        done.result()
        page.page.get_by_text("of 60").wait_for(timeout=60_000)
        until(page, lambda: nodes(page, "GaussianSplatsMessage"))
        camera = next(iter(server.get_clients().values())).camera
        until(page, lambda: np.linalg.norm(camera.position) < 2)  # among the training cameras
        view.close()
        assert not complaints(page)
    assert (tmp_path / "train" / "splats.ply").read_bytes() == expected


def test_a_training_with_view_is_the_same_work_as_one_without(room, capsys):
    assert main(["train", "-w", str(room)]) == 0
    assert "train is up to date" in capsys.readouterr().out
    assert main(["train", "-w", str(room), "--view"]) == 0
    said = capsys.readouterr()
    assert "train is up to date" in said.out
    assert "http://127.0.0.1:" in said.out
    assert "recon view" in said.err


def test_options_that_are_only_printed_open_no_page(room, capsys):
    assert main(["train", "-w", str(room), "--view", "--print-config"]) == 0
    assert "http" not in capsys.readouterr().out


class Clock:
    """A clock that moves when it is told."""

    def __init__(self):
        self.now = 100.0

    def perf_counter(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(live, "time", made)
    return made


class AtOnce:
    """An executor that does things right away."""

    def submit(self, task, *given):
        task(*given)

    def shutdown(self, **_):
        pass


def looked_at(clock, *, seconds, browsers=1):
    """A live view whose browsers take some seconds for half of the answer."""
    shown = []

    def get_item(_key, timeout):
        assert timeout
        clock.now += seconds / 2

    clients = {number: SimpleNamespace(local_storage=SimpleNamespace(get_item=get_item))
               for number in range(browsers)}
    server = SimpleNamespace(
        gui=SimpleNamespace(add_markdown=lambda text: SimpleNamespace(content=text)),
        get_clients=lambda: clients)
    view = LiveView(server, Workspace(Path("nowhere")))
    view._work, view._show = AtOnce(), lambda iteration, _splats: shown.append(iteration)
    return view, shown


@pytest.mark.parametrize("seconds", [0.0, 0.1, 3.0])
def test_whatever_an_update_costs_its_share_of_the_time_is_bounded(clock, seconds):
    splats = random_splats(4, seed=0, dtype=torch.float32)
    view, shown = looked_at(clock, seconds=seconds)
    begin = clock.now
    for iteration in range(20_000):
        view.on_step(iteration, splats)
        clock.now += 0.05
    cost = seconds + 0.25  # the page continues to draw for as long
    possible = SHARE * (clock.now - begin) / cost
    assert 0.9 * possible <= len(shown) <= possible + 1


def test_where_nobody_looks_nothing_is_copied(clock):
    view, shown = looked_at(clock, seconds=0.0, browsers=0)
    view.on_step(1, None)  # would fail if it were touched
    assert not shown


def test_a_browser_that_fails_ends_no_training(clock):
    view, _ = looked_at(clock, seconds=0.0)

    def fail(*_):
        raise RuntimeError("lost")

    view._show = fail
    view.on_step(1, random_splats(4, seed=0, dtype=torch.float32))
    assert not view._busy
    assert view._due > clock.now
