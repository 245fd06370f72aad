"""The command line as a process of its own, and the reference made from it."""


import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from recon_cli.cli import VERBS

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RECON_WORKSPACE", raising=False)


Said = pytest.CaptureFixture[str]


def _recon(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "recon_cli", *words], env={**os.environ, **environment},
        capture_output=True, text=True, check=False)


def test_completion_gives_a_script_and_the_verbs() -> None:
    script = _recon(_RECON_COMPLETE="zsh_source")
    assert script.returncode == 0
    assert "_RECON_COMPLETE=zsh_complete" in script.stdout
    words = _recon(_RECON_COMPLETE="bash_complete", COMP_WORDS="recon sta", COMP_CWORD="1")
    assert words.stdout == "plain,status\n"


def test_a_reader_that_goes_away_is_no_error() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "recon_cli", "status"], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True)
    assert process.stdout
    assert process.stderr
    process.stdout.close()
    said = process.stderr.read()
    assert not said or said.endswith(
        f" notice: no workspace at {Path('workspace').absolute()} yet\n")
    process.wait()


SLOW = {"torch", "numba", "cv2", "pycolmap", "scipy", "skimage", "viser", "matplotlib"}


def test_status_and_help_import_nothing_slow() -> None:
    code = f"""
import sys
from recon_cli.cli import VERBS, main
main(["--help"])
assert not [name for name in sys.modules if name.startswith("recon_cli.commands.st")]
main(["status"])
for verb in VERBS:
    main([verb, "--help"])
    assert not {SLOW} & set(sys.modules), verb
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def _generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate_cli.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_generated_reference_holds_every_verb_and_tells_when_it_is_out_of_date(
    monkeypatch: pytest.MonkeyPatch, capsys: Said
) -> None:
    generator = _generator()
    monkeypatch.setattr(generator, "PATH", Path("cli.md").absolute())
    assert generator.main(["--check"]) == 1
    assert "out of date" in capsys.readouterr().err
    assert generator.main([]) == 0
    assert generator.main(["--check"]) == 0
    text = Path("cli.md").read_text()
    assert all(f"## recon {verb}\n" in text for verb in VERBS)
    assert "--max-gaussians" in text
