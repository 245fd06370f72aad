"""A fit that is handed to another process is the same there."""

import dataclasses

import numpy as np
import torch
from tiny_task import CONFIG, first_state, same, tiny_task

from recon_cli.context import ProcessGroup
from recon_cli.train.distributed.data_parallel import Fit, pack_fit, unpack_fit
from recon_cli.train.importance import Importance
from recon_cli.train.initialize import new_exposure
from recon_cli.train.schedule import ContinuedSchedule, RecoverySchedule


def test_a_fit_is_the_same_after_it_was_handed_over():
    config = dataclasses.replace(CONFIG, batch_views=2, exposure="on")
    plan = RecoverySchedule(config, first=3, until=9)
    task = dataclasses.replace(tiny_task(config), schedule=plan, nearness=2.0)
    task.train[2] = dataclasses.replace(task.train[2], mask=np.eye(30, 40) > 0)
    state = first_state(config)
    state.exposure = new_exposure(task)
    found = Importance.of_score("paper", 40, torch.device("cpu"))
    ranks = ProcessGroup(1, 2)
    first = unpack_fit(pack_fit(Fit(state, task, found, 3)), ranks)
    known = dataclasses.replace(task, ranks=ProcessGroup(0, 2, views=task.train))
    second = pack_fit(Fit(state, known, None, 3))
    assert not [name for name in second if name.startswith("image")]
    for one in (first, unpack_fit(second, ranks)):
        assert one.task.schedule == plan
        assert (one.task.extent, one.threads) == (1.0, 3)
        assert one.task.nearness == 2.0
        assert same(one.state, state)
        for mine, theirs in zip(task.train, one.task.train, strict=True):
            assert np.array_equal(mine.image, theirs.image)
            assert np.array_equal(mine.camera.viewmat, theirs.camera.viewmat)
            assert mine.camera.fx == theirs.camera.fx
            assert (mine.mask is None) == (theirs.mask is None)
        assert np.array_equal(one.task.train[2].mask, task.train[2].mask)
    assert (first.importance.weighs, first.importance.leaves_out) == (True, False)


def test_a_run_that_goes_on_does_so_in_every_process():
    plan = ContinuedSchedule(CONFIG, first=3)
    task = dataclasses.replace(tiny_task(CONFIG), schedule=plan)
    sent = unpack_fit(pack_fit(Fit(first_state(CONFIG), task, None, 1)), ProcessGroup(1, 2))
    assert sent.task.schedule == plan
