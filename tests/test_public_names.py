"""What `import recon_cli` offers: public names, loaded when they are first used."""

import subprocess
import sys

import pytest
from facts import assert_facts, raises

import recon_cli


def test_every_public_name_is_there_and_listed() -> None:
    assert set(recon_cli._PUBLIC) | {"__version__"} == set(recon_cli.__all__)
    for name in recon_cli.__all__:
        assert getattr(recon_cli, name) is not None
        assert name in dir(recon_cli)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with raises(AttributeError, "rasterisation"):
        recon_cli.rasterisation  # noqa: B018


@pytest.mark.integration
def test_the_package_alone_imports_nothing_heavy() -> None:
    code = ("import sys, recon_cli; "
            "print(*{'torch', 'numpy', 'numba', 'click'} & set(sys.modules))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


SQUEEZE = "import zlib; print(len(zlib.decompress(zlib.compress(bytes(100000)))))"


@pytest.mark.integration
@pytest.mark.parametrize("first", ["import recon_cli, pycolmap", "import zlib, pycolmap, recon_cli",
                                   "from recon_cli import Workspace; import pycolmap"])
def test_beside_pycolmap_compressing_works(first: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", f"{first}; {SQUEEZE}"], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["100000"]


@pytest.mark.integration
@pytest.mark.skipif(sys.platform != "linux" or "zlib" in sys.builtin_module_names,
                    reason="here zlib is no library that pycolmap's could be mixed up with")
@pytest.mark.parametrize("then", ["from recon_cli import Workspace", "import recon_cli.api"])
def test_after_pycolmap_alone_the_import_says_what_comes_first(then: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", f"import pycolmap; {then}"], capture_output=True, text=True)
    assert done.returncode == 1
    assert_facts(done.stderr, "recon_cli.errors.BackendError:", "zlib")
