"""The part of a broken model that can be trusted on its own.

A mapper goes wrong in few places, and what lies on either side of one is usually right. So the
model is cut where the verdict finds it broken, each side is adjusted and examined by itself, and
cut again where it is broken too.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

from recon_cli.errors import SfmError
from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm import mapper
from recon_cli.sfm.checks import MIN_FRAMES
from recon_cli.sfm.job import MappingJob
from recon_cli.sfm.merge_models import ModelCandidate, drop_outliers
from recon_cli.sfm.verdict import MAX_LEAP, ModelVerdict, has_drifted, is_aliased, is_broken

Names = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class TrustedPart:
    """What is kept of a broken model."""

    candidate: ModelCandidate
    left_out: Names  # the frames that had a camera in the whole model
    sentence: str  # what was broken, and what is kept


def keep_trusted_part(
    job: MappingJob, model: pycolmap.Reconstruction, verdict: ModelVerdict
) -> TrustedPart | None:
    """Returns the part of an untrusted model to keep; None if it is trusted or must stay whole.

    SfmError if no part that can be trusted has --min-registered of the frames.
    """
    if not job.partial or job.accept_weak or verdict.trusted:
        return None
    part = find_trusted_part(job, model, verdict)
    kept = [] if part is None else mapper.list_registered(part.model)
    if part is None or len(kept) < job.min_registered * len(job.names):
        raise SfmError(
            f"{verdict.problems[0]} The largest part that can be trusted on its own has "
            f"{len(kept)} of {len(job.names)} frames, but --min-registered asks for "
            f"{job.min_registered:.0%}.",
            hint="Use more frames between the two parts (`recon ingest --frames N`), match all of "
            "them (--pairs exhaustive), accept the part with a lower --min-registered, or keep the "
            "whole as it is with --accept-weak.")
    left_out = tuple(sorted(set(mapper.list_registered(model)).difference(kept)))
    return TrustedPart(part, left_out, (
        f"{verdict.problems[0]} The largest part that can be trusted on its own is kept, "
        f"{len(kept)} of {len(job.names)} frames."))


def find_trusted_part(
    job: MappingJob, model: pycolmap.Reconstruction, verdict: ModelVerdict
) -> ModelCandidate | None:
    """Returns the largest part of a model, at least three cameras, that can be trusted."""
    best, least = None, MIN_FRAMES
    sides = list(_sides(job, mapper.list_registered(model), verdict))
    while sides:
        names = sides.pop()
        if len(names) < least:
            continue
        part = drop_outliers(job, _cut_out(model, names))
        cameras = mapper.list_registered(part.model)
        if not part.verdict.trusted:
            sides += _sides(job, cameras, part.verdict)
        elif len(cameras) >= least:
            best, least = part, len(cameras) + 1
    return best


def _sides(job: MappingJob, cameras: Collection[str], verdict: ModelVerdict) -> Iterator[Names]:
    """Yields the parts on either side of where a verdict finds a model broken, if that is known."""
    if is_broken(verdict.weakest_cut):
        yield from verdict.weakest_cut.sides
    elif is_aliased(verdict.aliasing):
        yield from verdict.aliasing.sides
    elif has_drifted(verdict) and verdict.scale is not None:
        yield from verdict.scale.sides
    elif len(verdict.model_parts) > 1:
        yield from verdict.model_parts
    elif leap := next((jump for jump in verdict.jumps if jump.ratio > MAX_LEAP), None):
        ordered = sorted(cameras, key=lambda name: (job.times.get(name, 0.0), name))
        after = ordered.index(leap.after)
        yield tuple(ordered[:after])
        yield tuple(ordered[after:])


def _cut_out(model: pycolmap.Reconstruction, names: Collection[str]) -> pycolmap.Reconstruction:
    """Returns a copy of a model with these images alone, adjusted."""
    part, keep = pycolmap.Reconstruction(model), set(names)
    for index in list(part.reg_image_ids()):
        image = part.image(index)
        if image.name not in keep:
            part.deregister_frame(image.frame_id)
    mapper.adjust(part)
    return part
