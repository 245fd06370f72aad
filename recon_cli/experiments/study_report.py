"""What the study says: tables, and below them in words what the intervals show and do not show."""

from __future__ import annotations

from collections.abc import Iterator

from recon_cli.evaluation.intervals import Interval, Spread
from recon_cli.evaluation.metrics import PSNR_CONVENTION, SSIM_CONVENTION
from recon_cli.evaluation.tables import TitledTable
from recon_cli.experiments.study_plot import published
from recon_cli.experiments.study_result import (
    ARMS,
    BASELINE,
    COMPARISONS,
    EQUAL_STEPS,
    MEAN,
    PAIRS,
    Result,
)
from recon_cli.experiments.variants import Arm

_PAPER = ARMS[1]
_UNITS = {"psnr_db": ("PSNR", "dB", 2), "ssim": ("SSIM", "", 4)}
_COLUMNS = (("PSNR dB", "psnr_db", 2), ("SSIM", "ssim", 4))
_COSTS = (("Gaussians", "gaussians", 0), ("MB", "megabytes", 1), ("s", "seconds", 1),
          ("CPU s", "cpu_seconds", 1))


def text(result: Result) -> str:
    """Returns what the terminal shows."""
    parts = [head(result)]
    for comparison in COMPARISONS:
        parts += [scores(result, comparison).text(), differences(result, comparison).text(),
                  *words(result, comparison)]
    if (table := beside_the_paper(result)) is not None:
        parts += [table.text(), _CAUTION]
    return "\n\n".join([*parts, *notes(result)])


def markdown(result: Result) -> str:
    """Returns study.md."""
    parts = ["# The paper's experiment", head(result) + "."]
    for comparison in COMPARISONS:
        parts += [f"## At {comparison}", scores(result, comparison).markdown(),
                  differences(result, comparison).markdown(), *words(result, comparison)]
    if (table := beside_the_paper(result)) is not None:
        parts += ["## Beside the paper", table.markdown(), _CAUTION]
    return "\n\n".join([*parts, *notes(result)]) + "\n"


def head(result: Result) -> str:
    """Returns what was run and where."""
    scenes = "; ".join(
        f"{name}: {scene.views} test views at {scene.width}x{scene.height}"
        for name, scene in result.scenes.items())
    return (f"{result.seeds} seeds, at most {result.base.max_gaussians:,} Gaussians; {scenes}; "
            f"run on {' and '.join(result.machines)}")


def scores(result: Result, comparison: str) -> TitledTable:
    """Returns the table of means and standard deviations."""
    header = ("scene, arm", *(name for label, _, _ in _COLUMNS for name in (label, "sd")), "steps",
              *(label for label, _, _ in _COSTS))
    rows = []
    for row in result.rows:
        for arm in ARMS:
            found = [_mean_and_deviation(result.spread(row, comparison, arm, figure), digits)
                     for _, figure, digits in _COLUMNS]
            costs = [f"{result.spread(row, comparison, arm, figure).mean:,.{digits}f}"
                     for _, figure, digits in (("steps", "steps", 0), *_COSTS)]
            rows.append((f"{row}, {arm.label}", *(cell for pair in found for cell in pair), *costs))
    return TitledTable(f"Scores at {comparison}", header, rows)


def differences(result: Result, comparison: str) -> TitledTable:
    """Returns the table of paired differences with their intervals."""
    header = ("scene, arm - arm", *(
        name for label, _, _ in _COLUMNS for name in (label, "95% from", "to")))
    rows = []
    for row in result.rows:
        for ours, theirs in PAIRS:
            cells = [cell for _, figure, digits in _COLUMNS for cell in _interval(
                result.difference(row, comparison, ours, theirs, figure), digits)]
            rows.append((f"{row}, {ours.label} - {theirs.label}", *cells))
    return TitledTable(f"Differences at {comparison}", header, rows)


def words(result: Result, comparison: str) -> list[str]:
    """Returns one sentence a pair of arms and figure, on the mean of all scenes."""
    row = MEAN if MEAN in result.rows else result.rows[0]
    return ["\n".join(
        f"- {sentence}" for ours, theirs in PAIRS for figure in _UNITS
        for sentence in [_sentence(result, row, comparison, ours, theirs, figure)])]


def _sentence(
    result: Result, row: str, comparison: str, ours: Arm, theirs: Arm, figure: str
) -> str:
    name, unit, digits = _UNITS[figure]
    found = result.difference(row, comparison, ours, theirs, figure)
    mean = f"{found.mean:+.{digits}f}{f' {unit}' if unit else ''}"
    lead = f"{name} of {ours.label} against {theirs.label}, {row}, {comparison}: {mean}"
    if found.low is None or found.high is None:
        return f"{lead}; one seed shows no interval."
    span = f"[{found.low:+.{digits}f}, {found.high:+.{digits}f}]"
    if found.low <= 0 <= found.high:
        return f"{lead}; the interval {span} contains 0: no difference shown."
    return f"{lead}; the interval {span} lies {'above' if found.low > 0 else 'below'} 0: " \
           f"{ours.label} is {found.verdict}."


def beside_the_paper(result: Result) -> TitledTable | None:
    """Returns the paper's figures beside ours, None where no scene has a name of theirs."""
    rows = list(_published_rows(result))
    header = ("scene", "paper: 3DGS dB", "SSIM", "theirs dB", "SSIM", "gain dB", "SSIM",
              "here: 3DGS dB", "SSIM", "paper's prune dB", "SSIM", "gain dB", "SSIM")
    title = f"The paper's Table I beside this study, {EQUAL_STEPS}"
    return TitledTable(title, header, rows) if rows else None


def _published_rows(result: Result) -> Iterator[tuple[str, ...]]:
    for name in result.scenes:
        theirs = published(name)
        if theirs is None:
            continue
        own = {(arm.name, figure): result.spread(name, EQUAL_STEPS, arm, figure).mean
               for arm in (BASELINE, _PAPER) for figure in _UNITS}
        gains = [own[_PAPER.name, figure] - own[BASELINE.name, figure] for figure in _UNITS]
        yield (
            name, f"{theirs.reference_psnr_db:.2f}", f"{theirs.reference_ssim:.3f}",
            f"{theirs.paper_psnr_db:.2f}", f"{theirs.paper_ssim:.3f}", f"{theirs.gain_db:+.2f}",
            f"{theirs.gain_ssim:+.3f}",
            *(f"{own[arm.name, figure]:.{digits}f}" for arm in (BASELINE, _PAPER)
              for figure, digits in (("psnr_db", 2), ("ssim", 3))),
            f"{gains[0]:+.2f}", f"{gains[1]:+.3f}")


_CAUTION = ("The paper names neither its frames, sizes, held-out views nor its count of runs: its "
            "figures and those of this study are no measurement of the same thing.")


def notes(result: Result) -> list[str]:
    """Returns how the figures are to be read."""
    clock = {"wall": "on the wall", "cpu": "of the CPU"}[result.clock]
    found = [
        f"Equal seconds: each arm takes as many steps as fit into the seconds {clock} that the "
        "slowest arm's take at equal steps, as measured first; the steps are "
        "then fixed. Seconds are of training, pruning included, without scoring.",
        "Each arm is trained on " + "; ".join(
            f"{scene}: {_parts(result, scene)}" for scene in result.scenes)
        + ". The trials that decide so are not timed.",
        "Intervals: 95% by Student's t over the differences seed by seed. They speak of other "
        f"seeds on these scenes, not of other scenes. Of {_count(result)} intervals about "
        f"{max(1, round(0.05 * _count(result)))} would leave out 0 by chance if no arm differed.",
        f"PSNR: {PSNR_CONVENTION}. SSIM: {SSIM_CONVENTION}. Scored on held-out test views, which "
        "nothing was tuned on."]
    if result.seeds < 5:
        found.append(f"{result.seeds} seeds are few: a claim needs 5.")
    if len(result.machines) > 1:
        found.append("The runs are of several machines: their seconds do not compare.")
    return found


def _parts(result: Result, scene: str) -> str:
    """Returns which parts the models of a scene have, arms of the same parts together."""
    found = result.parts(scene)
    return ", ".join(
        f"{parts} ({' and '.join(arm.label for arm in ARMS if found[arm.name] == parts)})"
        for parts in dict.fromkeys(found.values()))


def _count(result: Result) -> int:
    return len(result.rows) * len(PAIRS) * len(_COLUMNS) * len(COMPARISONS)


def _mean_and_deviation(found: Spread, digits: int) -> tuple[str, str]:
    deviation = "-" if found.deviation is None else f"{found.deviation:.{digits}f}"
    return f"{found.mean:.{digits}f}", deviation


def _interval(found: Interval, digits: int) -> tuple[str, str, str]:
    if found.low is None or found.high is None:
        return f"{found.mean:+.{digits}f}", "-", "-"
    return (f"{found.mean:+.{digits}f}", f"{found.low:+.{digits}f}", f"{found.high:+.{digits}f}")
