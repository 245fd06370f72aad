import pytest

from recon_cli import cli
from recon_cli.commands import doctor
from recon_cli.errors import ExitCode
from recon_cli.sfm.features import xfeat_weights


@pytest.fixture(autouse=True)
def empty_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("RECON_CACHE_DIR", str(tmp_path / "cache"))


def test_a_file_that_is_not_the_one_ends_with_the_code_of_a_bad_input(tmp_path, capsys):
    file = tmp_path / "xfeat.pt"
    file.write_bytes(b"other weights")
    assert cli.main(["setup", "bridge", str(file)]) == ExitCode.INPUT
    assert xfeat_weights.SHA256[:16] in capsys.readouterr().err
    assert cli.main(["setup", "stairs"]) == ExitCode.USAGE


def test_the_doctor_says_whether_the_weights_are_there_and_whole(tmp_path):
    findings = doctor.examine(tmp_path)
    assert findings.bridge == "missing"
    assert xfeat_weights.COMMAND in doctor.findings_text(findings)
    kept = xfeat_weights.weights_path()
    kept.parent.mkdir(parents=True)
    kept.write_bytes(b"half a file")
    assert doctor.examine(tmp_path).bridge == "damaged"


@pytest.mark.integration
def test_the_downloaded_weights_are_kept_for_the_doctor_to_see(
    learned_weights, monkeypatch, tmp_path
):
    monkeypatch.setenv("RECON_CACHE_DIR", str(learned_weights))
    findings = doctor.examine(tmp_path)
    assert findings.bridge == "installed"
    assert xfeat_weights.COMMAND not in doctor.findings_text(findings)
