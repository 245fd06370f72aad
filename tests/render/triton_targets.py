"""Compiles every kernel for GPUs that need not be here: `python tests/render/triton_targets.py`.

Prints registers and spilled bytes as ptxas, which comes with triton, tells them. Fails where one
spills: a warp would then wait for its own memory.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from recon_cli.render.triton import (
    compositing,
    loss,
    optimizer,
    project_backward,
    projection,
    step_status,
)

TARGETS = (75, 90)  # Turing, the oldest that triton compiles for, and Hopper
TYPES = {
    "order": "*i32", "first": "*i32", "members": "*i32", "offsets": "*fp32", "records": "*fp32",
    "image": "*fp32", "truth": "*u8", "mask": "*u8", "maps": "*fp32", "slopes": "*fp32",
    "parts": "*fp32", "gradient": "*fp32", "by_error": "fp32", "by_ssim": "fp32",
    "means": "*fp32", "quats": "*fp32", "log_scales": "*fp32", "logits": "*fp32",
    "sh_dc": "*fp32", "sh_rest": "*fp32", "view": "*fp64", "colored": "i32", "shapes": "*fp32",
    "centers": "*fp64", "depths": "*fp32", "touched": "*i32", "radii": "*fp32", "broken": "*i32",
    "keys": "*i64", "owners": "*i32", "g_means": "*fp32", "g_quats": "*fp32",
    "g_log_scales": "*fp32", "g_logits": "*fp32", "g_sh_dc": "*fp32", "g_sh_rest": "*fp32",
    "means2d_grad": "*fp32", "variance": "*fp32", "loo": "*fp32",
    "background": "*fp32", "width": "i32", "height": "i32", "tiles_x": "i32", "rgb": "*fp32",
    "alpha": "*fp32", "depth": "*fp32", "final": "*fp32", "last": "*i32", "slots": "*i64",
    "states": "*fp32", "similar": "*fp32", "wrong": "*fp32", "programs": "i32",
    "ssim_weight": "fp32", "bucket_tiles": "*i32", "tiles": "i32", "directions": "*fp32",
    "counting": "*u8", "hits": "*i32", "weights": "*fp32", "peaks": "*fp32", "grad_rgb": "*fp32",
    "grad_alpha": "*fp32", "grad_depth": "*fp32", "sums": "*fp32", "starts": "*i32",
    "count": "i32", "total_hits": "*i64", "blend_sum": "*fp32",
    "blend_max": "*fp32", "ends": "*i64", "room": "i32", "status": "*fp64", "fits": "*i32",
    "loss": "*fp64", "counted": "*i32", "taken": "*i64", "keep1": "fp32", "keep2": "fp32",
    "add1": "fp32", "add2": "fp32", "log2_keep1": "fp32", "log2_keep2": "fp32", "epsilon": "fp32",
    **{f"{role}{k}": "*fp32" for role in "pgmv" for k in range(6)},
    **{f"n{k}": "i32" for k in range(6)}, **{f"r{k}": "fp32" for k in range(6)},
}  # fmt: skip
# what is compiled, with the constants and the warps that the backend starts it with
KERNELS = (
    (compositing.composite,
     {"KEEP": True, "PLAIN": True, "SCORES": False, "MASKED": False, "CHUNK": 16, "BUCKET": 64}, 4),
    (compositing.composite,
     {"KEEP": True, "PLAIN": False, "SCORES": True, "MASKED": True, "CHUNK": 16, "BUCKET": 64}, 1),
    (compositing.tally, {"BLOCK": 32}, 1),
    (compositing.composite_backward,
     {"PLANES": 4, "PLAIN": True, "DETAILS": False, "SCORES": False, "MASKED": False,
      "BUCKET": 64}, 1),
    (compositing.composite_backward,
     {"PLANES": 4, "PLAIN": True, "DETAILS": True, "SCORES": False, "MASKED": False,
      "BUCKET": 64}, 1),
    (compositing.composite_backward,
     {"PLANES": 5, "PLAIN": False, "DETAILS": True, "SCORES": True, "MASKED": True,
      "BUCKET": 64}, 1),
    (projection.project, {"STRIDE": 45, "TERMS": 15, "BLOCK": 128}, 4),
    (projection.list_tiles, {"BLOCK": 32}, 1),
    (projection.place, {"BLOCK": 128}, 4),
    (projection.tile_starts, {"BLOCK": 128}, 4),
    (project_backward.project_backward,
     {"STRIDE": 45, "TERMS": 15, "GATED": True, "PLAIN": True, "DETAILS": False, "SCORES": False,
      "BLOCK": 32}, 1),
    (project_backward.project_backward,
     {"STRIDE": 45, "TERMS": 15, "GATED": False, "PLAIN": False, "DETAILS": True, "SCORES": True,
      "BLOCK": 32}, 1),
    (project_backward.harmonics_backward, {"STRIDE": 45, "TERMS": 15, "BLOCK": 256}, 4),
    (step_status.admit_kernel, {"BLOCK": 256}, 4),
    (step_status.record_kernel, {}, 4),
    (optimizer.adam, {"GATED": True, "BLOCK": 1024}, 4),
    (optimizer.adam, {"GATED": False, "BLOCK": 1024}, 4),
    (loss.blur_products, {"MASKED": True, "BLOCK": 256}, 4),
    (loss.similarity, {"BLOCK": 256}, 4),
    (loss.blur_slopes, {"BLOCK": 256}, 4),
    (loss.gradient_of, {"MASKED": True, "SSIM": True, "BLOCK": 256}, 4),
    (loss.total_loss, {"SSIM": True, "BLOCK": 1024}, 4),
)


def compiled(kernel, constants, warps, target):
    """Returns registers a thread and spilled bytes of a kernel."""
    names = kernel.arg_names
    source = ASTSource(
        fn=kernel, signature={
            name: "constexpr" if name in constants else TYPES[name] for name in names},
        constexprs={(names.index(name),): value for name, value in constants.items()})
    made = triton.compile(
        source, target=GPUTarget("cuda", target, 32), options={"num_warps": warps})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel.ptx"
        path.write_text(made.asm["ptx"])
        assembler = next((Path(triton.__file__).parent / "backends/nvidia/bin").glob("ptxas*"))
        architecture = re.search(r"\.target (\w+)", made.asm["ptx"]).group(1)
        said = subprocess.run(
            [assembler, "-v", f"--gpu-name={architecture}", path, "-o", path.with_suffix(".o")],
            check=True, capture_output=True, text=True).stderr
    registers = int(re.search(r"Used (\d+) registers", said).group(1))
    spilled = sum(map(int, re.findall(r"(\d+) bytes spill", said)))
    return registers, spilled


def main():
    worst = 0
    for target in TARGETS:
        for kernel, constants, warps in KERNELS:
            registers, spilled = compiled(kernel, constants, warps, target)
            worst = max(worst, spilled)
            shown = ", ".join(f"{name}={value}" for name, value in constants.items())
            sys.stdout.write(f"sm_{target} {kernel.__name__}({shown}): {registers} registers, "
                             f"{spilled} bytes spilled\n")
    sys.exit(worst > 0)


if __name__ == "__main__":
    main()
