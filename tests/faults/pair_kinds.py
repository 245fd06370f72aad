"""Two commands at once on one workspace: one waits, is refused, or does not mind."""

from __future__ import annotations

from itertools import product

import forked
from case import Case
from judge import (
    RIGHT,
    Outcome,
    Verdict,
    broken,
    clear_error,
    differing,
    lost_files,
    owned,
    snapshot,
    spares,
    worst,
    wrong,
)
from lab import FULL, LIMIT
from moments import Gate, Moments

_PAIRS = tuple(product(FULL, FULL))


def pair(case: Case) -> Verdict:
    """The first is stopped at a random change of a file; the second runs meanwhile."""
    first, second = case.pick(_PAIRS, stride=7919)
    workspace = case.workspace()
    before = snapshot(workspace)
    gate, moments = Gate(), Moments(workspace)
    forked.kept.update(gate.descriptors)
    at = 1 + case.rng.randrange(max(1, case.lab.moments[first]))
    words = [(*FULL[verb], "-w", str(workspace)) for verb in (first, second)]
    case.tell(f"{first} is held at change {at} while {second} runs")
    running = case.start(*words[0], moments=moments, at=at, act=gate.hold)
    forked.known.add(running.pid)
    reached = gate.reached(LIMIT if case.lab.moments[first] else 0.2)
    meanwhile = case.run(*words[1])
    gate.let_through()
    forked.known.clear()
    done = case.finish(running)
    gate.close()
    for each in (meanwhile, done):
        if bad := broken(each):
            return bad
    spare = [spares(verb) for verb in (first, second)]
    if lost := lost_files(before, workspace, lambda name: any(one(name) for one in spare)):
        return wrong(Outcome.LOST, meanwhile, f"changed: {lost[:5]}")
    if done.code:
        return worst([clear_error(done), wrong(
            Outcome.BUG, done, f"{second} made {first} fail") if reached else RIGHT])
    verdict = RIGHT
    if meanwhile.code:
        verdict = clear_error(meanwhile)
        if meanwhile.code != 7 and verdict.fine:
            verdict = wrong(Outcome.BUG, meanwhile, f"not exit code 7 while {first} runs")
        again = case.run(*words[1])
        if again.code:
            return wrong(Outcome.BUG, again, f"fails after {first} is done")
    names = {"sfm": {"sfm", "place"}, "train": {"train"}, "clean": set()}
    tops = set().union(*(names.get(verb, owned(verb)) for verb in (first, second)))
    wrongs = differing(case.lab, workspace, sorted(tops - {"report.html"}))
    if wrongs:
        return wrong(Outcome.SILENTLY_WRONG, done, f"not as one after the other: {wrongs[:5]}")
    return verdict
