#!/usr/bin/env bash
# Reconstructs every video of a folder, each in a workspace of its own, and continues after a failure.
#
#   docs/examples/batch.sh VIDEOS RESULTS [OPTION...]
#
# The options after the two folders go to `recon run`, for example: --set train.iterations=1000
# A second call continues where the first one stopped. Exits with 1 if any video failed.
set -uo pipefail

if [ $# -lt 2 ]; then
    echo "usage: $0 VIDEOS RESULTS [OPTION...]" >&2
    exit 2
fi
videos=$1
results=$2
shift 2
mkdir -p "$results" || exit 7

shopt -s nullglob nocaseglob
failed=0
for video in "$videos"/*.{mp4,mov,mkv,avi,webm}; do
    name=$(basename "${video%.*}")
    echo "== $name"
    if recon run "$video" --workspace "$results/$name" "$@" 2>"$results/$name.log"; then
        cp "$results/$name/export/splats.ply" "$results/$name.ply"
        echo "$name: done" | tee -a "$results/summary.txt"
    else
        code=$?
        reason=$(grep -m 1 '^error:' "$results/$name.log" || tail -n 1 "$results/$name.log")
        echo "$name: failed with exit code $code: $reason" | tee -a "$results/summary.txt"
        failed=1
    fi
done
exit $failed
