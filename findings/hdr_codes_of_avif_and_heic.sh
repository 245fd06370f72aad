#!/usr/bin/env bash
# A photo in HDR (PQ or HLG), opened by Pillow, looks like any other: nothing says how its colours are coded.
#
# One would guess: Pillow converts an HDR AVIF or HEIC, or at least `info` tells its codes of H.273 (nclx, CICP).
# What happens: Pillow gives the PQ codes as 8-bit "RGB". For AVIF `info` holds no codes at all. For HEIC pillow-heif
# has `nclx_profile`, but only of the file's box `colr`: where the codes stand in the HEVC stream alone, as the standard
# allows, it is None. PyAV tells them in all three cases.
# Whom it hurts: whoever trains on photos of Canon, Sony or an export of Lightroom: they come in 10 to 20 dB off, pale
# and dark, without a warning, and beside SDR photos of the same room.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT INT TERM
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    pillow==13.0.0 pillow-heif==1.8.1 av==18.1.0 numpy==2.4.6
cd "$folder"
SVT_LOG=1 venv/bin/python - <<'PYTHON'
import sys

import av
import numpy as np
import PIL
import pillow_heif
from PIL import Image

BT2020, PQ = 9, 16  # codes of H.273
GRAY = 0.58  # of PQ: 203 cd/m2, the white of a page in HDR; about 230 of 255 once tone-mapped
pixels = np.full((64, 64, 3), round(GRAY * 65535), np.uint16)

pillow_heif.options.SAVE_HDR_TO_12_BIT = False
pillow_heif.encode("RGB;16", (64, 64), pixels.tobytes(), "box.heic", quality=-1, chroma=444,
                   color_primaries=BT2020, transfer_characteristics=PQ, matrix_coefficients=BT2020)
with open("box.heic", "rb") as file:
    data = file.read()
with open("stream.heic", "wb") as file:
    file.write(data.replace(b"colrnclx", b"freenclx"))  # a box that readers skip
with av.open("box.avif", "w", format="avif") as container:
    stream = container.add_stream("libsvtav1", rate=1)
    stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p10le"
    context = stream.codec_context
    context.color_primaries, context.color_trc, context.colorspace = BT2020, PQ, BT2020
    frame = av.VideoFrame.from_ndarray(pixels, format="rgb48le").reformat(
        format="yuv420p10le", dst_colorspace=BT2020)
    container.mux([*stream.encode(frame), *stream.encode()])

pillow_heif.register_heif_opener()
print("pillow", PIL.__version__, "pillow-heif", pillow_heif.__version__, "av", av.__version__)
as_expected = True
for name, told in (("box.avif", False), ("box.heic", True), ("stream.heic", False)):
    with Image.open(name) as image:
        gray = int(np.median(np.asarray(image)))
        codes = [key for key, value in image.info.items()
                 if value and ("nclx" in key or "cicp" in key or "icc" in key)]
        mode = image.mode
    with av.open(name) as container:
        context = container.streams.video[0].codec_context
        in_av = context.color_primaries, context.color_trc
    print(f"{name}: mode {mode}, gray {gray} of 255, info tells {codes or 'nothing'}, av tells {in_av}")
    as_expected &= (mode == "RGB" and abs(gray - GRAY * 255) < 3 and bool(codes) == told
                    and in_av == (BT2020, PQ))
print("finding: Pillow tells no codes of an HDR AVIF, pillow-heif those of the file's box alone"
      if as_expected else "the behaviour has changed")
sys.exit(not as_expected)
PYTHON
