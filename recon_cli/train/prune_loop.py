"""Removal in rounds: to a count, or as far as the validation views allow."""

from __future__ import annotations

import dataclasses

from recon_cli.train.fit import Task, validation_psnr
from recon_cli.train.prune_run import GOOD, Course, Round
from recon_cli.train.pruning import remaining, removals
from recon_cli.train.state import TrainState, save_state

# Share that a round of the search removes at first; halved whenever that was too much, down to the
# least, which bounds how far from the largest possible ratio the search may end.
_SEARCH_SHARE = 0.25
_LEAST_SHARE = 0.05


def prune_to(course: Course, target: int) -> tuple[TrainState, list[Round]]:
    """Removes all but `target` Gaussians round by round and returns what recovered."""
    done, first, until = course.read(), course.first, course.until
    number, task = len(done), course.recovering(first, until)
    state = course.state(number)
    n = done[0].gaussians_before if done else len(state.splats)
    plan = removals(n, min(n, target), course.rounds, until - first)
    for removal in plan[number:]:
        score = course.scored(task, number, state, first + removal.after)
        _settle(done, state, course.task)
        course.remove(number, state, score, removal.count, done)
        number += 1
    course.advance(task, number, state, until)
    _settle(done, state, course.task)
    course.write(done)
    return state, done


def prune_while_good(
    course: Course, psnr_before: float, max_drop: float
) -> tuple[TrainState, list[Round]]:
    """Removes as many as cost at most `max_drop` dB and returns the last state that was good.

    A round that costs too much is taken back, and a smaller one is tried from the state before.
    """
    steps = (course.until - course.first) // course.rounds
    done, good = course.read(), course.out / GOOD
    while True:
        number = len(done)
        state = course.state(number)
        score = None
        if number:
            until = done[-1].iteration + steps
            task = course.recovering(done[-1].iteration, until)
            score = course.scored(task, number, state, until)
            _settle(done, state, course.task)
            if psnr_before - (done[-1].validation_psnr_db or 0.0) <= max_drop:
                save_state(good, state)
            else:
                done[-1] = dataclasses.replace(done[-1], kept=False)
                state, score = course.load(good) if good.exists() else course.start(), None
        share = _SEARCH_SHARE * 0.5 ** sum(not one.kept for one in done)
        count = remaining(len(state.splats), share)
        if share < _LEAST_SHARE or count == len(state.splats):
            break
        if score is None:
            score = course.scored(course.task, number, state, state.iteration)
        course.remove(number, state, score, count, done)
    course.write(done)
    return state, done


def _settle(done: list[Round], state: TrainState, task: Task) -> None:
    """Notes how the last round ended."""
    if done:
        done[-1] = dataclasses.replace(
            done[-1], validation_psnr_db=validation_psnr(state, task))
