"""The command line as a process of its own, and the reference made from it."""


import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from facts import assert_facts

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


@pytest.mark.integration
def test_completion_gives_a_script_and_the_verbs() -> None:
    script = _recon(_RECON_COMPLETE="zsh_source")
    assert script.returncode == 0
    assert "_RECON_COMPLETE=zsh_complete" in script.stdout
    words = _recon(_RECON_COMPLETE="bash_complete", COMP_WORDS="recon sta", COMP_CWORD="1")
    assert words.stdout == "plain,status\n"


@pytest.mark.integration
def test_a_reader_that_goes_away_is_no_error() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "recon_cli", "status"], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True)
    assert process.stdout
    assert process.stderr
    process.stdout.close()
    said = process.stderr.read()
    if said:
        (line,) = said.splitlines()
        assert_facts(line, "notice:", Path("workspace").absolute())
    process.wait()


SLOW = {"torch", "numba", "cv2", "pycolmap", "scipy", "skimage", "viser", "matplotlib"}


@pytest.mark.integration
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
    assert_facts(capsys.readouterr().err, "cli.md")
    assert generator.main([]) == 0
    assert generator.main(["--check"]) == 0
    text = Path("cli.md").read_text()
    assert all(f"## recon {verb}\n" in text for verb in VERBS)
    assert "--max-gaussians" in text


_posix = pytest.mark.skipif(os.name != "posix", reason="shell redirections and limits")


def _shell(line: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Runs a line in which $RECON is the program; descriptors are those of a pipe."""
    return subprocess.run(
        ["sh", "-c", line.replace("$RECON", f"'{sys.executable}' -m recon_cli")],
        env={**os.environ, **environment}, capture_output=True, text=True, check=False)


@pytest.mark.integration
@_posix
@pytest.mark.parametrize("closed", ["2>&-", ">&-", "<&-", ">&- 2>&- <&-"])
def test_a_closed_stream_is_no_error(closed: str) -> None:
    done = _shell(f"$RECON status {closed}; echo $? > code")
    assert Path("code").read_text() == "0\n"
    assert "Traceback" not in done.stderr


@pytest.mark.integration
@_posix
def test_no_file_gets_the_number_of_a_closed_stream() -> None:
    """What a library prints on number 2 would else end in the file that has it."""
    code = "import os, sys; from recon_cli.__main__ import open_streams; open_streams(); " \
        "number = os.open('data', os.O_WRONLY | os.O_CREAT); os.write(2, b'noise'); " \
        "print(number); sys.stderr.write('more')"
    done = subprocess.run(
        ["sh", "-c", f"'{sys.executable}' -c \"{code}\" 2>&-"], capture_output=True, text=True,
        check=True)
    assert int(done.stdout) > 2
    assert Path("data").read_bytes() == b""


@pytest.mark.integration
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has /dev/full")
@pytest.mark.parametrize("words", ["status", "status --json", "clean --json", "--help"])
def test_a_full_standard_output_is_told_from_a_full_workspace(words: str) -> None:
    done = _shell(f"$RECON {words} > /dev/full")
    assert done.returncode == 7
    assert_facts(done.stderr, "error", "Standard", "output")
    assert "The disk is full" not in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.integration
@_posix
def test_a_current_folder_that_is_gone_is_said_but_help_is_given() -> None:
    done = _shell("mkdir gone; cd gone; rmdir ../gone; $RECON status", PYTHONPATH=str(ROOT))
    assert done.returncode == 7
    assert_facts(done.stderr, "current", "folder", "gone")
    done = _shell("mkdir gone; cd gone; rmdir ../gone; $RECON status --help",
                  PYTHONPATH=str(ROOT))
    assert done.returncode == 0


@pytest.mark.integration
@pytest.mark.skipif(sys.platform != "linux", reason="other systems ignore ulimit -v")
@pytest.mark.parametrize("limit_kb", [80_000, 300_000])
def test_too_little_address_space_is_said_before_a_library_ends_the_process(limit_kb: int) -> None:
    done = _shell(f"ulimit -v {limit_kb}; $RECON doctor")
    assert done.returncode == 5
    assert "ulimit -v" in done.stderr
    assert _shell(f"ulimit -v {limit_kb}; $RECON status").returncode == 0


@pytest.mark.integration
@_posix
def test_a_user_without_a_home_is_told_to_name_a_folder_for_kernels() -> None:
    code = """
import os, pwd
def unknown(_user):
    raise KeyError("no such user")
pwd.getpwuid = unknown
from recon_cli import cli, machine
assert cli.main(["status"]) == 0
from recon_cli.errors import ConfigError
try:
    machine.cache_root()
except ConfigError as error:
    assert "RECON_CACHE_DIR" in error.hint
else:
    raise AssertionError
os.environ["RECON_CACHE_DIR"] = "mine"
assert str(machine.cache_root()) == "mine"
"""
    done = subprocess.run([sys.executable, "-c", code], env={}, capture_output=True, text=True,
                          check=False)
    assert done.returncode == 0, done.stderr
