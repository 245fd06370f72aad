"""The options that a run was started with, as a later version reads them."""

import json

import pytest

from recon_cli.config.stages import RunConfig
from recon_cli.errors import FormatError
from recon_cli.train.train_data import read_config, write_config


def rewrite(folder, **values):
    write_config(folder, RunConfig(iterations=7))
    path = folder / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def test_an_option_that_no_longer_exists_is_ignored(tmp_path):
    rewrite(tmp_path, sh_uniform=0.02)
    assert read_config(tmp_path) == RunConfig(iterations=7)


def test_a_value_that_is_no_longer_known_is_refused_with_the_way_out(tmp_path):
    rewrite(tmp_path, densify="mcmc")
    with pytest.raises(FormatError, match="densify is 'mcmc'") as caught:
        read_config(tmp_path)
    assert "recon train --again" in caught.value.hint
