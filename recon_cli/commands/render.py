"""The verb `recon render`."""

from __future__ import annotations

from typing import Any

import click

from recon_cli.commands import options
from recon_cli.commands.console import say
from recon_cli.commands.jobs import open_job
from recon_cli.commands.options import Call, pass_call, verb
from recon_cli.flythrough.request import CODECS, FORMATS, OUTPUTS, TOUR, TRAINING, RenderRequest


def _outputs(_ctx: click.Context, parameter: click.Parameter, text: str) -> tuple[str, ...]:
    asked = text.split(",")
    if not set(asked) <= set(OUTPUTS):
        raise click.BadParameter(
            f"{text!r} is not a list of {', '.join(OUTPUTS)}.", param=parameter)
    return tuple(output for output in OUTPUTS if output in asked)


def _color(
    _ctx: click.Context, parameter: click.Parameter, text: str | None
) -> tuple[int, int, int] | None:
    if text is None:
        return None
    try:
        red, green, blue = (int(word) for word in text.split(","))
    except ValueError as error:
        raise click.BadParameter(
            f"{text!r} is not a colour such as 255,255,255.", param=parameter) from error
    return red, green, blue


@verb("render")
@click.option(
    "--path", metavar="training|orbit|tour|FILE.json",
    help="Camera path: smooth through the training cameras, a circle around their centre of "
         "view, a quiet tour, or a camera path of nerfstudio's viewer.  [default: training]")
@click.option(
    "--tour", is_flag=True,
    help="Short for --path tour: a quiet minute along the path of the capture, as large as the "
         "frames, up to 1280 pixels.  [default: off]")
@click.option(
    "--views", multiple=True, metavar="test|train|validation|NAME",
    help="Render these views instead of a path: a set, or a frame by its name; may be repeated.  "
         "[default: none]")
@click.option(
    "--panorama", is_flag=True,
    help="Render 360-degree panoramas (equirectangular), level, 2048 pixels wide unless a size is "
         "given; depth is then the distance from the camera.  [default: off]")
@click.option(
    "--output", "outputs", default=OUTPUTS[0], metavar="rgb,depth,alpha,trust", callback=_outputs,
    show_default=True,
    help="Outputs to write. Depth is a 16-bit image, in millimetres if the scale is known, and a "
         "coloured one; trust likewise is the expected error. render.json explains the values.")
@click.option(
    "--model", type=click.Choice(["auto", "base", "pruned"]), default="auto", show_default=True,
    help="Model to render; auto: the compact one (pruned) if it is fresh, else the original "
         "(base).")
@click.option(
    "--format", "form", type=click.Choice(FORMATS),
    help="Any but png also makes a video of the frames.  [default: as --out ends, else png]")
@click.option("--fps", type=float, metavar="X",
              help="Frames per second.  [default: those of the file, else 30]")
@click.option("--seconds", type=float, metavar="X",
              help="Length of a training or orbit path.  [default: 10]")
@click.option("--size", type=int, metavar="N",
              help="Longest side.  [pixels; default: as in training, or of the file]")
@click.option("--width", type=int, metavar="N",
              help="Width; alone it keeps the aspect ratio.  [pixels; default: see --size]")
@click.option("--height", type=int, metavar="N",
              help="Height; alone it keeps the aspect ratio.  [pixels; default: see --size]")
@click.option(
    "--background", metavar="R,G,B", callback=_color,
    help="Background colour, 0 to 255.  [default: the scene's own]")
@click.option("--codec", cls=options.Option, expert=True, type=click.Choice(CODECS),
              help="Video codec.  [default: h264; webm: av1]")
@click.option(
    "--crf", cls=options.Option, expert=True, type=int, metavar="N",
    help="Constant rate factor of the video; lower is better and larger.  [default: 18; av1: 28]")
@click.option(
    "--out", type=options.PathType(), metavar="FOLDER|FILE",
    help="Folder of the frames, where finished ones are kept; or a file for a single video (.mp4, "
         ".mov, .webm, .gif) or image (.png, .jpg, .webp).  [default: a folder in render/ of the "
         "workspace]")
@options.compute()
@options.common()
@pass_call
def render(
    call: Call, /, path: str | None, tour: bool, views: tuple[str, ...], **request: Any
) -> None:
    """Render the trained model along a path, or at given views.

    Images or a video of colour, depth and alpha. Finished frames of an interrupted run are kept.
    The cameras of a path are written to camera_path.json, which --path accepts.
    """
    if sum(bool(way) for way in (path, tour, views)) > 1:
        raise click.UsageError("--path, --tour and --views exclude each other.")
    # the other options are fields of the request
    checked = RenderRequest(path=TOUR if tour else path or TRAINING, views=views, **request)
    from recon_cli.flythrough.run import render_frames

    say(render_frames(checked, open_job(call)))
