"""What `import recon_cli` offers: public names, loaded when they are first used."""

import subprocess
import sys

import pytest

import recon_cli


def test_every_public_name_is_there_and_listed() -> None:
    assert set(recon_cli._PUBLIC) | {"__version__"} == set(recon_cli.__all__)
    for name in recon_cli.__all__:
        assert getattr(recon_cli, name) is not None
        assert name in dir(recon_cli)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'rasterisation'"):
        recon_cli.rasterisation  # noqa: B018


def test_the_package_alone_imports_nothing_heavy() -> None:
    code = ("import sys, recon_cli; "
            "print(*{'torch', 'numpy', 'numba', 'click'} & set(sys.modules))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
