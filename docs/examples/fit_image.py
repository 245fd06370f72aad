"""Fits Gaussians to an image, on a CPU or a GPU: python fit_image.py photo.jpg fit.png

It is written for gsplat; only the line that imports `rasterization` differs.
"""

import math
import sys

import numpy as np
import torch
from PIL import Image

from recon_cli import rasterization  # for gsplat: from gsplat import rasterization

SOURCE, TARGET = sys.argv[1], sys.argv[2]
STEPS = int(sys.argv[3]) if len(sys.argv) > 3 else 500
COUNT = 5_000

device = "cuda" if torch.cuda.is_available() else "cpu"
torch.manual_seed(0)
photo = Image.open(SOURCE).convert("RGB")
photo.thumbnail((320, 320))
truth = torch.tensor(np.asarray(photo), device=device) / 255
height, width, _ = truth.shape

# the Gaussians lie in front of one camera, in a layer that fills its image
focal = width / (2 * math.tan(math.pi / 6))
viewmats = torch.eye(4, device=device)[None]
viewmats[0, 2, 3] = 8
Ks = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], device=device)
half = 8 * torch.tensor([width / 2 / focal, height / 2 / focal, 0.1], device=device)
parameters = {
    "means": (2 * torch.rand(COUNT, 3, device=device) - 1) * half,
    "quats": torch.randn(COUNT, 4, device=device),
    "scales": torch.full((COUNT, 3), math.log(0.08), device=device),
    "opacities": torch.zeros(COUNT, device=device),
    "colors": torch.zeros(COUNT, 3, device=device)}
for parameter in parameters.values():
    parameter.requires_grad_()
optimizer = torch.optim.Adam(parameters.values(), lr=0.02)

for step in range(STEPS):
    renders, alphas, meta = rasterization(
        parameters["means"], parameters["quats"], parameters["scales"].exp(),
        parameters["opacities"].sigmoid(), parameters["colors"].sigmoid(), viewmats, Ks, width,
        height)
    loss = torch.nn.functional.mse_loss(renders[0], truth)
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if step % 50 == 0 or step == STEPS - 1:
        print(f"step {step}: {-10 * math.log10(loss.item()):.2f} dB")

pixels = (renders[0].detach().clamp(0, 1) * 255).round().byte().cpu().numpy()
Image.fromarray(pixels).save(TARGET)
