"""Files are whole and readable by others; JSON of any origin is a value or a typed error."""

import os
from pathlib import Path

import numpy as np
import pytest
from facts import raises
from safetensors.numpy import save_file

from recon_cli.errors import FormatError
from recon_cli.workspace import atomic
from recon_cli.workspace.atomic import parse_json, read_json, replacing


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o027, 0o640), (0o077, 0o600)])
def test_a_file_gets_the_permissions_that_the_umask_says(
    tmp_path: Path, umask: int, mode: int
) -> None:
    before = os.umask(umask)
    try:
        with replacing(tmp_path / "a.safetensors") as temporary:
            save_file({"x": np.zeros(3, np.float32)}, temporary)
        atomic.write_bytes(tmp_path / "b", b"x")
    finally:
        os.umask(before)
    for name in ("a.safetensors", "b"):
        assert (tmp_path / name).stat().st_mode & 0o777 == mode
    assert len(list(tmp_path.iterdir())) == 2


def test_a_file_is_flushed_before_it_replaces_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, replace = list[str](), os.replace
    monkeypatch.setattr(os, "fsync", lambda _file: calls.append("flush"))
    monkeypatch.setattr(os, "replace", lambda *paths: (calls.append("rename"), replace(*paths)))
    atomic.write_bytes(tmp_path / "a", b"x")
    assert calls[:calls.index("rename")] == ["flush"]
    assert (tmp_path / "a").read_bytes() == b"x"


@pytest.mark.parametrize(("text", "reason"), [
    ("NaN", "finite"), ('{"a": Infinity}', "finite"), ("1e999", "finite"), ("9" * 5000, "finite"),
    ("[" * 100_000, "nested"), ('{"a":' * 100_000, "nested"),
    ("{", "Expecting"), ("", "Expecting"), ("[]", "list"), ("3", "value")])
def test_json_that_cannot_be_used_is_an_error_with_its_reason(
    tmp_path: Path, text: str, reason: str
) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with raises(FormatError, path, reason):
        read_json(path, dict)


def test_bytes_folders_fifos_and_huge_files_are_no_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bytes").write_bytes(b'{"a": "\xff"}')
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "large").write_text("[1, 2, 3]")
    monkeypatch.setattr(atomic, "MAX_TEXT_BYTES", 8)
    for name in ("bytes", "folder", "fifo", "large", "missing"):
        with raises(FormatError, "JSON") as caught:
            read_json(tmp_path / name, hint="Do this.")
        assert caught.value.hint == "Do this."


def test_integers_stay_what_they_are_up_to_64_bits_and_are_floats_beyond() -> None:
    assert parse_json("[18446744073709551615, -9223372036854775808]") == [2**64 - 1, -2**63]
    assert parse_json("1" + "0" * 25) == 1e25
    assert parse_json("[NaN]", finite=False)[0] != 0


def test_everything_that_is_read_as_json_or_toml_goes_through_one_reader() -> None:
    package = Path(atomic.__file__).parents[1]
    others = {"workspace/atomic.py", "config/settings.py",  # the readers
              "workspace/steps.py",  # on which the reader builds; its lines have checksums
              "render/self_check.py",  # may import nothing of the workspace
              }
    found = {
        path.relative_to(package).as_posix() for path in package.rglob("*.py")
        if any(word in path.read_text(encoding="utf-8")
               for word in ("json.loads(", "json.load(", "tomllib.load"))}
    assert {name for name in found - others if not name.startswith("splats/")} == set()
