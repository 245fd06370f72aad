"""A training that dies right after it has saved its state, as by kill -9."""

from recon_cli.train.fit import runner
from recon_cli.train.fit.state import save_state


class Killed(Exception):  # noqa: N818 - an event, not an error
    """Stands for a kill: nothing gets the chance to clean up."""


def kill_after(steps, monkeypatch):
    """Makes trainings die with the first checkpoint after so many steps."""
    def save_then_die(path, state):
        save_state(path, state)
        if state.iteration >= steps:
            raise Killed

    monkeypatch.setattr(runner, "save_state", save_then_die)
    # every state that is due is saved, however long the machine takes for one
    monkeypatch.setattr(runner.CheckpointThrottle, "allows", lambda _: True)
