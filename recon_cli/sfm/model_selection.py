"""What a mapper found, made into one model: parts put together, wrong images taken out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pycolmap

from recon_cli.sfm import mapper, merge_models, verdict
from recon_cli.sfm.checks import MIN_FRAMES
from recon_cli.sfm.job import Job
from recon_cli.sfm.verdict import Verdict

# Share of the images that may be taken out of a model as wrong. Where the verdict suspects more,
# it is the model that is wrong, and taking out whichever images are fewer would hide it.
MAX_REJECTED = 0.2


@dataclass(frozen=True, eq=False)
class Candidate:
    """A model that may become the stage's.

    Attributes:
        model: adjusted.
        verdict: on it.
        apart: frames that only other models hold, a tuple each.
        rejected: why frames were taken out, by name.
    """

    model: pycolmap.Reconstruction
    verdict: Verdict
    apart: tuple[tuple[str, ...], ...]
    rejected: Mapping[str, str]


def best(job: Job, models: Sequence[pycolmap.Reconstruction]) -> Candidate | None:
    """Returns the largest model with what could be added to it and without wrong images.

    None where there is no model. A part is added only where the model can be trusted no less with
    it than without it.
    """
    if not models:
        return None
    largest, *others = mapper.largest_first(models)
    mapper.adjust(largest)
    found = _without_wrong_images(job, largest)
    for other in others:
        joined = merge_models.added(job, found.model, other)
        if joined is None:
            continue
        together = _without_wrong_images(job, joined)
        if _no_worse(together, found):
            found = together
    return Candidate(found.model, found.verdict, _apart(found, others), found.rejected)


def _without_wrong_images(job: Job, model: pycolmap.Reconstruction) -> Candidate:
    """Takes the images that the verdict suspects out of a model and adjusts what is left."""
    first = _examined(job, model)
    wrong = {
        item.name: f"{item.share:.0%} of its {item.matches} matches agree with where it was placed"
        for item in first.astray}
    if not wrong or len(wrong) > MAX_REJECTED * model.num_reg_images():
        return Candidate(model, first, (), {})
    for name in wrong:
        model.deregister_frame(model.find_image_with_name(name).frame_id)
    mapper.adjust(model)
    return Candidate(model, _examined(job, model), (), wrong)


def _examined(job: Job, model: pycolmap.Reconstruction) -> Verdict:
    return verdict.examine(
        model, job.database, job.names, sharpness=job.sharpness, times=job.times)


def _no_worse(together: Candidate, alone: Candidate) -> bool:
    """Returns whether a merged model holds more images and is trusted as much."""
    if together.model.num_reg_images() <= alone.model.num_reg_images():
        return False
    return together.verdict.trusted or not alone.verdict.trusted


def _apart(
    found: Candidate, others: Sequence[pycolmap.Reconstruction]
) -> tuple[tuple[str, ...], ...]:
    """Returns the frames of other models that no model before them holds, three or more."""
    held, parts = {*mapper.names(found.model), *found.rejected}, []
    for other in others:
        new = sorted(set(mapper.names(other)) - held)
        held.update(new)
        if len(new) >= MIN_FRAMES:
            parts.append(tuple(new))
    return tuple(parts)
