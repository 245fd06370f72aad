"""When a run that gains nothing more goes on to its final phase, in which the rates fall."""

from __future__ import annotations

from recon_cli.train.schedule import Schedule

_LAST_FIFTH = 0.8  # where a recipe names no final phase of its own
_GAIN = 0.02  # dB; a tenth of what the final phase itself gives
_WINDOW = 0.1  # of the run's steps, in which so much must be gained


def next_iteration(
    schedule: Schedule, iteration: int, looks: list[tuple[int, float]]
) -> int | None:
    """Returns the step at which the final phase begins if the run goes there now, else None.

    It does where the best validation PSNR of the last tenth of the run is less than .02 dB above
    the best one before: never before densification has ended and the state for pruning is kept,
    and never in the final phase.

    Args:
        schedule: of the run.
        iteration: steps done.
        looks: (iteration, validation PSNR in dB) so far, ascending.
    """
    steps, recipe = schedule.config.iterations, schedule.recipe
    final = round(min(recipe.final_from, _LAST_FIFTH) * steps)
    settled = max(recipe.densify_until * steps, schedule.mid)
    if not settled < iteration < final:
        return None
    since = iteration - _WINDOW * steps
    before = [psnr for at, psnr in looks if at <= since]
    lately = [psnr for at, psnr in looks if at > since]
    if not before or not lately or max(lately) - max(before) >= _GAIN:
        return None
    return final
