"""Speed and accuracy of sfm: `python tests/bench/bench_sfm.py CAPTURE [--help]`.

Runs ingest, denoise (off) and sfm on a video or a folder of photos and prints what came out and
the seconds of each step; with --reference also how far the cameras are from it (see `pose_errors`).

With several --max-features, a table with a row for each: `--max-features 1000 --max-features 2048`;
with --plot also a picture of it, for which the extra `plot` has to be installed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import click
from pose_errors import compare, model_poses, reference_poses

from recon_cli.config.stages import DenoiseConfig, IngestConfig, SfmConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.progress import TqdmProgress
from recon_cli.stages import denoise, ingest, sfm

SHOWN = ("frames", "registered", "points", "mean_track_length", "reprojection_error_px",
         "median_triangulation_angle_deg", "models", "cameras")
COMPARED = ("seconds", "registered", "centre", "rotation")  # how the columns of the table begin


def prepare(capture: Path, work: Path, ctx: StageContext, frames: int | None) -> StageInputs:
    """Runs ingest and denoise in `work` and returns what sfm reads."""
    folders = {name: work / name for name in ("ingest", "denoise")}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    ingest.run(
        IngestConfig(frames=frames), StageInputs(sources=(capture,)), folders["ingest"], ctx)
    inputs = StageInputs(folders)
    denoise.run(DenoiseConfig(mode="off"), inputs, folders["denoise"], ctx)
    return inputs


def measured(
    inputs: StageInputs, out: Path, ctx: StageContext, config: SfmConfig, reference: Path | None
) -> dict[str, object]:
    """Runs sfm in `out` and returns what came out, how far from the truth, and the seconds."""
    out.mkdir(parents=True, exist_ok=True)
    summary = sfm.run(config, inputs, out, ctx)
    seconds = summary.seconds
    rows: dict[str, object] = {
        name: value for name, value in summary.to_json().items() if name in SHOWN}
    rows["attempts"] = ", ".join(attempt.name for attempt in summary.attempts)
    if reference is not None:
        errors = compare(model_poses(out / "sparse"), reference_poses(reference))
        rows |= {
            "centre RMSE, units of the reference": errors.rmse,
            "centre median, share of the extent": errors.median_share,
            "rotation median deg, common part off": errors.own_rotation_deg}
    rows |= {f"seconds, {step}": value for step, value in seconds.items()}
    return {**rows, "seconds, all": float(sum(seconds.values()))}


def compared(rows: Mapping[int, Mapping[str, object]]) -> str:
    """A line for each number of keypoints, separated by tabs."""
    names = [name for name in next(iter(rows.values())) if name.startswith(COMPARED)]
    lines = [["keypoints", *names]]
    for count, row in rows.items():
        lines.append([str(count), *(
            f"{row[name]:.4g}" if isinstance(row[name], float) else str(row[name])
            for name in names)])
    return "\n".join("\t".join(line) for line in lines)


def draw(path: Path, label: str, rows: Mapping[int, Mapping[str, object]]) -> None:
    """Draws seconds against the median error of the centres."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    seconds = [float(str(row["seconds, all"])) for row in rows.values()]
    errors = [100 * float(str(row["centre median, share of the extent"])) for row in rows.values()]
    axes.plot(seconds, errors, "o-")
    for count, x, y in zip(rows, seconds, errors, strict=True):
        axes.annotate(f" {count}", (x, y), va="bottom")
    axes.set(xlabel="seconds of sfm", ylabel="median error of the centres, % of the extent",
             title=f"Keypoints an image: {label}", ylim=(0, None))
    figure.savefig(path)


def table(rows: Mapping[str, object]) -> str:
    """Two columns of text."""
    width = max(map(len, rows))
    return "\n".join(
        f"{name:<{width}}  {value:.4g}" if isinstance(value, float) else f"{name:<{width}}  {value}"
        for name, value in rows.items())


@click.command()
@click.argument("capture", type=click.Path(exists=True, path_type=Path))
@click.option(
    "--reference", type=click.Path(exists=True, path_type=Path),
    help="traj.txt or a data set with poses.")
@click.option("--frames", type=int, help="Frames to choose from a video.")
@click.option(
    "--max-features", type=int, multiple=True, default=[SfmConfig().max_features],
    show_default=True)
@click.option("--pairs", default=SfmConfig().pairs, show_default=True)
@click.option("--threads", default=2, show_default=True)
@click.option("--plot", type=click.Path(path_type=Path), help="Write an SVG of the table.")
@click.option("--work", type=click.Path(path_type=Path), help="Keep the results in this folder.")
def main(
    capture: Path, reference: Path | None, frames: int | None, max_features: tuple[int, ...],
    pairs: str, threads: int, plot: Path | None, work: Path | None,
) -> None:
    """Prints a table for one capture."""
    ctx = StageContext(threads=threads, progress=TqdmProgress())
    rows = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = work or Path(temporary)
        inputs = prepare(capture, folder, ctx, frames)
        for count in max_features:
            config = SfmConfig(max_features=count, pairs=pairs)
            rows[count] = measured(inputs, folder / f"sfm{count}", ctx, config, reference)
            click.echo(table(rows[count]))
    if len(rows) > 1:
        click.echo(compared(rows))
    if plot is not None:
        draw(plot, capture.parent.name, rows)


if __name__ == "__main__":
    main()
