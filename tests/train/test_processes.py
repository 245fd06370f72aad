"""Processes that are connected, and what becomes of the one when another is gone."""

import signal

import pytest
import torch
from adder import numbers
from safetensors.torch import load_file
from team import PATIENCE, team
from tiny_task import first_state, tiny_task

from recon_cli.context import SINGLE_PROCESS
from recon_cli.errors import LostError
from recon_cli.train.cost import CostModel, LevelCost, with_exchange

pytestmark = pytest.mark.integration


def test_a_leader_that_is_gone_is_followed_without_a_word(tmp_path):
    with team(2, tmp_path) as found:
        found.fit(first_state(), tiny_task(), 2)
        found.ranks.leave()
        assert found.others[0].wait(PATIENCE) == LostError.exit_code
    assert "rror" not in found.said(1)
    assert "Traceback" not in found.said(1)


def test_the_others_do_not_hear_of_ctrl_c(tmp_path):
    with team(2, tmp_path) as found:
        found.fit(first_state(), tiny_task(), 2)
        found.others[0].send_signal(signal.SIGINT)
        found.fit(first_state(), tiny_task(), 2)
    assert found.others[0].returncode == 0


def test_a_process_that_dies_in_a_fit_is_missed(tmp_path):
    with team(2, tmp_path) as found:
        def kill(iteration, _splats):
            if iteration == 2:
                found.others[0].kill()
                found.others[0].wait(PATIENCE)

        state = first_state()
        with pytest.raises(LostError) as raised:
            found.fit(state, tiny_task(), 10, on_step=kill)
        assert "same command again" in raised.value.hint
        assert state.iteration == 2
        with pytest.raises(LostError):  # and no other fit is begun with it
            found.fit(first_state(), tiny_task(), 10)


def test_sums_are_the_same_in_every_process_whatever_their_size(tmp_path):
    tensors = numbers(0)
    with team(2, tmp_path, "adder.py") as found:
        found.ranks.add(tensors)
        found.others[0].wait(PATIENCE)
    theirs = load_file(tmp_path / "sums-1.safetensors")
    assert len(theirs) == len(tensors)
    for i, (total, a, b) in enumerate(zip(tensors, numbers(0), numbers(1), strict=True)):
        assert torch.equal(total, a + b)
        assert torch.equal(total, theirs[str(i)])


def test_what_a_step_exchanges_is_part_of_its_cost(tmp_path):
    cost = CostModel((LevelCost(1, 2.0, 0.5), LevelCost(2, 1.0, 0.25)), LevelCost(1, 1.0, 1.0),
                     1.0, 3.0)
    cpu = torch.device("cpu")
    with team(2, tmp_path) as found:
        together = with_exchange(cost, found.ranks, 60_000, 1, cpu)
        found.fit(first_state(), tiny_task(), 2)
    assert found.others[0].returncode == 0
    added = [(one.fixed_ms - before.fixed_ms, one.each_ms - before.each_ms)
             for one, before in zip(together.levels, cost.levels, strict=True)]
    assert added[0] == pytest.approx(added[1])
    assert sum(added[0]) > 0
    assert together.seconds > cost.seconds
    assert with_exchange(cost, SINGLE_PROCESS, 60_000, 1, cpu) is cost


def test_an_exchange_that_is_interrupted_lets_the_others_go(tmp_path, monkeypatch):
    with team(2, tmp_path) as found:
        def press(_tensors):
            raise KeyboardInterrupt

        monkeypatch.setattr(found.ranks, "add", press)
        with pytest.raises(KeyboardInterrupt):
            with_exchange(CostModel((), LevelCost(1, 1.0, 1.0), 1.0, 3.0), found.ranks, 2000, 0,
                          torch.device("cpu"))
        assert found.others[0].wait(PATIENCE) == LostError.exit_code
