"""Tables I and II of the paper beside the same runs here.

"3D Reconstruction of Indoor Scenes Based on 3DGS Models": PSNR in dB and SSIM of 3DGS and of the
paper's method on eight rooms of Replica (Table I) and on a capture of the authors (Table II).
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence

from recon_cli.evaluation.scores import Table

# PSNR in dB and SSIM of 3DGS, then of the method of the paper
PublishedScores = tuple[float, float, float, float]
TABLE_I: dict[str, PublishedScores] = {
    "office0": (38.45, 0.925, 39.05, 0.934), "office1": (36.97, 0.938, 37.17, 0.954),
    "office2": (36.39, 0.945, 36.68, 0.962), "office3": (35.85, 0.941, 36.35, 0.958),
    "office4": (36.54, 0.939, 36.66, 0.941), "room0": (37.26, 0.915, 38.06, 0.923),
    "room1": (36.28, 0.929, 37.75, 0.935), "room2": (34.98, 0.913, 35.14, 0.927)}
TABLE_II: PublishedScores = (30.41, 0.879, 31.89, 0.897)
CAUTION = ("The paper names neither its frames, sizes, held-out views nor its number of runs: its "
           "figures and those of this study do not measure the same thing.")
NAMES = ("3DGS", "paper")  # of the printed methods, in the order of PublishedScores

# PSNR in dB and SSIM of a scene and a method here; None where it was not run
ScoresHere = Callable[[str, str], tuple[float, float] | None]


def published_scores(scene: str) -> PublishedScores | None:
    """Returns the paper's scores of a scene of that name, None where it has none."""
    return TABLE_I.get(scene.lower())


def published_gains(published: PublishedScores) -> dict[str, float]:
    """Returns the gains that the paper reports, by figure."""
    return {"psnr_db": published[2] - published[0], "ssim": published[3] - published[1]}


def table_i(methods: Sequence[str], here: ScoresHere, title: str) -> Table:
    """Returns the eight rooms with the printed scores beside those of `methods` here, and means.

    Rooms that were not run keep their row. The first mean is of the printed scores of all rooms,
    the second of the rooms that were run, printed and here.
    """
    run = [room for room in TABLE_I if here(room, methods[0]) is not None]
    rows = [(room, *_printed([TABLE_I[room]]), *_measured([room], methods, here))
            for room in TABLE_I]
    means = [("mean of 8", *_printed(TABLE_I.values()), *_measured((), methods, here))]
    if 0 < len(run) < len(TABLE_I):
        means.append((f"mean of {len(run)} run", *_printed([TABLE_I[room] for room in run]),
                      *_measured(run, methods, here)))
    elif run:
        means = [("mean of 8", *_printed(TABLE_I.values()), *_measured(run, methods, here))]
    return Table(_headings(methods), (*rows, *means), title, means=len(means))


def table_ii(scenes: Sequence[str], methods: Sequence[str], here: ScoresHere, title: str) -> Table:
    """Returns the printed scores of the authors' capture, and below it own captures."""
    nothing = ("-",) * (2 * len(NAMES))
    rows = [("the paper's capture", *_printed([TABLE_II]), *_measured((), methods, here))]
    rows += [(scene, *nothing, *_measured([scene], methods, here)) for scene in scenes]
    return Table(_headings(methods), rows, title)


def _headings(methods: Sequence[str]) -> tuple[str, ...]:
    groups = (*(f"printed: {name}" for name in NAMES), *(f"here: {name}" for name in methods))
    return ("scene", *(word for group in groups for word in (f"{group} dB", "SSIM")))


def _printed(rows: Iterable[PublishedScores]) -> tuple[str, ...]:
    means = [statistics.fmean(column) for column in zip(*rows, strict=True)]
    return tuple(f"{value:.{3 if number % 2 else 2}f}" for number, value in enumerate(means))


def _measured(
    scenes: Sequence[str], methods: Sequence[str], here: ScoresHere
) -> tuple[str, ...]:
    """Returns the means over scenes of each method, dashes where one was not run."""
    cells: list[str] = []
    for method in methods:
        found = [here(scene, method) for scene in scenes]
        scores = [score for score in found if score is not None]
        if scores and len(scores) == len(found):
            psnr_db, ssim = (statistics.fmean(column) for column in zip(*scores, strict=True))
            cells += [f"{psnr_db:.2f}", f"{ssim:.3f}"]
        else:
            cells += ["-", "-"]
    return tuple(cells)
