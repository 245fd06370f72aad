"""The table of formats: every row has its files, and every format of Gaussians its functions."""

from importlib import import_module

import pytest
from facts import assert_facts

from recon_cli.config.export import ExportConfig
from recon_cli.splats.format import SplatFormat
from recon_cli.splats.registry import FORMATS
from recon_cli.workspace.export_formats import EXPORT_FORMATS, describe_max_loss

ROWS = EXPORT_FORMATS.values()


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_row_of_gaussians_names_the_module_that_writes_and_reads_them(row):
    assert bool(row.module) == (row.kind == "gaussians") == (row.name in FORMATS)
    if row.module:
        assert isinstance(import_module(row.module).FORMAT, SplatFormat)


def test_no_two_formats_write_the_same_file():
    assert len({row.file for row in ROWS}) == len(ROWS)


def test_own_options_of_a_format_are_options_of_export():
    for row in ROWS:
        assert set(row.options) <= ExportConfig.__dataclass_fields__.keys()
        assert all(one > other for one, other in zip(row.sharing, row.sharing[1:], strict=False))


def test_the_help_says_what_each_format_may_lose():
    assert_facts(describe_max_loss(), 0.3, 3, ".splat")
