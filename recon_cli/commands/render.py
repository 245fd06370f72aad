"""The verb `recon render`."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.jobs import open_job
from recon_cli.commands.options import Call, pass_call, verb
from recon_cli.config.stages import ComputeConfig
from recon_cli.flythrough.request import CODECS, FORMATS, OUTPUTS, TRAINING, Request
from recon_cli.lazy import load


def _outputs(_ctx: click.Context, parameter: click.Parameter, text: str) -> tuple[str, ...]:
    asked = text.split(",")
    if not set(asked) <= set(OUTPUTS):
        raise click.BadParameter(
            f"{text!r} is no list of {', '.join(OUTPUTS)}.", param=parameter)
    return tuple(output for output in OUTPUTS if output in asked)


def _color(_ctx: click.Context, parameter: click.Parameter, text: str) -> tuple[int, int, int]:
    try:
        red, green, blue = (int(word) for word in text.split(","))
    except ValueError as error:
        raise click.BadParameter(
            f"{text!r} is no colour such as 255,255,255.", param=parameter) from error
    return red, green, blue


@verb("render")
@click.option(
    "--path", metavar="training|orbit|FILE.json",
    help="A smooth path through the training cameras in the order of their names, a circle around "
         "what they look at, or the cameras of a file in the layout of nerfstudio's viewer.  "
         "[default: training]")
@click.option(
    "--views", multiple=True, metavar="test|train|validation|NAME",
    help="Views at their own cameras in place of a path: all of a part, or a frame by its name; "
         "may be repeated.  [default: none]")
@click.option(
    "--output", "outputs", default=OUTPUTS[0], metavar="rgb,depth,alpha", callback=_outputs,
    show_default=True,
    help="What to write, one or several. Depth is 16-bit, in millimetres where the scale is known, "
         "and a coloured picture; render.json says what it means.")
@click.option(
    "--model", type=click.Choice(["auto", "base", "pruned"]), default="auto", show_default=True,
    help="auto takes the pruned model where there is a fresh one.")
@click.option(
    "--format", "form", type=click.Choice(FORMATS),
    help="mp4 makes a video of the frames, which stay beside it.  "
         "[default: png, or mp4 where --out ends so]")
@click.option("--fps", type=float, metavar="X",
              help="Frames a second.  [default: those of the file, else 30]")
@click.option("--seconds", type=float, metavar="X",
              help="Length of a path through or around the cameras.  [default: 10]")
@click.option("--size", type=int, metavar="N",
              help="Longest side.  [pixels; default: of training, or of the file]")
@click.option("--width", type=int, metavar="N",
              help="Width; without --height the shape stays.  [pixels; default: see --size]")
@click.option("--height", type=int, metavar="N",
              help="Height; without --width the shape stays.  [pixels; default: see --size]")
@click.option(
    "--background", default="0,0,0", metavar="R,G,B", callback=_color, show_default=True,
    help="Colour where nothing is, 0 to 255.")
@click.option("--codec", type=click.Choice(CODECS), help="Of the video.  [default: h264]")
@click.option(
    "--crf", type=int, metavar="N",
    help="Quality of the video; smaller is better and larger in bytes.  "
         "[default: 18, for av1 28]")
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="FOLDER|FILE",
    help="Folder of the frames, which are not rendered again where the same are there; or a file "
         "for the one video (.mp4) or picture (.png).  "
         "[default: a folder in render/ of the workspace]")
@options.of(ComputeConfig)
@options.common()
@pass_call
def render(
    call: Call, path: str | None, views: tuple[str, ...], outputs: tuple[str, ...], model: str,
    form: str | None, fps: float | None, seconds: float | None, size: int | None,
    width: int | None, height: int | None, background: tuple[int, int, int], codec: str | None,
    crf: int | None, out: Path | None,
) -> None:
    """Render the trained model along a path, or at given views.

    Images or a video of colour, depth and alpha. Finished frames of an interrupted run are kept.
    The cameras of a path are written to camera_path.json, which --path accepts.
    """
    if path is not None and views:
        raise click.UsageError("--path and --views exclude each other.")
    request = Request(
        path or TRAINING, views, outputs, model, fps, seconds, size, width, height, background,
        form, codec, crf, out)
    job, _ = open_job(call, ComputeConfig)
    click.echo(load("recon_cli.flythrough.run.run")(request, job))
