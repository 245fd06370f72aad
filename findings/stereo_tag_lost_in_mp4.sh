#!/bin/bash
# Guess: copying the streams of a 3D video from Matroska to MP4 keeps that it is 3D; both have a tag for it.
# What happens: FFmpeg's MP4 muxer leaves st3d out without a word, unless `-strict unofficial` is given.
# Hurts: whoever converts a side-by-side or 360-degree .mkv to .mp4 before reconstruction: every frame now
# passes as one ordinary view, and the room is there twice. sv3d, the tag of 360 degrees, goes the same way.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q av==18.1.0 numpy==2.3.5
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys

import av
import numpy as np

folder = sys.argv[1]
print("PyAV", av.__version__, "libavformat", av.library_versions["libavformat"])


def write(path):
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p"
        stream.metadata["stereo_mode"] = "left_right"
        for value in range(5):
            picture = np.full((64, 128, 3), 40 * value, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        container.mux(stream.encode(None))


def copy(start, end, **options):
    with av.open(start) as source, av.open(end, "w", options=options) as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                packet.stream = stream
                target.mux(packet)


def is_tagged(path):
    with av.open(path) as container:
        frame = next(container.decode(video=0))
        return any(data.type.name == "STEREO3D" for data in frame.side_data)


write(f"{folder}/a.mkv")
copy(f"{folder}/a.mkv", f"{folder}/b.mkv")
copy(f"{folder}/a.mkv", f"{folder}/b.mp4")
copy(f"{folder}/a.mkv", f"{folder}/c.mp4", strict="unofficial")
seen = [is_tagged(f"{folder}/{name}") for name in ("a.mkv", "b.mkv", "b.mp4", "c.mp4")]
print("tagged as 3D: Matroska, copied to Matroska, to MP4, to MP4 with strict=unofficial:", seen)
sys.exit(seen != [True, True, False, True])
PYTHON
