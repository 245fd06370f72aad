"""Names, defaults and refusals of backends and devices."""

import pytest
import torch

from recon_cli.errors import BackendError
from recon_cli.render import resolve


def test_auto_names_what_will_run():
    assert resolve("auto", "cpu") == ("numba", "cpu")


def test_a_backend_that_does_not_exist_is_refused():
    with pytest.raises(BackendError, match="no backend"):
        resolve("vulkan", "cpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_cuda_is_refused_where_there_is_none_instead_of_using_the_cpu():
    with pytest.raises(BackendError, match="CUDA") as caught:
        resolve("torch", "cuda")
    assert caught.value.exit_code == 6
